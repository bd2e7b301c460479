"""Command that makes polarization events: from a photograph, a video, or measured polarization."""

import argparse
import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from polarnet.cli.outputs import MARKER, run_folder
from polarnet.cli.parsers import Commands
from polarnet.cli.project import settings_root, working_folder

if TYPE_CHECKING:
    from torch import Tensor

    from polarnet.cli.simulated_files import Outputs
    from polarnet.config.tree import Config
    from polarnet.pictures.clips import Clip
    from polarnet.simulation.scene import PolarizationScene
    from polarnet.simulation.upsampling import StokesFrame

DESCRIPTION = """\
Makes the events of a camera with four polarizers, the true DoLP and AoLP, and a preview video. INPUT is one of:
  a photograph, or one measurement of polarization: a sensor moves over it (sections ingest and synthesize)
  a video, or a folder of frames: hue becomes AoLP, saturation DoLP and value S0; the pixels see those of the frames
  four videos behind polarizers, NAME_0.mp4 ... NAME_135.mp4, or a folder of frames NAME_0, NAME_45, NAME_90, NAME_135
  with --mosaic: a video or a folder of raw frames of a polarization camera
Words KEY=VALUE replace values of params.yaml or choose presets of conf/: sensor=noisy polarizers=film seed=2."""

EXAMPLES = """\
examples:
  polarnet simulate lake.jpg sensor=noisy synthesize.duration_s=2
  polarnet simulate walk.mp4 --size 240 320 --upsample --format store evt3
  polarnet simulate frames/ --fps 100 polarizers=micropolarizers readout.max_events_per_s=5e6
  polarnet simulate dofp.mp4 --mosaic "90 45 / 135 0" --out outputs/dofp"""

STILL_REFUSES = ("times", "fps", "size", "upsample")
"""Options that do not apply to a single frame."""


def add_to(commands: Commands) -> None:
    """Add the command simulate."""
    simulate = commands.add_parser(
        "simulate",
        help="make polarization events from a photograph, a video or measured polarization",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    simulate.add_argument("words", nargs="+", metavar="INPUT", help="input, and after it words KEY=VALUE")
    simulate.add_argument("--out", type=Path, metavar="FOLDER", help="output folder (default: outputs/simulate/NAME)")
    simulate.add_argument(
        "--format", nargs="+", metavar="FORMAT", default=["store"],
        help="store, hdf5 (in DSEC's layout), text (lines t x y p) or evt3 (Prophesee's); default: store",
    )  # fmt: skip
    simulate.add_argument("--fps", type=float, metavar="HZ", help="frames a second (default: as a video states)")
    simulate.add_argument(
        "--times", type=Path, metavar="FILE",
        help="text with the time of each frame on a line of its own (default: timestamps.txt in a folder of frames)",
    )  # fmt: skip
    simulate.add_argument(
        "--time-unit", choices=("us", "ms", "s"), default="us", help="unit of the times in that text (default: us)"
    )
    simulate.add_argument(
        "--size", nargs=2, type=int, metavar=("HEIGHT", "WIDTH"), help="cut and reduce the frames to this size"
    )
    simulate.add_argument(
        "--upsample", action="store_true", help="interpolate frames so that nothing moves by more than 1 px a step"
    )
    simulate.add_argument("--grey", action="store_true", help="take colour frames as grey, which are unpolarized")
    simulate.add_argument(
        "--mosaic", metavar="'A B / C D'", help="polarizer angles of 2x2 pixels of raw frames: even row / odd row"
    )
    simulate.add_argument(
        "--angles", nargs=4, type=int, metavar="DEG", help="angles of four videos (default: from their names)"
    )
    simulate.add_argument(
        "--white", type=float, metavar="LEVEL",
        help="level at which a polarization camera saturates (default: 255, or the highest of the first frame's bits)",
    )  # fmt: skip
    simulate.add_argument("--no-preview", action="store_true", help="write no preview video")
    simulate.add_argument(
        "--video-rate", type=float, default=30.0, metavar="HZ",
        help="pictures a second of the preview; one shows the events between two frames (default: 30)",
    )  # fmt: skip
    simulate.set_defaults(run=_simulate, overrides=[])


class _Times(NamedTuple):
    """Times of a clip's frames: `t_us`, or multiples of 1 / `rate_hz`; if both are None, those of the video itself."""

    t_us: list[int] | None
    rate_hz: float | None
    source: str


def _simulate(options: argparse.Namespace) -> int:
    from polarnet.cli.simulated_files import FORMATS, LABEL_FORMATS, STORE, Outputs
    from polarnet.config.tree import load
    from polarnet.pictures.clips import ClipOptions, open_clip
    from polarnet.runtime.machine import configure
    from polarnet.stokes import parse_mosaic
    from polarnet.storage.exchange import h5py_module

    inputs = [Path(word).resolve() for word in options.words if "=" not in word or Path(word).exists()]
    overrides = [word for word in options.words if "=" in word and not Path(word).exists()]
    overrides += [*(word for word in options.format if "=" in word), *options.overrides]
    formats = list(dict.fromkeys(word for word in options.format if "=" not in word))
    if unknown := [form for form in formats if form not in FORMATS]:
        raise ValueError(f"--format: expected some of {', '.join(FORMATS)}, got {', '.join(unknown)}")
    if "hdf5" in formats:
        h5py_module()  # where it is missing, say so before the simulation
    if not inputs:
        raise ValueError(f"expected an input before {overrides[0]}; name a picture, a video or a folder of frames")
    for name, value in (("--fps", options.fps), ("--video-rate", options.video_rate)):
        if value is not None and not 0 < value <= 1e6:
            raise ValueError(f"{name}: expected more than 0 and at most 1e6 Hz, got {value:g}")
    if options.size and min(options.size) < 2:
        raise ValueError(f"--size: expected at least 2 rows and columns, got {options.size[0]} {options.size[1]}")
    mosaic = parse_mosaic(options.mosaic) if options.mosaic else None
    size = options.size and tuple(options.size)
    clip = open_clip(inputs, ClipOptions(mosaic, options.angles, options.white, options.grey, size))
    refuse_unused_options(options, clip, len(inputs))
    times = None if clip.still else _times_of(options, clip, inputs[0])
    folder, out = working_folder(), (options.out or working_folder() / "outputs" / "simulate" / clip.name).resolve()
    with contextlib.chdir(folder):  # paths of conf/config.yaml are relative to it
        config = load(settings_root(), overrides, folder)
    if config.storage.labels and (unable := [form for form in formats if form not in LABEL_FORMATS]):
        raise ValueError(
            f"storage.labels=true: expected formats that hold labels ({', '.join(LABEL_FORMATS)}), "
            f"got {', '.join(unable)}; leave it out, and write it with `polarnet convert`, without labels"
        )
    configure(config.runtime, config.seed)
    outputs = Outputs(
        formats or [STORE],
        None if options.no_preview else options.video_rate,
        2.2 if clip.measured else 1.0,
        config.storage.labels,
    )
    with run_folder(out, "simulate") as partial:
        try:
            facts = _run(config, clip, times, options.upsample, partial, outputs)
        except BaseException:
            _remove_files(partial)  # half a simulation is of no use
            raise
    for key, value in facts.items():
        print(f"{key:11s} {value}")
    print(f"folder      {out}")
    return 0


def refuse_unused_options(options: argparse.Namespace, clip: "Clip", inputs: int) -> None:
    """ValueError for an option that does not apply to the given kind of input."""
    unused: list[str] = []
    if clip.still:
        unused += STILL_REFUSES
    if not clip.measured:
        unused += ["white"]
    if clip.measured:
        unused += ["grey"]
    if inputs != 4:
        unused += ["angles"]
    else:
        unused += ["mosaic"]
    given = [f"--{name}" for name in unused if getattr(options, name) not in (None, False)]
    if given:
        kind = "a single frame" if clip.still else clip.words
        raise ValueError(f"{kind}: expected no {', '.join(given)}, which does not apply to this input; leave it out")
    if options.times and options.fps:
        raise ValueError("--times, --fps: expected one of them, got both; leave one out")


def _times_of(options: argparse.Namespace, clip: "Clip", path: Path) -> _Times:
    from polarnet.pictures.clips import TIMES_FILE, check_times, times_from_file

    if options.fps:
        return _Times(None, options.fps, "--fps")
    stated = path / TIMES_FILE
    file = options.times or (stated if stated.is_file() else None)
    if file is None and path.is_dir():
        raise ValueError(f"{path.name}: expected the times of the frames; give --fps HZ, --times FILE, or {stated}")
    if file is None:
        return _Times(None, None, path.name)
    t_us = check_times(times_from_file(file, options.time_unit), file.name)
    if clip.count is not None and len(t_us) != clip.count:
        raise ValueError(
            f"{file.name}: expected a time for each of {clip.count} frames, got {len(t_us)}; write one line a frame"
        )
    return _Times(t_us.tolist(), None, file.name)


def _run(
    config: "Config", clip: "Clip", times: _Times | None, upsample: bool, folder: Path, outputs: "Outputs"
) -> dict[str, str]:
    """Simulate into `folder` and return the facts to print."""
    from polarnet import __version__
    from polarnet.cli.simulated_files import write_simulation
    from polarnet.clips.video import drawn_camera, moving_pieces, video_pieces
    from polarnet.runtime.machine import threads_of
    from polarnet.simulation.motion import frame_times_us
    from polarnet.stokes import POLARIZER_ANGLES_DEG

    threads, labels = threads_of(config.runtime), outputs.labels
    attributes = {**config.camera.sections, "seed": config.seed}
    attributes |= {"input": clip.name, "kind": clip.words, "upsample": upsample, "polarnet": __version__}
    saturation: list[float] = []
    total: int | None
    if times is None:
        scene = _scene(config, clip, saturation)
        pieces = moving_pieces(scene, config.synthesize, config.camera, config.seed, threads, labels)
        attributes["synthesize"] = vars(config.synthesize)
        drawn, total = drawn_camera(config.camera, config.seed, "picture"), len(frame_times_us(config.synthesize))
    else:
        frames = timed_frames(clip, times, saturation)
        pieces = video_pieces(frames, config.camera, config.seed, upsample, threads, labels)
        drawn, total = drawn_camera(config.camera, config.seed, "video"), clip.count
    written = write_simulation(pieces, drawn, clip.name, folder, outputs, attributes, total)
    counts = zip(POLARIZER_ANGLES_DEG, written.events, strict=True)
    seconds, events = written.duration_us * 1e-6, sum(written.events)
    facts = {
        "input": f"{clip.name}: {clip.words}, {'under a moving sensor' if times is None else 'seen pixel by pixel'}",
        "channels": f"4 of {written.height} x {written.width} px, {drawn.camera.polarizers.layout}",
        "duration": f"{seconds:.3f} s, {written.frames:,} true frames",
        "events": f"{events:,} ({events / seconds:,.0f}/s): "
        + ", ".join(f"{count:,} at {angle}" for angle, count in counts)
        + " degrees",
        "time": f"{written.run_s:.2f} s, {events / written.run_s:,.0f} events/s",
        "files": ", ".join(written.files),
    }
    notes = []
    if clip.count is not None and times is not None and written.frames < clip.count:
        notes.append(f"the file states {clip.count:,} frames, {written.frames:,} could be read")
    if not written.polarized:
        notes.append("the frames are grey, so DoLP is 0 everywhere")
    if saturation and max(saturation) > 0:
        notes.append(
            f"up to {max(saturation):.2%} of a frame's pixels saturate; one saturated angle follows from the others, "
            f"the truth of pixels with more is wrong"
        )
    return facts | ({"note": "; ".join(notes)} if notes else {})


def _scene(config: "Config", clip: "Clip", saturation: list[float]) -> "PolarizationScene":
    """The scene of a single frame, cut and scaled as the pipeline does."""
    import torch

    from polarnet.pictures.images import fit

    frame = next(clip.frames())
    saturation.append(frame.saturated)
    ingest, rows, columns = config.ingest, *frame.pixels.shape[:2]
    pixels = frame.pixels
    if not clip.measured or (rows >= ingest.height and columns >= ingest.width):  # measurements are not enlarged
        pixels = fit(pixels, ingest.height, ingest.width, ingest.max_upscale)
    return _polarized(clip, torch.from_numpy(pixels.transpose(2, 0, 1).copy()))


def _polarized(clip: "Clip", planes: "Tensor") -> "PolarizationScene":
    from polarnet.simulation.scene import scene_from_intensities, scene_from_rgb

    return scene_from_intensities(planes) if clip.measured else scene_from_rgb(planes)


def timed_frames(clip: "Clip", times: _Times, saturation: list[float]) -> Iterator["StokesFrame"]:
    """Frames of a clip from time 0; `saturation` gets the share of saturated pixels of each.

    ValueError for more or fewer times than frames, and for times of a video that do not increase.
    """
    import torch

    from polarnet.simulation.upsampling import StokesFrame

    stated = iter(times.t_us) if times.t_us is not None else None
    first_us, number, before = 0.0, -1, -1
    for number, frame in enumerate(clip.frames()):
        t_us: int
        if stated is not None:
            t_us = next(stated, -1)
            if t_us < 0:
                raise ValueError(
                    f"{times.source}: expected a time for each frame, got {number} times and more frames; write one "
                    f"line a frame"
                )
        elif times.rate_hz is not None:
            t_us = round(number * 1e6 / times.rate_hz)
        else:
            first_us = frame.t_us or 0.0 if number == 0 else first_us
            t_us = round((frame.t_us or 0.0) - first_us)
        if t_us <= before:
            raise ValueError(
                f"{times.source}: expected times that increase, got {before} and {t_us} us for frames {number - 1} and "
                f"{number}; give --fps HZ or --times FILE"
            )
        before = t_us
        saturation.append(frame.saturated)
        yield StokesFrame(t_us, _polarized(clip, torch.from_numpy(frame.pixels.transpose(2, 0, 1).copy())).stokes)
    if stated is not None and (left := sum(1 for _ in stated)):
        raise ValueError(
            f"{times.source}: expected a time for each of {number + 1} frames, got {number + 1 + left}; write one line "
            f"a frame"
        )


def _remove_files(folder: Path) -> None:
    for entry in folder.iterdir():
        if entry.is_dir():
            shutil.rmtree(entry)
        elif entry.name != MARKER:
            entry.unlink()
