"""Read the pipeline's outputs for the report."""

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

from polarnet.pictures.manifest import SPLITS, Manifest, read_manifest
from polarnet.reports.figures import Curve
from polarnet.reports.maps import polarization_hsv
from polarnet.reports.overview import Overview
from polarnet.simulation.motion import Pose, Trajectory, sensor_to_scene
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.scenes import SceneStore
from polarnet.training.history import HISTORY, best_row, read_history

OURS = "ours"  # folder of the DoLP network's training
THUMBNAIL_WIDTH = 208  # pixels, twice the displayed size
MAX_THUMBNAILS = 24  # per split


@dataclass(frozen=True)
class ReportPaths:
    """Paths of the artefacts that the report reads, named like the stages' outputs."""

    images: Path
    scenes: Path
    frames: Path
    events: Path
    train: Path
    """Holds a folder for each trained network."""
    benchmark: Path

    def check(self, baselines: Sequence[str]) -> None:
        """FileNotFoundError that names each missing artefact and the stage that makes it; `baselines` were trained."""
        needed = {
            self.images / "manifest.json": "ingest",
            self.scenes: "synthesize",
            self.frames: "synthesize",
            self.events: "emulate",
            self.train / OURS / HISTORY: "train",
            **{self.train / name / HISTORY: f"train_baseline@{name}" for name in baselines},
            self.benchmark / "metrics.json": "benchmark",
            self.benchmark / "cost.json": "benchmark",
            self.benchmark / "details.json": "benchmark",
        }
        missing = [f"{path} (stage {stage})" for path, stage in needed.items() if not path.exists()]
        if missing:
            raise FileNotFoundError(f"the report needs {', '.join(missing)}; run `dvc repro` to make what is missing")


class Panel(NamedTuple):
    """One window of one test sequence, as stored by the benchmark; `dolp` and `aolp` by method."""

    sequence: str
    generated: bool
    """Whether its picture is a generated dead-leaves image."""
    window: int
    t_us: int
    events: Float[Tensor, "4 h w"]
    truth_dolp: Float[Tensor, "h w"]
    truth_aolp: Float[Tensor, "h w"]
    truth_s0: Float[Tensor, "h w"]
    dolp: Mapping[str, Float[Tensor, "h w"]]
    aolp: Mapping[str, Float[Tensor, "h w"]]


class Thumbnail(NamedTuple):
    """A small picture from data/images; measured polarization appears as hue, saturation and value."""

    name: str
    picture: UInt8[np.ndarray, "h w 3"]


class EventRate(NamedTuple):
    """Number of events in a split, summed over the four channels."""

    split: str
    sequences: int
    seconds: float
    events: int
    per_pixel_second: float
    """Rate of one channel."""


class History(NamedTuple):
    """Training curves of one network; epochs count from 0."""

    network: str
    """Name of the network in its checkpoint."""
    loss: Sequence[Curve]
    validation: Mapping[str, Curve]
    best_epoch: int


class SetResults(NamedTuple):
    """Benchmark results on a test set."""

    name: str
    metrics: Mapping[str, Mapping[str, Any]]
    """Scores and costs by row."""
    details: Mapping[str, Any]
    panels: Sequence[Panel]


@dataclass(frozen=True)
class Artefacts:
    """All data shown on the page."""

    manifest: Manifest
    metrics: Mapping[str, Mapping[str, Any]]
    """Scores and costs by row."""
    details: Mapping[str, Any]
    """Content of data/benchmark/details.json: the test data scored, and each scene's mean."""
    panels: Sequence[Panel]
    sets: Sequence[SetResults]
    """Test sets besides the simulated one."""
    ours: History
    baselines: Mapping[str, History]
    """Trained baselines by name."""
    rates: Sequence[EventRate]
    overview: Overview | None
    """None if the benchmark stored no panel of the network."""
    thumbnails: Mapping[str, Sequence[Thumbnail]]
    """The first `MAX_THUMBNAILS` of each split, photographs first."""


def read_artefacts(paths: ReportPaths, baselines: Sequence[str]) -> Artefacts:
    """Read everything under `paths`, with the trainings of `baselines`; FileNotFoundError names the stage to run."""
    paths.check(baselines)
    scenes, frames, events = (
        SceneStore.open(paths.scenes),
        FrameStore.open(paths.frames),
        EventStore.open(paths.events),
    )
    manifest = read_manifest(paths.images)
    names = set(scenes.scene_of.values())  # pictures too small for the sensor have no scene
    pictures = [entry for entry in manifest.pictures if entry.name in names]
    pictures.sort(key=lambda entry: entry.source == "dead_leaves")  # photographs first
    generated = {entry.name for entry in pictures if entry.source == "dead_leaves"}
    files = sorted((paths.benchmark / "panels").glob("*.npz"))
    panels = [_panel(file, scenes.scene_of[file.stem] in generated) for file in files]
    panels.sort(key=lambda panel: panel.generated)
    return Artefacts(
        manifest=manifest,
        metrics=_scores_and_costs(paths.benchmark),
        details=_json(paths.benchmark / "details.json"),
        panels=panels,
        sets=[read_set(folder) for folder in sorted(paths.benchmark.glob("sets/*")) if folder.is_dir()],
        ours=training_history(paths.train / OURS),
        baselines={name: training_history(paths.train / name) for name in baselines},
        rates=event_rates(events, frames),
        overview=next((overview_of(panel, scenes, frames, events) for panel in _telling(panels)), None),
        thumbnails={
            split: thumbnails([entry.name for entry in pictures if entry.split == split], scenes) for split in SPLITS
        },
    )


def read_set(folder: Path) -> SetResults:
    """Read a folder written by `write_benchmark`; the set's name comes from details.json, or from the folder."""
    for name in ("metrics.json", "cost.json", "details.json"):
        if not (folder / name).exists():
            raise FileNotFoundError(f"{folder / name} is missing; run the benchmark of this test set again")
    details = _json(folder / "details.json")
    panels = [_panel(file, generated=False) for file in sorted((folder / "panels").glob("*.npz"))]
    return SetResults(details.get("set", folder.name), _scores_and_costs(folder), details, panels)


def training_history(folder: Path) -> History:
    """Curves of a training, from its history, and the name of its network."""
    rows = read_history(folder)
    epochs = [row["epoch"] for row in rows]

    def curves(split: str) -> dict[str, Curve]:
        return {name: Curve(name, epochs, [row[split][name] for row in rows]) for name in rows[0][split]}

    network = _json(folder / "best.json")["network"]
    return History(network, list(curves("train").values()), curves("val"), best_row(rows)["epoch"])


def _scores_and_costs(folder: Path) -> dict[str, dict[str, Any]]:
    """Content of metrics.json and cost.json, by row."""
    costs = _json(folder / "cost.json")
    return {row: {**scores, **costs[row]} for row, scores in _json(folder / "metrics.json").items()}


def event_rates(events: EventStore, frames: FrameStore) -> list[EventRate]:
    """Number and rate of events in each split; a split without sequences is left out."""
    rates = []
    for split in SPLITS:
        names = [name for name in frames.of_split(split) if name in set(events.sequences)]
        if names:
            seconds = sum(events.duration_us(name) for name in names) / 1e6
            count = sum(sum(events.count(name)) for name in names)
            rate = count / (4 * events.height * events.width * seconds)
            rates.append(EventRate(split, len(names), seconds, count, rate))
    return rates


def overview_of(panel: Panel, scenes: SceneStore, frames: FrameStore, events: EventStore) -> Overview:
    """Data of a panel's sequence, from its picture to the DoLP recovered from the events of its window."""
    record = scenes.read(panel.sequence)
    start_us = int(frames.t_us(panel.sequence)[panel.window])
    trajectory = Trajectory.from_vector(record.trajectory.numpy())
    path = trajectory.pose(np.linspace(0, record.duration_us / 1e6, 200))
    size = np.array([[record.s0.shape[1]], [record.s0.shape[0]]])
    return Overview(
        name=panel.sequence,
        picture=polarization_hsv(record.s0, record.dolp, record.aolp),
        path=np.stack([path.x, path.y]) / size,
        outline=_outline(trajectory.pose(np.array([panel.t_us / 1e6])), scenes.sensor_height, scenes.sensor_width)
        / size,
        intensity=frames.intensity(panel.sequence)[panel.window + 1],
        dolp=panel.truth_dolp,
        aolp=panel.truth_aolp,
        streams=events.read(panel.sequence, start_us, panel.t_us),
        start_us=start_us,
        duration_us=panel.t_us - start_us,
        recovered=panel.dolp["ours"],
    )


def thumbnails(pictures: Sequence[str], scenes: SceneStore) -> list[Thumbnail]:
    """Thumbnails of the first `MAX_THUMBNAILS` pictures, from the scenes made of them."""
    sequence_of = {scene: sequence for sequence, scene in reversed(scenes.scene_of.items())}
    found = []
    for picture in pictures[:MAX_THUMBNAILS]:
        scene = scenes.read(sequence_of[picture])
        rgb = polarization_hsv(scene.s0, scene.dolp, scene.aolp)
        size = (THUMBNAIL_WIDTH, round(THUMBNAIL_WIDTH * rgb.shape[0] / rgb.shape[1]))
        found.append(Thumbnail(picture, cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).astype(np.uint8)))
    return found


def _telling(panels: Sequence[Panel]) -> list[Panel]:
    """Panels with the network's prediction: photographs before dead leaves, then by variation of the true DoLP."""
    shown = [panel for panel in panels if "ours" in panel.dolp]
    return sorted(shown, key=lambda panel: (panel.generated, -float(panel.truth_dolp.std())))


def _outline(pose: Pose, height: int, width: int) -> Float[np.ndarray, "2 corners"]:
    """Corners of the sensor at the first pose, in pixels of the scene; the first is repeated to close the line."""
    left, top, along, across = sensor_to_scene(*(float(column[0]) for column in pose), height, width)
    columns, rows = np.array([[0, width, width, 0, 0], [0, 0, height, height, 0]])
    return np.stack([left + columns * along - rows * across, top + columns * across + rows * along])


def _panel(file: Path, generated: bool) -> Panel:
    with np.load(file) as arrays:
        tensors = {name: torch.from_numpy(arrays[name]) for name in arrays.files}

    def by_method(kind: str) -> dict[str, Tensor]:
        return {name.removeprefix(kind): frame for name, frame in tensors.items() if name.startswith(kind)}

    return Panel(
        sequence=file.stem,
        generated=generated,
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
