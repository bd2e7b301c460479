"""Commands that make polarization events, from a photograph, a video or measured polarization: simulate, demo."""

import argparse
import contextlib
import itertools
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import torch

from polarnet import __version__
from polarnet.cli.options import refuse
from polarnet.cli.outputs import run_folder
from polarnet.cli.project import settings_root, working_folder
from polarnet.cli.simulated_files import FORMATS, STORE, Output, write_simulation
from polarnet.cli.stores import is_store
from polarnet.clips.video import moving_pieces, video_pieces
from polarnet.config.tree import Config, load
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.pictures.clips import TIMES_FILE, Clip, ClipFrame, ClipOptions, check_times, open_clip, times_from_file
from polarnet.pictures.images import fit
from polarnet.recordings.writers import h5py_module
from polarnet.runtime.files import claimed
from polarnet.runtime.machine import configure, threads_of
from polarnet.simulation.motion import frame_times_us
from polarnet.simulation.scene import PolarizationScene, scene_from_intensities, scene_from_light, scene_from_rgb
from polarnet.simulation.upsampling import StokesFrame
from polarnet.stokes import parse_mosaic

PHOTOGRAPH = "astronaut"
Timed: TypeAlias = Iterator[tuple[ClipFrame | None, float | None]]
"""Frames with times in microseconds, which may start at any time; None where there are more of the others."""


def demo(options: argparse.Namespace) -> int:
    """Simulate a built-in photograph, recover it with the shipped weights and score it; returns the exit status."""
    from polarnet.cli import main

    started = time.monotonic()
    photograph = next(photo.path for photo in BUILTIN_PHOTOS if photo.path.stem == PHOTOGRAPH)
    out = options.out.resolve()
    simulated, recovered = out / "simulated", out / "recovered"
    with claimed(out):  # both, so that the recovery is that of this simulation
        print(f"simulating {photograph.name}; the first run also compiles the simulation")
        status = main(["simulate", str(photograph), *options.overrides, "--out", str(simulated)])
        status = status or main(["recover", str(simulated / "events.zarr"), "--truth", "--out", str(recovered)])
    if status == 0:
        print(f"video       {recovered / 'recovered.mp4'}, with the truth")
        print(f"done in     {time.monotonic() - started:.0f} s; open {recovered / 'index.html'}")
    return status


def simulate(options: argparse.Namespace) -> None:
    """Simulate, write the files and print facts about them."""
    words = [*options.words, *options.to, *options.overrides]
    overrides = [word for word in words if "=" in word and not Path(word).exists()]
    inputs = [word for word in options.words if word not in overrides]
    formats = list(dict.fromkeys(word for word in options.to if word not in overrides)) or [STORE]
    _check(options, inputs, overrides, formats)
    mosaic = parse_mosaic(options.mosaic) if options.mosaic else None
    size = options.size and tuple(options.size)
    path = Path(inputs[0]).resolve()
    if is_store(str(path)):
        raise ValueError(f"{inputs[0]}: expected a picture, a video or a folder of frames, got a store")
    clip = open_clip(path, ClipOptions(mosaic, options.white, options.grey, size))
    unused = ["times", "fps", "size", "upsample"] if clip.still else []
    unused.append("grey" if clip.measured else "white")
    refuse(options, "a single frame" if clip.still else clip.words, unused)
    times = None if clip.still else timed(options, clip, path)
    folder, out = working_folder(), (options.out or working_folder() / "outputs" / "simulate" / clip.name).resolve()
    with contextlib.chdir(folder):  # paths of conf/config.yaml are relative to it
        config = load(settings_root(), overrides, folder)
    configure(config.runtime, config.seed)
    gamma = None if options.no_preview else 2.2 if clip.measured or clip.light else 1.0
    attributes = {**config.camera.sections, "seed": config.seed, "input": clip.name, "kind": clip.words}
    attributes |= {"upsample": options.upsample, "polarnet": __version__}
    with run_folder(out, "simulate") as partial:
        try:
            facts = _run(config, clip, times, Output(partial, clip.name, formats, gamma, attributes))
        except BaseException:
            shutil.rmtree(partial)  # half a simulation is of no use
            raise
    for key, value in facts.items():
        print(f"{key:11s} {value}")
    print(f"folder      {out}")


def _check(options: argparse.Namespace, inputs: list[str], overrides: list[str], formats: list[str]) -> None:
    if unknown := [form for form in formats if form not in FORMATS]:
        raise ValueError(f"--to: expected some of {', '.join(FORMATS)}, got {', '.join(unknown)}")
    if "hdf5" in formats:
        h5py_module()  # where it is missing, say so before the simulation
    if len(inputs) != 1:
        raise ValueError(f"expected one picture, video or folder of frames before KEY=VALUE, got {len(inputs)}")
    if options.size and min(options.size) < 2:
        raise ValueError(f"--size: expected at least 2 rows and columns, got {options.size[0]} {options.size[1]}")
    if options.times and options.fps:
        raise ValueError("--times, --fps: expected one of them, got both; leave one out")


def _run(config: Config, clip: Clip, times: tuple[str, Timed] | None, output: Output) -> dict[str, str]:
    """Simulate and return the facts to print."""
    threads, saturation = threads_of(config.runtime), [0.0]
    total: int | None
    if times is None:
        motion = replace(config.synthesize, dynamic_range=None) if clip.light else config.synthesize
        pieces = moving_pieces(_scene(config, clip, saturation), motion, config.camera, config.seed, threads)
        output.attributes["synthesize"] = vars(motion)
        camera, total = config.camera.drawn(config.seed, "picture"), len(frame_times_us(motion))
    else:
        frames = _from_zero(clip, *times, saturation)
        pieces = video_pieces(frames, config.camera, config.seed, output.attributes["upsample"], threads)
        camera, total = config.camera.drawn(config.seed, "video"), clip.count
    facts, notes = write_simulation(pieces, camera, total, output)
    if worst := max(saturation):
        notes.append(
            f"up to {worst:.2%} of a frame's pixels saturate; one saturated angle follows from the others, the truth "
            f"of pixels with more is wrong"
        )
    seen = f"{clip.name}: {clip.words}, {'under a moving sensor' if times is None else 'seen pixel by pixel'}"
    return {"input": seen} | facts | ({"note": "; ".join(notes)} if notes else {})


def _scene(config: Config, clip: Clip, saturation: list[float]) -> PolarizationScene:
    """The scene of a single frame, cut and scaled as the pipeline does."""
    frame = next(clip.frames())
    saturation.append(frame.saturated)
    ingest, rows, columns = config.ingest, *frame.pixels.shape[:2]
    if not clip.measured or (rows >= ingest.height and columns >= ingest.width):  # measurements are not enlarged
        frame = frame._replace(pixels=fit(frame.pixels, ingest.height, ingest.width, ingest.max_upscale))
    return _polarized(clip, frame)


def _polarized(clip: Clip, frame: ClipFrame) -> PolarizationScene:
    planes = torch.from_numpy(frame.pixels.transpose(2, 0, 1).copy())
    if clip.measured:
        return scene_from_intensities(planes)
    return scene_from_light(planes) if clip.light else scene_from_rgb(planes)


def timed(options: argparse.Namespace, clip: Clip, path: Path) -> tuple[str, Timed]:
    """Source of a clip's times, for messages, and the frames with their times; ValueError for times that do not fit."""
    if options.fps:
        return "--fps", ((frame, number * 1e6 / options.fps) for number, frame in enumerate(clip.frames()))
    stated = path / TIMES_FILE
    file = options.times or (stated if stated.is_file() else None)
    if file is None and path.is_dir():
        raise ValueError(f"{path.name}: expected the times of the frames; give --fps HZ, --times FILE, or {stated}")
    if file is None:
        return path.name, ((frame, frame.t_us or 0.0) for frame in clip.frames())
    t_us = check_times(times_from_file(file, options.time_unit), file.name)
    if clip.count is not None and len(t_us) != clip.count:
        raise ValueError(
            f"{file.name}: expected a time for each of {clip.count} frames, got {len(t_us)}; write one line a frame"
        )
    return file.name, itertools.zip_longest(clip.frames(), t_us.tolist())


def _from_zero(clip: Clip, source: str, frames: Timed, saturation: list[float]) -> Iterator[StokesFrame]:
    """Frames of a clip from time 0; `saturation` gets the share of saturated pixels of each.

    ValueError for more or fewer times than frames, and for times of a video that do not increase.
    """
    before, first = -1, 0.0
    for number, (frame, time_us) in enumerate(frames):
        if frame is None or time_us is None:
            left = "frames and more times" if frame is None else "times and more frames"
            raise ValueError(f"{source}: expected a time for each frame, got {number} {left}")
        first = time_us if number == 0 else first
        t_us = round(time_us - first)
        if t_us <= before:
            raise ValueError(
                f"{source}: expected times that increase, got {before} and {t_us} us for frames {number - 1} and "
                f"{number}; give --fps HZ or --times FILE"
            )
        before = t_us
        saturation.append(frame.saturated)
        yield StokesFrame(t_us, _polarized(clip, frame).stokes)
