"""Read the pipeline's outputs for the report."""

import csv
import json
from bisect import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from polarnet.events.stream import Events
from polarnet.events.streaming import BIN_EDGES, events_per_pixel
from polarnet.pictures.manifest import Manifest, read_manifest
from polarnet.reports.legend import legend_of
from polarnet.reports.maps import polarization_hsv
from polarnet.reports.tables import Table, score_table
from polarnet.runtime.splits import SPLITS
from polarnet.simulation.motion import Pose, Trajectory, sensor_to_scene
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.panels import Panel, read_panel
from polarnet.storage.scenes import SceneStore
from polarnet.training.engine.recorder import best_row, read_history

SIMULATED = "simulated"  # name of the pipeline's own test set
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

    @property
    def simulated(self) -> Path:
        """Results on the simulated test set."""
        return self.benchmark / "sets" / SIMULATED


class Overview(NamedTuple):
    """One test sequence, from the picture that the sensor moved over to the DoLP recovered from one window."""

    name: str
    picture: UInt8[np.ndarray, "height width 3"]
    path: Float[np.ndarray, "2 times"]
    """Path of the sensor's centre over the sequence: x and y in fractions of the picture's width and height."""
    outline: Float[np.ndarray, "2 corners"]
    """Outline of the sensor at the end, in the same fractions."""
    intensity: Float[Tensor, "4 h w"]
    dolp: Float[Tensor, "h w"]
    aolp: Float[Tensor, "h w"]
    streams: Sequence[Events]
    """Events of the four channels, from `start_us` on."""
    start_us: int
    duration_us: int
    recovered: Float[Tensor, "h w"]


class BudgetPoint(NamedTuple):
    """Mean error of a method over the scored frames of one bin of events per pixel."""

    method: str
    events_per_pixel: float
    """Mean over the frames of the bin; events of a channel since the start of the sequence."""
    mse: float
    frames: int


class History(NamedTuple):
    """Training curves of one network; epochs count from 0."""

    network: str
    """Name of the network in its checkpoint."""
    loss: Mapping[str, Sequence[float]]
    """Mean of each loss term in each epoch."""
    validation: Mapping[str, Sequence[float]]
    """Validation scores of each epoch."""
    best_epoch: int


class Results(NamedTuple):
    """Benchmark results on one test set."""

    name: str
    metrics: Mapping[str, Mapping[str, Any]]
    """Scores and costs by row."""
    details: Mapping[str, Any]
    """Content of details.json: the test data scored, and each scene's mean."""
    panels: Sequence[Panel]


@dataclass(frozen=True)
class Artefacts:
    """All data shown on the page."""

    manifest: Manifest
    results: Results
    """Results on the simulated test set; panels of photographs first, those with the most varied DoLP before others."""
    sets: Sequence[Results]
    """Results on the other test sets."""
    ours: History
    baselines: Mapping[str, History]
    """Trained baselines by name."""
    budget: Sequence[BudgetPoint]
    """Error on the simulated test set by events per pixel, method by method."""
    overview: Overview | None
    """None if the benchmark stored no panel of the network."""
    thumbnails: Mapping[str, Mapping[str, UInt8[np.ndarray, "h w 3"]]]
    """The first `MAX_THUMBNAILS` pictures of each split by name, photographs first."""


def read_artefacts(paths: ReportPaths, baselines: Sequence[str]) -> Artefacts:
    """Read everything under `paths`, with the trainings of `baselines`."""
    scenes, frames = SceneStore.open(paths.scenes), FrameStore.open(paths.frames)
    events = EventStore.open(paths.events)
    manifest, results = read_manifest(paths.images), read_results(paths.simulated)
    names = set(scenes.scene_of.values())
    pictures = [entry for entry in manifest.pictures if entry.name in names]  # others are too small for the sensor
    pictures.sort(key=lambda entry: entry.source == "dead_leaves")  # photographs first
    generated = {entry.name for entry in pictures if entry.source == "dead_leaves"}
    panels = sorted(
        results.panels, key=lambda p: (scenes.scene_of[p.sequence] in generated, -float(p.truth.dolp.std()))
    )
    return Artefacts(
        manifest=manifest,
        results=results._replace(panels=panels),
        sets=[read_results(one) for one in sorted(paths.benchmark.glob("sets/*")) if one.name != SIMULATED],
        ours=training_history(paths.train / OURS),
        baselines={name: training_history(paths.train / name) for name in baselines},
        budget=event_budget(paths.simulated / "frames.csv", events),
        overview=_overview(panels, scenes, frames, events),
        thumbnails={
            split: thumbnails([entry.name for entry in pictures if entry.split == split], scenes) for split in SPLITS
        },
    )


def read_results(folder: Path) -> Results:
    """Read a folder written by `write_benchmark`; the set's name comes from details.json, or from the folder."""
    details, costs = _json(folder / "details.json"), _json(folder / "cost.json")
    metrics = {row: {**scores, **costs[row]} for row, scores in _json(folder / "metrics.json").items()}
    return Results(
        details.get("set", folder.name), metrics, details, [*map(read_panel, sorted((folder / "panels").glob("*.npz")))]
    )


def results_table(results: Results) -> Table:
    """The scores of a test set, with labels that name the networks and a note on the windows that count."""
    labels, warmup_windows = legend_of(results.details["weights"]).labels, results.details["warmup_windows"]
    return score_table(results.metrics, labels=labels, warmup_windows=warmup_windows)


def training_history(folder: Path) -> History:
    """Mean loss terms and validation scores per epoch of a training, and the name of its network."""
    rows = read_history(folder)
    loss, validation = (
        {name: [row[split][name] for row in rows] for name in rows[0][split]} for split in ("train", "val")
    )
    best_epoch = rows.index(best_row(rows))
    return History(_json(folder / "best.json")["network"], loss, validation, best_epoch)


def thumbnails(pictures: Sequence[str], scenes: SceneStore) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
    """Thumbnails of the first `MAX_THUMBNAILS` pictures, from the scenes made of them."""
    sequence_of = {picture: sequence for sequence, picture in reversed(scenes.scene_of.items())}
    small = {}
    for picture in pictures[:MAX_THUMBNAILS]:
        scene = scenes.read(sequence_of[picture])
        rgb = polarization_hsv(scene.s0, scene.dolp, scene.aolp)
        size = (THUMBNAIL_WIDTH, round(THUMBNAIL_WIDTH * rgb.shape[0] / rgb.shape[1]))
        small[picture] = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    return small


def event_budget(file: Path, events: EventStore) -> list[BudgetPoint]:
    """Mean MSE of each method by bin of events per pixel (`BIN_EDGES`), from frames.csv and the events behind it."""
    with file.open(newline="") as stream:
        scores = [(row["method"], (row["sequence"], int(row["t_us"])), row["mse"]) for row in csv.DictReader(stream)]
    times: dict[str, list[int]] = {}
    for sequence, t_us in sorted({frame for _, frame, _ in scores}):
        times.setdefault(sequence, []).append(t_us)
    counts: dict[tuple[str, int], float] = {}
    for sequence, ends in times.items():
        per_pixel = events_per_pixel(events.read(sequence), torch.tensor(ends)).tolist()
        counts |= {(sequence, end): count for end, count in zip(ends, per_pixel, strict=True)}
    bins: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for method, frame, mse in scores:
        bins.setdefault((method, bisect(BIN_EDGES, counts[frame])), []).append((counts[frame], float(mse)))
    means = {key: np.mean(pairs, axis=0).tolist() for key, pairs in sorted(bins.items())}
    return [BudgetPoint(key[0], count, mse, len(bins[key])) for key, (count, mse) in means.items()]


def _overview(panels: Sequence[Panel], scenes: SceneStore, frames: FrameStore, events: EventStore) -> Overview | None:
    """Data of the first panel, which has the largest variation of the true DoLP; None without one of the network."""
    panel = next((panel for panel in panels if OURS in panel.predictions), None)
    if panel is None or panel.truth.aolp is None:
        return None
    scene = scenes.read(panel.sequence)
    start_us = int(frames.t_us(panel.sequence)[panel.window])
    trajectory = Trajectory.from_vector(scene.trajectory.numpy())
    path = trajectory.pose(np.linspace(0, scene.duration_us / 1e6, 200))
    outline = _outline(trajectory.pose(np.array([panel.t_us / 1e6])), scenes.sensor_height, scenes.sensor_width)
    size = np.array([[scene.s0.shape[1]], [scene.s0.shape[0]]])
    return Overview(
        name=panel.sequence,
        picture=polarization_hsv(scene.s0, scene.dolp, scene.aolp),
        path=np.stack([path.x, path.y]) / size,
        outline=outline / size,
        intensity=frames.intensity(panel.sequence)[panel.window + 1],
        dolp=panel.truth.dolp,
        aolp=panel.truth.aolp,
        streams=events.read(panel.sequence, start_us, panel.t_us),
        start_us=start_us,
        duration_us=panel.t_us - start_us,
        recovered=panel.predictions[OURS].dolp,
    )


def _outline(pose: Pose, height: int, width: int) -> Float[np.ndarray, "2 corners"]:
    """Corners of the sensor at the first pose, in pixels of the scene; the first is repeated to close the line."""
    left, top, along, across = sensor_to_scene(*(float(column[0]) for column in pose), height, width)
    columns, rows = np.array([[0, width, width, 0, 0], [0, 0, height, height, 0]])
    return np.stack([left + columns * along - rows * across, top + columns * across + rows * along])


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
