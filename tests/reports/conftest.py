"""A pipeline's outputs in miniature: real stores and files, three pictures of 48x72 px, windows of 24x36 px."""

import json
import math

import numpy as np
import pytest
import torch
from event_fixtures import random_events

from polarnet.benchmark.results import write_benchmark
from polarnet.benchmark.run import Benchmark, panel_of
from polarnet.benchmark.score import BenchmarkConfig, Cost, score_sequence
from polarnet.benchmark.sequences import BenchmarkSet
from polarnet.pictures.images import write_png
from polarnet.pictures.manifest import Manifest, ManifestEntry, Skipped, write_manifest
from polarnet.reports.artefacts import ReportPaths
from polarnet.runtime.files import seal
from polarnet.simulation.motion import SynthesizeConfig
from polarnet.simulation.truth import Synthesis, synthesize
from polarnet.stokes import Prediction
from polarnet.storage import EventStore, FrameStore
from polarnet.training.engine.recorder import write_history

SPLITS = {"park": "train", "lake": "val", "tree": "test", "leaf": "test"}
HISTORY = [
    {"epoch": e, "train": {"total": 1.0 / (e + 1), "mse": 0.1 / (e + 1)}, "val": {"mse": mse, "psnr": 10.0 + e}}
    for e, mse in enumerate((0.09, 0.04, 0.05))
]


def picture(phase):
    """Hue from left to right, saturation from top to bottom, so that every DoLP and AoLP occurs."""
    down, across = np.mgrid[0:1:48j, 0:1:72j].astype(np.float32)
    hue = 2 * math.pi * (across + phase)[..., None] + np.array([0, -2, 2], dtype=np.float32) * math.pi / 3
    return (1 - down[..., None] * (0.5 - 0.5 * np.cos(hue))).astype(np.float32)


def write_images(folder):
    folder.mkdir()
    entries = []
    for i, (name, split) in enumerate(SPLITS.items()):
        write_png(folder / f"{name}.png", picture(i / 5), bits=8)
        source = "dead_leaves" if name == "leaf" else "photograph"
        entries.append(
            ManifestEntry(
                name=name, file=f"{name}.png", split=split, source=source, origin=f"https://example.org/{name}",
                licence="CC0-1.0", author="<b>Ann</b>", sha256="0" * 64, height=48, width=72,
            )
        )  # fmt: skip
    write_manifest(Manifest(tuple(entries), (Skipped("broken.jpg", "cannot be read: ends early"),), 0, 0), folder)


def write_events(path, frames):
    store = EventStore.create(path, frames.sequences, 24, 36, {})
    for i, sequence in enumerate(frames.sequences):
        channels = [random_events(4 * i + c, 500, 200_000, 24, 36) for c in range(4)]
        store.write(sequence, channels, 200_000)
    store.finish()


def run_methods(events, frames, folder):
    """Benchmark outputs for two constants, E2V (with AoLP) and ours, of the true frames made worse."""
    methods = ["zeros", "oracle_mean", "e2v", "ours"]
    config = BenchmarkConfig(
        methods, ["simulated"], warmup_windows=1, precision="fp32", lpips=False, lpips_backbone="alex",
        bootstrap_samples=20, panel_scenes=2,
    )  # fmt: skip
    rows, panels = [], []
    test_set = BenchmarkSet("simulated", events, frames)
    for sequence in map(test_set.sequence, test_set.sequences):
        truth = sequence.dolp
        mean = truth.mean(dim=(-2, -1), keepdim=True)
        dolp = {"zeros": 0 * truth, "oracle_mean": 0 * truth + mean, "e2v": (truth + mean) / 2, "ours": 0.9 * truth}
        answers = {method: Prediction(frames) for method, frames in dolp.items()}
        answers["e2v"] = Prediction(dolp["e2v"], sequence.aolp)
        rows += score_sequence(sequence, answers, 1, None, torch.device("cpu"))
        panels.append(panel_of(sequence, answers, 1))
    about = {
        "lpips": {"backbone": None, "sha256": None, "source": None},
        "weights": {
            "e2v": {"file": "best.safetensors", "sha256": "e2" * 32, "network": "firenet"},
            "ours": {"file": "best.safetensors", "sha256": "5ca1ab1e" * 8, "network": "paper"},
        },
        "conditions": {"sentence": "Sequences of 24x36 pixels (height x width), 0.2 s at 30 frames a second."},
    }
    costs = dict.fromkeys(methods, Cost(1.5, None, 0)) | {"ours": Cost(1.5, 10.4, 37_777)}
    write_benchmark(folder, Benchmark(rows, costs, panels), config, seed=1, about=about)


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    """The folder of a pipeline's outputs."""
    data = tmp_path_factory.mktemp("data")
    write_images(data / "images")
    motion = SynthesizeConfig(
        sequences_per_picture=1, duration_s=0.2, frame_rate_hz=30.0, sensor_height=24, sensor_width=36,
        speed_min_px_s=10.0, speed_max_px_s=20.0, acceleration_max_px_s2=800.0, rotation_max_deg=0.0, zoom_max=1.0,
        dynamic_range=None,
    )  # fmt: skip
    synthesize(Synthesis(data / "images", motion, 1, 2), data / "scenes.zarr", data / "frames.zarr", map)
    frames = FrameStore.open(data / "frames.zarr")
    write_events(data / "events.zarr", frames)
    run_methods(EventStore.open(data / "events.zarr"), frames, data / "benchmark" / "sets" / "simulated")
    for name, network in (("ours", "paper"), ("e2v", "firenet")):
        folder = data / "train" / name
        folder.mkdir(parents=True)
        write_history(folder, HISTORY)
        (folder / "best.json").write_text(json.dumps({"network": network}))
        seal(folder)
    return data


@pytest.fixture(scope="session")
def paths(data):
    return ReportPaths(data / "images", data / "scenes.zarr", data / "train", data / "benchmark")
