"""Films of everything that polarnet writes or reads: stores, folders of a simulation or recovery, recordings."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import zarr
from torch import Tensor

from polarnet.events.representations import polarity_sums
from polarnet.events.stream import Events, slice_time
from polarnet.recordings.arrangements import Open, open_plain
from polarnet.recordings.recording import is_recording, open_recording
from polarnet.reports.player import MAX_FRAMES, TO_BYTES, TRUTH, Film, Kind, Map
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore, dequantise
from polarnet.storage.groups import open_group
from polarnet.storage.scenes import SceneStore

MAX_FILMS = 12  # sequences of a store shown without a choice
APPENDED: Sequence[Kind] = ("s0", "dolp", "aolp")
"""Arrays of recovered.zarr and truth.zarr that are shown, each named after its quantity."""


def films_of(path: Path, sequences: Sequence[str] = (), open_file: Open = open_recording) -> list[Film]:
    """Films of a store, of a folder with stores (all of a sequence in one), or of a camera's file.

    Without `sequences`, the first `MAX_FILMS` of each store are read. ValueError for an unknown sequence;
    FileNotFoundError if there is nothing to show.
    """
    if is_recording(path):
        return [_events_film(path.name, open_plain(path, open_file).whole(), None)]
    stores = [path] if _is_store(path) else sorted(filter(_is_store, path.glob("*.zarr")))
    parts = [film for store in stores for film in _films(store, sequences)]
    if not parts:
        raise FileNotFoundError(f"{path}: expected a folder with stores (*.zarr) of frames or events, found none")
    return _joined(parts)


def _is_store(path: Path) -> bool:
    return (path / "zarr.json").is_file()


def _joined(parts: Sequence[Film]) -> list[Film]:
    """One film for each name, with the maps of equal times and sizes; others get a film named after their first map."""
    films: dict[str, Film] = {}
    for part in sorted(parts, key=lambda film: film.maps[0].kind == "events"):  # the truth sets the times
        known = films.get(part.name)
        if known is None:
            films[part.name] = part
        elif list(known.t_us) == list(part.t_us) and known.maps[0].frames.shape == part.maps[0].frames.shape:
            films[part.name] = known._replace(maps=[*part.maps, *known.maps])
        else:
            name = f"{part.name}, {part.maps[0].kind}"
            name = name if name not in films else f"{name} {len(films)}"
            films[name] = part._replace(name=name)
    return list(films.values())


def _films(path: Path, sequences: Sequence[str]) -> Iterator[Film]:
    form = open_group(path).attrs.get("format")
    if form == EventStore.FORMAT:
        events, frames = EventStore.open(path), path.with_name("frames.zarr")
        truth = FrameStore.open(frames) if _is_store(frames) else None
        for name in _chosen(path, events.sequences, sequences):
            times = truth.t_us(name).tolist() if truth is not None and name in truth.sequences else None
            yield _events_film(name, events.read(name), times)
    elif form == FrameStore.FORMAT:
        store = FrameStore.open(path)
        for name in _chosen(path, store.sequences, sequences):
            t_us, intensity, dolp, aolp, _ = store.frames(name, 1)
            yield Film(name, t_us.tolist(), _truth(intensity[:, ::2].sum(1), dolp, aolp))
    elif form == SceneStore.FORMAT:
        scenes = SceneStore.open(path)
        for name in _chosen(path, list(scenes.scene_of), sequences):
            scene = scenes.read(name)
            yield Film(f"{name}: scene", [0], _truth(scene.s0[None], scene.dolp[None], scene.aolp[None]))
    else:
        yield _appended_film(path)


def _chosen(path: Path, names: Sequence[str], sequences: Sequence[str]) -> list[str]:
    if unknown := [name for name in sequences if name not in names]:
        raise ValueError(f"{path}: expected sequences among {', '.join(names)}, got {', '.join(unknown)}")
    return list(sequences) or list(names)[:MAX_FILMS]


def _events_film(name: str, channels: Sequence[Events], times_us: Sequence[int] | None) -> Film:
    """ON minus OFF events of the channels between the times; without times, in equal parts of the duration."""
    if times_us is None:
        full = [events.t for events in channels if len(events)]
        start, stop = (min(int(t[0]) for t in full), max(int(t[-1]) for t in full) + 1) if full else (0, 1)
        times_us = np.linspace(start, stop, MAX_FRAMES + 1).round().astype(int).tolist()
    spans = list(itertools.pairwise(times_us))
    sums = [torch.stack([polarity_sums(slice_time(events, *span)) for events in channels]).sum(0) for span in spans]
    return Film(name, [stop for _, stop in spans], _maps("Events", {"events": torch.stack(sums)}))


def _truth(s0: Tensor, dolp: Tensor, aolp: Tensor) -> list[Map]:
    return _maps(TRUTH, {"s0": s0, "dolp": dolp, "aolp": aolp})


def _appended_film(path: Path) -> Film:
    """A recovery or the truth of a simulation, from its growing arrays: frames spread evenly over them."""
    group = zarr.open_group(path, mode="r")
    arrays: dict[Kind, Any] = {name: group[name] for name in APPENDED if name in group}
    if "t_us" not in group or not arrays:
        raise ValueError(f"{path}: expected arrays t_us and dolp, or a store of polarnet; got {sorted(group.keys())}")
    times: Any = group["t_us"]
    places = np.unique(np.linspace(0, times.shape[0] - 1, MAX_FRAMES).round().astype(int))
    read = {kind: dequantise(kind, np.stack([one[int(k)] for k in places])) for kind, one in arrays.items()}
    return Film(path.parent.name, times[:][places].tolist(), _maps(path.stem, read))


def _maps(source: str, values: Mapping[Kind, Tensor]) -> list[Map]:
    return [Map(source, kind, TO_BYTES[kind](frames).numpy()) for kind, frames in values.items()]
