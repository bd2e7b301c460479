"""Commands that look at stores and recordings: inspect, view, video, replay, verify."""

import argparse
import os
import sys
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path

from polarnet.cli.options import READING, opener_of, refuse
from polarnet.config.origins import origin_problems
from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.recordings.inspection import findings, inspect_recording
from polarnet.recordings.live import replay as replay_events
from polarnet.recordings.noise import write_hot_pixels
from polarnet.recordings.recording import is_recording
from polarnet.reports.player import write_player
from polarnet.reports.preview import write_true_video
from polarnet.reports.recordings import recording_picture
from polarnet.reports.viewing import films_of
from polarnet.runtime.files import ORIGIN, SUMS, changed_files
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore, SplitStore
from polarnet.storage.groups import is_url, open_group
from polarnet.storage.parts import Store, unknown_sequence
from polarnet.storage.scenes import SceneStore
from polarnet.storage.true_frames import TrueFrames, open_truth, truth_beside
from polarnet.training.engine.recorder import read_running

STORES: dict[str, type[Store]] = {store.FORMAT: store for store in (EventStore, FrameStore, SceneStore)}
FILES: dict[str, Callable[[Path], object]] = {".safetensors": load_checkpoint, ".pt": read_running}
UNFINISHED = (".tmp", ".partial")


def inspect(options: argparse.Namespace) -> None:
    """Print a summary of a camera's file and draw it, or list the sequences of a store."""
    if is_store(options.file):
        refuse(options, "a store", READING)
        print(*_listing(options.file), sep="\n")
        return
    file = Path(options.file)
    inspection = inspect_recording(opener_of(options)(file))
    print(*findings(inspection), sep="\n")
    folder = options.out or Path("outputs", "inspect")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{file.name}.png").write_bytes(recording_picture(inspection))
    print(f"picture     {folder / file.name}.png")
    if inspection.hot.any():
        write_hot_pixels(folder / f"{file.name}.hot.txt", inspection.hot)
        print(f"hot pixels  {folder / file.name}.hot.txt, for --hot-pixels")


def view(options: argparse.Namespace) -> None:
    """Open the page of a folder that has one, such as a recovery; else write one that plays a store or a recording."""
    page = options.path / "index.html"
    if page.is_file():
        refuse(options, "a folder with a page", ["sequence", "out", *READING])
    else:
        recording = is_recording(options.path)
        refuse(options, *(("a recording", ["sequence"]) if recording else ("a store or a folder", READING)))
        films = films_of(options.path, options.sequence or (), opener_of(options))
        page = options.out or Path("outputs", "view", f"{options.path.resolve().name}.html")
        page.parent.mkdir(parents=True, exist_ok=True)
        write_player(page, f"{options.path}", films, {"command": options.command_line})
    print(f"page {page}")
    if not options.no_browser:
        webbrowser.open(page.resolve().as_uri())


def video(options: argparse.Namespace) -> None:
    """Draw a stored sequence and its truth."""
    store = EventStore.open(options.store)
    name = store.sequences[0] if options.sequence is None and len(store.sequences) == 1 else options.sequence
    if name not in store.sequences:
        raise ValueError(f"{options.store}: {unknown_sequence(name, store.sequences)}")
    truth = truth_of(options.store, name, options.truth)
    out = options.out or Path("outputs", "video", f"{name}.mp4")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_true_video(out, store.read(name), truth)
    print(f"video {out}")


def replay(options: argparse.Namespace) -> None:
    """Print the events of a stored sequence at its pace."""

    def write(data: bytes) -> None:
        sys.stdout.buffer.write(data)
        sys.stdout.buffer.flush()

    replay_events(EventStore.open(options.store).read(options.sequence), options.speed, write)


def verify(options: argparse.Namespace) -> int:
    """Print the problems of every artefact at or below a path; returns 1 if there are any."""
    results = list(verified(options.store))
    if not results:
        raise ValueError(f"{options.store}: expected a store, a checkpoint or a folder that holds some, found none")
    problems = [problem for _, found in results for problem in found]
    print(*problems, *(f"{name}: intact" for name, found in results if not found), sep="\n")
    return 1 if problems else 0


def truth_of(store: str, sequence: str, frames: str | None) -> TrueFrames:
    """True frames of a stored sequence from `frames`, else from those beside the store; ValueError without any."""
    if not (place := frames or truth_beside(store)):
        raise ValueError(f"--truth: expected frames.zarr or truth.zarr beside {store}, there is none; name them")
    return open_truth(place, sequence)


def is_store(path: str) -> bool:
    """Whether a path, or an fsspec URL, is that of a store."""
    return "://" in path or (Path(path) / "zarr.json").is_file()


def verified(path: str) -> Iterator[tuple[str, list[str]]]:
    """Each artefact at or below a path (or at an fsspec URL), and its problems.

    Unfinished and temporary folders are not read. ValueError for a file of another kind.
    """
    if is_url(path) or not Path(path).is_dir() or Path(path).suffix == ".zarr":
        yield path, _problems(path)
        return
    for place, folders, files in os.walk(path):
        here = Path(place)
        if {SUMS, ORIGIN} & {*files}:
            yield place, [*(changed_files(here) if SUMS in files else ()), *origin_problems(here)]
        stores = sorted(here / name for name in folders if name.endswith(".zarr"))
        written = sorted(here / name for name in files if Path(name).suffix in FILES)
        written = [file for file in written if file.suffix == ".pt" or file.with_suffix(".json").exists()]
        yield from ((str(one), _problems(str(one))) for one in (*stores, *written))
        folders[:] = sorted(name for name in folders if not name.endswith((".zarr", *UNFINISHED)))


def _problems(path: str) -> list[str]:
    """Problems of a store or a checkpoint."""
    suffix = Path(path).suffix
    if not (is_url(path) or suffix in (".zarr", *FILES)):
        raise ValueError(f"{path}: expected a store, a folder, a checkpoint (.safetensors) or running.pt")
    try:
        if suffix in FILES:
            FILES[suffix](Path(path))
            return []
        kind = _kind_of(path)
    except (FileNotFoundError, ValueError) as error:
        return [str(error)]
    return [*kind.verify(path), *([] if is_url(path) else origin_problems(Path(path)))]


def _kind_of(path: str) -> type[Store]:
    form = open_group(path).attrs.get("format")
    if form not in STORES:
        raise ValueError(f"{path}: expected a store of format {', '.join(STORES)}, got {form!r}")
    return STORES[form]


def _listing(path: str) -> Iterator[str]:
    """A line for each sequence of a store: its duration and events, or its split."""
    store = _kind_of(path).open(path)
    width = max(map(len, store.sequences), default=0)
    for name in store.sequences:
        facts = ""
        if isinstance(store, EventStore):
            facts = f"{store.duration_us(name) * 1e-6:8.3f} s  {sum(store.count(name)):12,d} events"
        elif isinstance(store, SplitStore):
            facts = store.splits[name]
        yield f"{name:{width}s}  {facts}"
