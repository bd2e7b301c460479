"""`polarnet recover`: frames of DoLP and AoLP from event-camera files or a running camera."""

import dataclasses
import itertools
import operator
import shutil
import statistics
import sys
import time
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from polarnet.captures.dot import EVENT_CAPTURES, RecordingsConfig
from polarnet.captures.imported import import_targets
from polarnet.captures.targets import calibrate_targets
from polarnet.events.stream import Events, downscale
from polarnet.events.streaming import SHORTEST_STEP_US, TRAINED_WINDOW_US, EventWindow, WindowCutter, WindowRule
from polarnet.methods import METHODS
from polarnet.methods.dolp_network import dolp_recoverer
from polarnet.methods.method import Method, Recoverer, Setup, each_map, why_absent
from polarnet.methods.overlap import advance, begin, warm_up
from polarnet.networks.registry import load_network
from polarnet.networks.weights import shipped_weights
from polarnet.recordings.arrangements import read_four, read_mosaic, read_plain
from polarnet.recordings.live import LiveLines, Piece, live_lines
from polarnet.recordings.live_camera import SCHEME, LiveCamera
from polarnet.recordings.noise import Cleaner
from polarnet.recordings.recording import Recording, detect_format
from polarnet.recovery.writer import RecoveryWriter
from polarnet.runtime.machine import RuntimeConfig, device_of, precision_on, tune
from polarnet.stokes import POLARIZER_ANGLES_DEG, Mosaic, Prediction
from polarnet.storage.events import EventStore
from polarnet.storage.exchange import EXPORT_INDEX
from polarnet.storage.parts import unknown_sequence
from polarnet.terminal.progress import ProgressBar

STANDARD_INPUT = "-"
BAR = "{l_bar}{bar}| {n:.2f}/{total:.2f} s [{elapsed}<{remaining}{postfix}]"
LIVE_BAR = "{desc}: {n:.2f} s [{elapsed}{postfix}]"


@dataclass(frozen=True)
class Arrangement:
    """Arrangement of the polarizers in front of the sensor, as given by the user."""

    angles: Sequence[int] | None
    """Polarizer angle of each of four files, in degrees and in the order of the files."""
    mosaic: Mosaic | None
    sequence: str | None
    """Sequence to read from an event store that holds several."""


class Input(NamedTuple):
    """Events of channels of equal size, read whole or piece by piece."""

    name: str
    height: int
    width: int
    pieces: Iterable[Piece]
    duration_us: int | None
    """None for live input, whose duration is unknown."""
    channels: int = 4
    """4, or 1 for a camera without polarizers, of which only intensity can be recovered."""


class Frame(NamedTuple):
    """Prediction at the end of a window, on the CPU, with its timing."""

    window: EventWindow
    prediction: Prediction
    step_s: float
    """Time from the window's events in memory to the frame in memory; for a batch of windows, an equal share."""
    latency_s: float
    """Time from the arrival of the window's last event to the frame in memory."""


@dataclass(frozen=True)
class Summary:
    """Number of frames and timing of one run."""

    frames: int
    stream_s: float
    """Time in the recording at the end of the last window."""
    run_s: float
    step_ms: float
    """Median of `Frame.step_s`, in ms."""
    latency_ms: float | None
    """Median of `Frame.latency_s`, in ms; None if all events were available from the start."""
    latency_ms_95: float | None
    """95th percentile of the latency, in ms; None as for `latency_ms`."""

    @property
    def realtime_factor(self) -> float:
        """Seconds of recording processed per second of computation."""
        return self.stream_s / self.run_s


def open_files(
    paths: Sequence[Path],
    arrangement: Arrangement,
    read: Callable[[Path], Recording],
    size: tuple[int, int] | None,
    work: Path,
    captures: Callable[[], RecordingsConfig],
    plain: bool = False,
    clean: Cleaner | None = None,
) -> Input:
    """Read channels from files, starting at time 0 and reduced to `size` (height, width) if given.

    Four files hold one channel each, in the order of `arrangement.angles`, and are read by `read`. A single path is a
    recording of a camera with a mosaic, an event store, a folder that `polarnet convert` wrote, or a folder of
    division-of-time captures, which are calibrated in `work` with the settings that `captures` returns. With `plain`,
    any other file is one channel, of a camera without polarizers. `clean` removes noise before the size is reduced.
    A ValueError or FileNotFoundError says what is missing.
    """
    missing = [str(path) for path in paths if not path.exists()]
    if missing:
        raise FileNotFoundError(f"{', '.join(missing)}: there is no such file")
    name = paths[0].name if len(paths) == 1 else ", ".join(path.name for path in paths)
    channels = _channels(paths, arrangement, read, work, captures, plain)
    duration_us = max((int(events.t[-1]) + 1 for events in channels if len(events)), default=0)
    if clean is not None:
        channels = clean(channels, duration_us)
    if size is not None:
        channels = [downscale(events, *size, keep_rate=True) for events in channels]
    pieces = [Piece(channels, duration_us, time.perf_counter())]
    return Input(name, channels[0].height, channels[0].width, pieces, duration_us, len(channels))


def _channels(
    paths: Sequence[Path],
    arrangement: Arrangement,
    read: Callable[[Path], Recording],
    work: Path,
    captures: Callable[[], RecordingsConfig],
    plain: bool,
) -> Sequence[Events]:
    if len(paths) == 4:
        if arrangement.angles is None:
            raise ValueError("four files: say the polarizer of each, in their order, such as --angles 0 45 90 135")
        if len(set(arrangement.angles)) < 4:
            raise ValueError(f"four files: expected four different angles, got {list(arrangement.angles)}")
        return read_four(dict(zip(arrangement.angles, paths, strict=True)), read=read)
    if len(paths) != 1:
        raise ValueError(f"expected one file or folder, or four files with --angles, got {len(paths)}")
    (path,) = paths
    if arrangement.mosaic is not None:
        return read_mosaic(path, arrangement.mosaic, read)
    if path.is_dir() and any(path.glob(f"{EVENT_CAPTURES[0]}.*")):
        return _captures(path, work, captures())
    if path.is_dir() and (exported := _exported(path, arrangement.sequence)):
        return read_four(exported, dict.fromkeys(exported, 0), read)  # their times count from the start of the sequence
    if detect_format(path) == "store":
        return _sequence(EventStore.open(path), path, arrangement.sequence)
    if plain:
        return read_plain(path, read)
    raise ValueError(
        f"{path.name} is one file of events: say where the polarizers of its pixels are, such as --mosaic "
        f"'90 45 / 135 0', or give four files with --angles, an event store, or a folder of {EVENT_CAPTURES[0]}.*, "
        f"...; for its intensity alone, give a --method that reconstructs it, such as firenet or highpass"
    )


def _exported(folder: Path, sequence: str | None) -> dict[int, Path]:
    """Files by angle in a folder that `polarnet convert` or `polarnet simulate` wrote; empty for any other folder."""
    if (folder / EXPORT_INDEX).is_file():
        names = sorted(path.name for path in folder.iterdir() if path.is_dir())
        name = names[0] if sequence is None and len(names) == 1 else sequence
        if name not in names:
            raise ValueError(f"{folder.name}: --sequence: {unknown_sequence(name, names)}")
        folder = folder / name
    files = {angle: sorted(folder.glob(f"polarizer_{angle:03d}.*")) for angle in POLARIZER_ANGLES_DEG}
    if not all(files.values()):
        return {}
    if several := next((paths for paths in files.values() if len(paths) > 1), None):
        raise ValueError(
            f"{folder}: expected one file for each polarizer, got {', '.join(path.name for path in several)}; "
            f"name the four files, with --angles 0 45 90 135"
        )
    return {angle: path for angle, (path,) in files.items()}


def _sequence(store: EventStore, path: Path, sequence: str | None) -> Sequence[Events]:
    if sequence is None and len(store.sequences) == 1:
        (sequence,) = store.sequences
    if sequence not in store.sequences:
        raise ValueError(f"{path.name}: --sequence: {unknown_sequence(sequence, store.sequences)}")
    return store.read(sequence)


def _captures(folder: Path, work: Path, config: RecordingsConfig) -> Sequence[Events]:
    root = work / "targets"
    shutil.rmtree(root, ignore_errors=True)  # of a run on another folder, maybe of the same name
    root.mkdir(parents=True)
    target = root / folder.resolve().name
    target.symlink_to(folder.resolve(), target_is_directory=True)
    import_targets(root, work / "imported", config)
    calibrate_targets(work / "imported", work / "calibrated", config, {})
    return EventStore.open(work / "calibrated" / "events.zarr").read(target.name)


def open_live(path: str, mosaic: Mosaic | None, idle_s: float) -> tuple[Input, LiveLines | LiveCamera]:
    """Read live from standard input (-), a growing file or a camera (dv://...), until `idle_s` seconds without data.

    ValueError for a camera without a mosaic.
    """
    if path.startswith(SCHEME):
        if mosaic is None:
            raise ValueError(f"{path}: expected --mosaic, the polarizers of the camera's pixels, with a camera")
        camera = LiveCamera(path, mosaic, idle_s)
        return Input(path, camera.height, camera.width, camera, None), camera
    if path != STANDARD_INPUT and not Path(path).is_file():
        raise FileNotFoundError(f"{path}: there is no such file; - reads standard input")
    source = sys.stdin.buffer if path == STANDARD_INPUT else open(path, "rb")  # noqa: SIM115 - read until the end
    name = "standard input" if path == STANDARD_INPUT else Path(path).name
    lines = LiveLines(source, name, mosaic, idle_s)
    return Input(name, lines.height, lines.width, lines, None), lines


def open_method(
    name: str | None,
    weights: Path | None,
    device: str,
    precision: str,
    setup_of: Callable[[Method], Setup],
    thresholds: Sequence[float] | None = None,
    binning: int | None = None,
) -> tuple[Recoverer, str]:
    """Open a method for `recover` and describe it in words.

    Without a `name` the method is the DoLP network with `weights`, else the shipped weights. Any other method runs
    with the settings of `setup_of`, and with `weights` if given. `precision` applies to networks: fp32, bf16,
    or auto, which selects bf16 if the device has units for it. `thresholds` are the camera's contrast thresholds, ON
    and OFF, and `binning` is the side in pixels of the blocks that the network sees; both are for the DoLP network. A
    ValueError or FileNotFoundError says what is missing.
    """
    tune()
    place = device_of(RuntimeConfig(device, threads=0, workers=1, devices=1, nodes=1, rendezvous=""))
    precision = precision_on(place, precision)
    if name in (None, "ours"):
        file = weights or shipped_weights()
        if not file.is_file():
            raise FileNotFoundError(f"--weights {file}: expected a checkpoint (NAME.safetensors), there is none")
        network, metadata = load_network(file)
        words = f"network {metadata['network']} ({precision}), {file}"
        return dolp_recoverer(network, metadata, place, precision, thresholds, binning), words
    assert name is not None
    if name not in METHODS:
        raise ValueError(f"--method: expected a method of {', '.join(METHODS)}, got {name!r}")
    method = METHODS[name]
    if method.rotating:
        raise ValueError(
            f"--method {name}: expected the rotation of the polarizer too: --rotating HZ or --triggers FILE"
        )
    for option, value in (("--thresholds", thresholds), ("--binning", binning)):
        if value is not None:
            raise ValueError(f"{option} is for the DoLP network, {name} does not use it")
    if weights is not None and method.weights is None:
        raise ValueError(f"--weights: {name} has no weights; leave it out")
    setup = dataclasses.replace(setup_of(method), device=place, precision=precision)
    if weights is not None:
        setup = dataclasses.replace(setup, weights=weights)
    if reason := why_absent(method, setup):
        raise ValueError(f"--method {name}: {reason}")
    return method.open(setup), name


def frames_of(source: Input, rule: WindowRule, recoverer: Recoverer, at_once: int | None = None) -> Iterator[Frame]:
    """Yield a frame for each window as soon as the window's last event has arrived.

    Windows that are already available, such as those of a file, are processed in runs of up to `at_once` windows
    (default: `Recoverer.at_once`).
    """
    warm_up(recoverer, source.height, source.width, source.channels)
    cutter = WindowCutter(rule, source.height, source.width, source.channels)
    history = begin(recoverer, source.height, source.width)
    most = at_once or recoverer.at_once(source.height, source.width)
    for piece in source.pieces:
        for windows in runs_of(cutter.add(piece.channels, piece.until_us), most):
            start = time.perf_counter()
            history, prediction = advance(recoverer, history, windows)
            maps = each_map(prediction, Tensor.cpu)
            done = time.perf_counter()
            for k, window in enumerate(windows):
                frame = each_map(maps, operator.itemgetter(k))
                yield Frame(window, frame, (done - start) / len(windows), done - piece.read_at)


def runs_of(windows: Iterable[EventWindow], most: int) -> Iterator[list[EventWindow]]:
    """Group adjacent windows, which neither overlap nor leave gaps, into batches of up to `most`."""
    run: list[EventWindow] = []
    for window in windows:
        if run and (len(run) == most or run[-1].stop_us != window.start_us):
            yield run
            run = []
        run.append(window)
    if run:
        yield run


def recover(
    source: Input,
    rule: WindowRule,
    recoverer: Recoverer,
    writer: RecoveryWriter,
    frames: Iterable[Frame] | None = None,
) -> Summary:
    """Write all `frames` (default: `frames_of`), with a progress bar.

    ValueError if the input is shorter than one window.
    """
    live = source.duration_us is None
    steps, latencies = array("d"), array("d")  # 16 bytes a frame, because a camera may run for days
    last_us, started = 0, time.perf_counter()
    with (
        writer,
        ProgressBar(
            total=source.duration_us, desc="recover", unit_scale=1e-6, bar_format=LIVE_BAR if live else BAR
        ) as bar,
    ):
        for frame in frames or frames_of(source, rule, recoverer):
            writer.add(frame.window, frame.prediction, live)
            steps.append(frame.step_s)
            latencies.append(frame.latency_s)
            bar.update(frame.window.stop_us - last_us)
            last_us = frame.window.stop_us
            latency = {"latency": f"{1000 * frame.latency_s:.1f} ms"} if live else {}
            bar.set_postfix(frames=len(steps), step=f"{1000 * frame.step_s:.1f} ms", refresh=False, **latency)
    if not steps:
        raise ValueError(_too_short(source, rule))
    return Summary(
        len(steps),
        last_us * 1e-6,
        time.perf_counter() - started,
        1000 * statistics.median(steps),
        1000 * statistics.median(latencies) if live else None,
        1000 * sorted(latencies)[int(0.95 * (len(latencies) - 1))] if live else None,
    )


def _too_short(source: Input, rule: WindowRule) -> str:
    """Error message for an input shorter than one window, with advice."""
    if rule.length_us is None:
        return f"{source.name} ends before {rule.events:,} events, one window: record for longer, or give fewer events"
    length = f"one window of {rule.length_us / 1000:g} ms"
    if source.duration_us is None:
        return f"{source.name} ended before {length} was full: record for longer"
    lasts = f"{source.name} lasts {source.duration_us / 1000:g} ms, less than {length}: record for longer"
    if source.duration_us >= TRAINED_WINDOW_US:
        return f"{lasts}, or give --window {TRAINED_WINDOW_US / 1000:g}ms"
    if source.duration_us >= SHORTEST_STEP_US:
        return (
            f"{lasts}. Networks need windows of {TRAINED_WINDOW_US / 1000:g} ms, filters do not: "
            f"--method highpass --window {source.duration_us}us"
        )
    return lasts


def facts_of(source: Input, rule: WindowRule, words: str, summary: Summary) -> dict[str, str]:
    """Facts about a run for the HTML page and the terminal."""
    length = f"{rule.length_us / 1000:g} ms" if rule.length_us is not None else f"{rule.events:,} events"
    step = "one after the other" if rule.step_us is None else f"one every {rule.step_us / 1000:g} ms"
    facts = {
        "input": source.name,
        "size": f"{source.height} x {source.width} px",
        "method": words,
        "windows": f"of {length}, {step}",
        "frames": f"{summary.frames:,} of {summary.stream_s:.3f} s",
        "step": f"{summary.step_ms:.2f} ms (median)",
    }
    if summary.latency_ms is None:
        return facts | {"time": f"{summary.run_s:.2f} s, {summary.realtime_factor:.2f} times as fast as real time"}
    return facts | {"latency": f"{summary.latency_ms:.1f} ms (median), 95 % within {summary.latency_ms_95:.1f} ms"}


def replay(store: EventStore, sequence: str, speed: float, write: Callable[[bytes], object]) -> None:
    """Write a sequence in the line format of `LiveLines`, at `speed` times the original pace."""
    head, times, lines = live_lines(store.read(sequence))
    write(head)
    ends = [0, *itertools.accumulate(map(len, lines.splitlines(keepends=True)))]
    started, sent = time.perf_counter(), 0
    while sent < len(times):
        due_us = int((time.perf_counter() - started) * 1e6 * speed)
        come = int(times.searchsorted(due_us, side="right"))
        if come > sent:
            asked = time.perf_counter()
            write(lines[ends[sent] : ends[come]])
            started += time.perf_counter() - asked  # time spent waiting for the reader does not count
            sent = come
        else:
            time.sleep(0.001)
