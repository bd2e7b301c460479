"""Stores on the command line: `polarnet verify` (with sealed folders and checkpoints) and the list of `inspect`."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.runtime.files import SUMS, changed_files
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore, SplitStore
from polarnet.storage.groups import open_group
from polarnet.storage.parts import Store
from polarnet.storage.scenes import SceneStore
from polarnet.training.engine.recorder import read_running

STORES: dict[str, type[Store]] = {store.FORMAT: store for store in (EventStore, FrameStore, SceneStore)}
FILES: dict[str, Callable[[Path], object]] = {".safetensors": load_checkpoint, ".pt": read_running}


def verified(path: str) -> Iterator[tuple[str, list[str]]]:
    """Each artefact at or below a path (or at an fsspec URL), and its problems.

    Unfinished and temporary folders are not read. ValueError for a file of another kind.
    """
    if "://" in path or Path(path).suffix == ".zarr":
        yield path, _store_problems(path)
    elif Path(path).is_dir():
        yield from _below(Path(path))
    else:
        yield path, _file_problems(Path(path))


def _below(folder: Path) -> Iterator[tuple[str, list[str]]]:
    for place, folders, files in os.walk(folder):
        here = Path(place)
        if SUMS in files:
            yield place, changed_files(here)
        for store in sorted(name for name in folders if name.endswith(".zarr")):
            yield str(here / store), _store_problems(str(here / store))
        folders[:] = sorted(name for name in folders if not name.endswith((".zarr", ".tmp", ".partial", ".old")))
        checked = [here / name for name in sorted(files) if Path(name).suffix in FILES]
        for file in checked:
            if file.suffix == ".pt" or file.with_suffix(".json").exists():
                yield str(file), _file_problems(file)


def kind_of(path: str) -> type[Store]:
    """Class of the store at a path; ValueError for other content."""
    form = open_group(path).attrs.get("format")
    if form not in STORES:
        raise ValueError(f"{path}: expected a store of format {', '.join(STORES)}, got {form!r}")
    return STORES[form]


def is_store(path: str) -> bool:
    """Whether a path, or an fsspec URL, is that of a store."""
    return "://" in path or (Path(path) / "zarr.json").is_file()


def listing(path: str) -> Iterator[str]:
    """A line for each sequence of a store: its duration and events, or its split. ValueError for other content."""
    store = kind_of(path).open(path)
    width = max(map(len, store.sequences), default=0)
    for name in store.sequences:
        facts = ""
        if isinstance(store, EventStore):
            facts = f"{store.duration_us(name) * 1e-6:8.3f} s  {sum(store.count(name)):12,d} events"
        elif isinstance(store, SplitStore):
            facts = store.splits[name]
        yield f"{name:{width}s}  {facts}"


def _store_problems(path: str) -> list[str]:
    try:
        kind = kind_of(path)
    except (FileNotFoundError, ValueError) as error:
        return [str(error)]
    return kind.verify(path)


def _file_problems(file: Path) -> list[str]:
    if file.suffix not in FILES:
        raise ValueError(f"{file}: expected a store, a folder, a checkpoint (.safetensors) or running.pt")
    try:
        FILES[file.suffix](file)
    except (FileNotFoundError, ValueError) as error:
        return [str(error)]
    return []
