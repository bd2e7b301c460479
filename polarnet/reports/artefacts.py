"""What the pipeline left behind, read for the report."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from polarnet.events.frames import FrameStore
from polarnet.events.store import EventStore
from polarnet.reports.figures import Curve
from polarnet.reports.overview import Overview
from polarnet.simulation.motion import Pose, Trajectory, window_to_scene
from polarnet.simulation.pictures.manifest import Manifest, read_manifest
from polarnet.simulation.scenes import SceneStore

OVERVIEW_US = 150_000  # of events in the overview: enough to see edges move


@dataclass(frozen=True)
class ReportPaths:
    """Where the artefacts lie that the report reads, named like the stages' outputs."""

    images: Path
    scenes: Path
    frames: Path
    events: Path
    train: Path
    train_e2v: Path
    benchmark: Path

    def check(self) -> None:
        """FileNotFoundError that names everything missing and the stage that makes it."""
        needed = {
            self.images / "manifest.json": "ingest",
            self.scenes: "synthesize",
            self.frames: "synthesize",
            self.events: "emulate",
            self.train / "history.json": "train",
            self.train_e2v / "history.json": "train_e2v",
            self.benchmark / "metrics.json": "benchmark",
            self.benchmark / "details.json": "benchmark",
        }
        if missing := [f"{path} (stage {stage})" for path, stage in needed.items() if not path.exists()]:
            raise FileNotFoundError(f"the report needs {', '.join(missing)}; run `dvc repro` to make what is missing")


class Panel(NamedTuple):
    """One window of one test sequence, as the benchmark kept it; `dolp` and `aolp` by method."""

    sequence: str
    window: int
    t_us: int
    events: Float[Tensor, "4 h w"]
    truth_dolp: Float[Tensor, "h w"]
    truth_aolp: Float[Tensor, "h w"]
    truth_s0: Float[Tensor, "h w"]
    dolp: Mapping[str, Float[Tensor, "h w"]]
    aolp: Mapping[str, Float[Tensor, "h w"]]


class EventRate(NamedTuple):
    """How many events a split has, all four polarizers together."""

    split: str
    sequences: int
    seconds: float
    events: int
    per_pixel_second: float
    """Of one polarizer."""


class History(NamedTuple):
    """Training curves of one network; epochs count from 0."""

    loss: Sequence[Curve]
    validation: Mapping[str, Curve]
    best_epoch: int


@dataclass(frozen=True)
class Artefacts:
    """Everything the page shows."""

    manifest: Manifest
    metrics: Mapping[str, Mapping[str, Any]]
    details: Mapping[str, Any]
    """data/benchmark/details.json: what was scored, and each scene's mean."""
    panels: Sequence[Panel]
    ours: History
    e2v: History
    rates: Sequence[EventRate]
    overview: Overview | None
    """None where the benchmark kept no panel."""
    images: Path

    @property
    def lpips_reason(self) -> str | None:
        """Why there is no LPIPS; None where there is."""
        return self.details["lpips"]["reason"]


def read_artefacts(paths: ReportPaths) -> Artefacts:
    """Everything under `paths`; FileNotFoundError that says which stage to run."""
    paths.check()
    frames, events = FrameStore.open(paths.frames), EventStore.open(paths.events)
    manifest = read_manifest(paths.images)
    panels = [_panel(file) for file in sorted((paths.benchmark / "panels").glob("*.npz"))]
    shown = next((panel for panel in panels if "ours" in panel.dolp), None)
    return Artefacts(
        manifest=manifest,
        metrics=_json(paths.benchmark / "metrics.json"),
        details=_json(paths.benchmark / "details.json"),
        panels=panels,
        ours=read_history(paths.train / "history.json"),
        e2v=read_history(paths.train_e2v / "history.json"),
        rates=event_rates(events, frames),
        overview=None if shown is None else overview_of(shown, paths, frames, events),
        images=paths.images,
    )


def read_history(path: Path) -> History:
    """Curves of a history.json: a row an epoch, each with the mean loss terms and the validation scores."""
    rows = _json(path)
    if not rows:
        raise ValueError(f"{path}: expected a row for each epoch, got none; train again")
    epochs = [row["epoch"] for row in rows]

    def curves(split: str) -> dict[str, Curve]:
        return {name: Curve(name, epochs, [row[split][name] for row in rows]) for name in rows[0][split]}

    best = min(rows, key=lambda row: row["val"]["mse"])
    return History(list(curves("train").values()), curves("val"), best["epoch"])


def event_rates(events: EventStore, frames: FrameStore) -> list[EventRate]:
    """How many events each split has; a split without sequences is left out."""
    rates = []
    for split in ("train", "val", "test"):
        names = [name for name in frames.of_split(split) if name in set(events.sequences)]
        if names:
            seconds = sum(events.duration_us(name) for name in names) / 1e6
            count = sum(sum(events.count(name)) for name in names)
            rate = count / (4 * events.height * events.width * seconds)
            rates.append(EventRate(split, len(names), seconds, count, rate))
    return rates


def overview_of(panel: Panel, paths: ReportPaths, frames: FrameStore, events: EventStore) -> Overview:
    """A panel's sequence from photograph to recovered DoLP, with the events that lead up to the panel's window."""
    scenes = SceneStore.open(paths.scenes)
    record = scenes.read(panel.sequence)
    picture = next(entry for entry in read_manifest(paths.images).pictures if entry.name == record.picture)
    start_us = max(0, panel.t_us - OVERVIEW_US)
    pose = Trajectory.from_vector(record.trajectory.numpy()).pose(np.linspace(start_us, panel.t_us, 50) / 1e6)
    size = np.array([[record.s0.shape[1]], [record.s0.shape[0]]])
    return Overview(
        name=panel.sequence,
        photograph=read_thumbnail(paths.images / picture.file, width=600),
        path=np.stack([pose.x, pose.y]) / size,
        outline=_outline(pose, scenes.window_height, scenes.window_width) / size,
        intensity=frames.intensity(panel.sequence)[panel.window + 1],
        dolp=panel.truth_dolp,
        aolp=panel.truth_aolp,
        streams=events.read(panel.sequence, start_us, panel.t_us),
        start_us=start_us,
        duration_us=panel.t_us - start_us,
        recovered=panel.dolp["ours"],
    )


def read_thumbnail(path: Path, width: int) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of data/images as 8-bit RGB, `width` pixels wide."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise FileNotFoundError(f"{path}: expected the picture that manifest.json names; run the stage ingest again")
    height = round(picture.shape[0] * width / picture.shape[1])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)[..., ::-1].astype(np.uint8)


def _outline(pose: Pose, height: int, width: int) -> Float[np.ndarray, "2 corners"]:
    """Corners of the window at the last pose, in pixels of the scene; the first one twice, to close the line."""
    last = (pose.x[-1], pose.y[-1], pose.angle[-1], pose.zoom[-1])
    left, top, along, across = window_to_scene(*last, height, width)
    columns, rows = np.array([[0, width, width, 0, 0], [0, 0, height, height, 0]])
    return np.stack([left + columns * along - rows * across, top + columns * across + rows * along])


def _panel(file: Path) -> Panel:
    with np.load(file) as arrays:
        tensors = {name: torch.from_numpy(arrays[name]) for name in arrays.files}

    def by_method(kind: str) -> dict[str, Tensor]:
        return {name.removeprefix(kind): frame for name, frame in tensors.items() if name.startswith(kind)}

    return Panel(
        sequence=file.stem,
        window=int(tensors["window"]),
        t_us=int(tensors["t_us"]),
        events=tensors["events"],
        truth_dolp=tensors["truth_dolp"],
        truth_aolp=tensors["truth_aolp"],
        truth_s0=tensors["truth_s0"],
        dolp=by_method("dolp_"),
        aolp=by_method("aolp_"),
    )


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
