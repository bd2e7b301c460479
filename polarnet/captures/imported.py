"""Decode division-of-time captures once, for later steps that read them repeatedly, whatever the file format."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from polarnet.captures.dot import (
    EVENT_CAPTURES,
    INTENSITY_CAPTURES,
    IntensityCapture,
    RecordingsConfig,
    find_captures,
    given_starts,
    read_event_capture,
    read_intensity_capture,
    targets_of,
)
from polarnet.events.stream import Events
from polarnet.recordings.arrangements import shifted
from polarnet.runtime.files import check_seal, seal, sha256
from polarnet.storage.events import EventStore

STATUS_FILE = "status.json"


class Target(NamedTuple):
    """The eight captures of one target, as stored by `import_targets`."""

    name: str
    events: Mapping[str, Events]
    intensities: Mapping[str, IntensityCapture]
    given: Mapping[str, int]
    """Start times set by hand."""


def import_targets(root: Path, out: Path, config: RecordingsConfig) -> list[str]:
    """Decode every target of `root` into `out` and return the targets' names.

    `out` gets events.zarr, a folder of pictures for each target, and status.json. In events.zarr the four event
    captures of a target are its channels, each by its own clock from its first event on. RecordingError where a file is
    missing or damaged.
    """
    names = targets_of(root)
    start_over(out, enabled=True)
    attributes = {
        "sensor": list(config.sensor),
        "files": {name: {key: _hash(path) for key, path in find_captures(root / name).items()} for name in names},
    }
    store = EventStore.create(out / "events.zarr", names, config.sensor[0], config.sensor[1], attributes)
    for name in names:
        files = find_captures(root / name)
        channels, origins = [], {}
        for capture in EVENT_CAPTURES:
            events = read_event_capture(files[capture], config)
            origins[capture] = int(events.t[0]) if len(events) else 0
            channels.append(shifted(events, origins[capture]))
        store.write(name, channels, max((int(e.t[-1]) for e in channels if len(e)), default=0))
        folder = out / name
        folder.mkdir()
        for capture in INTENSITY_CAPTURES:
            pictures = read_intensity_capture(files[capture], config)
            np.save(folder / f"{capture}.npy", pictures.pictures)
            np.savez(folder / f"{capture}_times.npz", t_us=pictures.t_us, region=pictures.region)
        content = {"origin_us": origins, "given_us": given_starts(root / name)}
        (folder / "clocks.json").write_text(json.dumps(content, indent=2) + "\n")
        seal(folder)
    store.finish()
    return names


def open_target(imported: Path, name: str) -> Target:
    """Open an imported target, its events by the clocks of their files; pictures are memory-mapped.

    ValueError if a file has changed since the import.
    """
    folder = imported / name
    check_seal(folder)
    clocks = json.loads((folder / "clocks.json").read_text())
    channels = EventStore.open(imported / "events.zarr").read(name)
    events = {
        capture: shifted(channel, -clocks["origin_us"][capture])
        for capture, channel in zip(EVENT_CAPTURES, channels, strict=True)
    }
    intensities = {}
    for capture in INTENSITY_CAPTURES:
        with np.load(folder / f"{capture}_times.npz") as times:
            pictures = np.load(folder / f"{capture}.npy", mmap_mode="r")
            intensities[capture] = IntensityCapture(times["t_us"], pictures, times["region"])
    return Target(name, events, intensities, clocks["given_us"])


def _hash(capture: Path) -> str:
    """SHA-256 of a capture's file, or of the files of its folder one after another, by name."""
    return sha256(*(sorted(capture.iterdir()) if capture.is_dir() else [capture]))


def start_over(out: Path, *, enabled: bool) -> None:
    """Empty a stage's output folder and write status.json, which says whether real recordings are in use."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    (out / STATUS_FILE).write_text(json.dumps({"enabled": enabled}) + "\n")
