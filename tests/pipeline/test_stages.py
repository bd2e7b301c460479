"""The stages themselves, at toy size, with the command lines that DVC calls (`trial` starts two as DVC does)."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import preloaded
import pytest
import torch
from part_fixtures import files_of

from polarnet.benchmark import rows
from polarnet.config.origins import pipeline
from polarnet.config.sweep import sweep_points
from polarnet.config.tree import load
from polarnet.metrics.lpips import record_of
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.pictures.manifest import read_manifest
from polarnet.simulation.scene import scene_from_rgb
from studies.simulated_rig import RigConfig, write_rig

TINY = [
    "ingest.dead_leaves=1", "ingest.height=120", "ingest.width=180", "ingest.val_fraction=0.2",
    "synthesize.duration_s=0.2", "synthesize.sensor_height=32", "synthesize.sensor_width=48",
    "networks.polarnet.channels=[8,8,8]", "networks.polarnet.reach=4",
    *(f"{section}.{key}" for section in ("train", "baselines.e2v", "baselines.e2p")
      for key in ("epochs=1", "visits=1", "windows=2", "crop=null", "bptt_windows=2")),
    "benchmark.warmup_windows=1", "benchmark.bootstrap_samples=20", "benchmark.panel_scenes=1", "runtime.threads=1",
]  # fmt: skip
MORE_ROWS = [
    "baselines.trained=[e2v,e2p]",
    "+rows.e2p={needs: data/train/e2p, settings: benchmark.precision}",
    "+rows.firenet_published={needs: data/external/firenet_1000.pth.tar, settings: benchmark.precision}",
    "benchmark.methods=[zeros,train_mean,oracle_mean,cf,highpass,cf+gain,e2v,firenet_published,e2p,ours]",
]
GENERATED = ("images", "scenes.zarr", "frames.zarr", "events.zarr")


def run_stage(root: Path, stage: str, data: Path, *overrides: str) -> str:
    arguments = [*TINY, *MORE_ROWS, f"paths.data={data}", f"paths.resume={data / 'resume'}",
                 f"hydra.run.dir={data / 'logs' / stage}", *overrides]  # fmt: skip
    done = preloaded.run_stage(root, stage, arguments, save_time)
    assert done.returncode == 0, done.stdout
    return done.stdout


def run_pipeline(root: Path, data: Path, *overrides: str) -> None:
    """Run every stage once, with all rows in one pass."""
    config = load(root, [*TINY, *MORE_ROWS, *overrides])
    for stage in pipeline(root, dataclasses.asdict(config)).values():
        unused = stage.script == "train" and stage.overrides and stage.overrides[0][9:] not in config.used_baselines
        if stage.script != "row" and not unused:
            if stage.script == "report":
                run_stage(root, "row", data, *overrides)
            run_stage(root, stage.script, data, *overrides, *stage.overrides)


def save_time() -> None:
    """Measure the cost of a row on one window, which else takes longer than the scores; fork workers, if any."""
    rows.COUNTED_WINDOWS = rows.TIMED_WINDOWS = rows.REPEATS = 1
    preloaded.fork_workers_too()


@pytest.fixture(scope="module")
def data(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data folder after the whole pipeline ran with one worker."""
    folder = tmp_path_factory.mktemp("pipeline") / "data"
    run_pipeline(project_root, folder)
    return folder


@pytest.mark.thorough
def test_the_benchmark_has_a_row_for_every_method_with_lpips_and_says_of_which_backbone(data):
    metrics = json.loads((data / "benchmark" / "metrics.json").read_text())["simulated"]
    assert set(metrics) == {"zeros", "train_mean", "oracle_mean", "cf", "highpass", "cf+gain", "e2v", "e2p", "ours"}
    details = json.loads((data / "benchmark" / "sets" / "simulated" / "details.json").read_text())
    assert set(details["left_out"]) == {"firenet_published"}
    assert set(details["weights"]) == {"e2v", "e2p", "ours"}
    assert details["lpips"] == record_of("alex")
    for network in ("ours", "e2v", "e2p"):
        trained = json.loads((data / "train" / network / "best.json").read_text())["lpips"]
        assert trained == {key: record_of("alex")[key] for key in ("backbone", "sha256")}
    costs = json.loads((data / "benchmark" / "sets" / "simulated" / "cost.json").read_text())
    assert list(costs) == list(metrics)
    for method, row in metrics.items():
        assert {"mse", "psnr", "ssim", "lpips", "corr"} <= set(row), method
        assert costs[method]["ms_per_window"] > 0
        assert 0 <= row["mse"] <= 1
        assert row["lpips"] > 0, method
        assert row["lpips_backbone"] == "alex"
    assert metrics["oracle_mean"]["mse"] <= min(metrics["zeros"]["mse"], metrics["train_mean"]["mse"])


RIG = RigConfig(speed_px_s=80.0, longest_delay_s=0.25, duration_s=0.3, hot_pixels=3)
RIG_SIZE = {"sensor": [96, 160], "region": [24, 2], "negative_events": 24, "crop": [64, 96], "size": [16, 24]}


@pytest.fixture(scope="module")
def paper(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data folder after experiment=paper on the eight built-in photographs and one target of a simulated rig."""
    folder = tmp_path_factory.mktemp("paper")
    config = load(project_root, ["experiment=paper"])
    captures = dataclasses.replace(config.recordings, **RIG_SIZE)
    picture = dead_leaves(np.random.default_rng(3), 96, 200)
    scene = scene_from_rgb(torch.from_numpy(picture).permute(2, 0, 1) * 0.85 + 0.1)
    emulator = dataclasses.replace(config.emulate, model="exact", render_rate_hz=300.0, cutoff_hz=3000.0)
    write_rig(folder / "targets" / "one", scene, RIG, captures, emulator, seed=1)
    size = [f"recordings.{key}={value}".replace(" ", "") for key, value in RIG_SIZE.items()]
    overrides = [
        "experiment=paper", "ingest.source=builtin", "ingest.dead_leaves=0", "ingest.test_fraction=0.2",
        "synthesize.sensor_height=24", "synthesize.sensor_width=32",
        "benchmark.methods=[zeros,cf,e2v,ours]", "recordings.enabled=true", f"recordings.root={folder / 'targets'}",
        *size,
    ]  # fmt: skip
    run_pipeline(project_root, folder / "data", *overrides)
    return folder / "data"


@pytest.mark.thorough
def test_the_paper_experiment_goes_through_every_stage_and_leaves_its_figures(paper):
    assert read_manifest(paper / "images").counts["train"] == 4  # of 8 photographs
    networks = {name: json.loads((paper / "train" / name / "best.json").read_text()) for name in ("ours", "e2v")}
    assert {name: one["network"] for name, one in networks.items()} == {"ours": "paper", "e2v": "e2vid"}
    assert networks["ours"]["lpips"]["backbone"] == "vgg"
    assert not (paper / "train" / "e2p").exists()
    for metrics in json.loads((paper / "benchmark" / "metrics.json").read_text()).values():
        assert list(metrics) == ["zeros", "cf", "e2v", "ours"]
        assert all(row["lpips_backbone"] == "vgg" and row["lpips"] > 0 for row in metrics.values())
    calibration = json.loads((paper / "calibrated" / "calibration.json").read_text())["one"]
    assert calibration["start_us"] == calibration["landmark_us"]
    assert not any(calibration["hot_pixels"].values())
    assert (paper / "calibrated" / "one_figure_8.pdf").stat().st_size > 0
    figures = {f"comparison_{one}.{kind}" for one in ("simulated", "recordings") for kind in ("png", "pdf")}
    assert {path.name for path in (paper / "report").iterdir()} >= {"index.html"} | figures


@pytest.mark.thorough
def test_the_same_values_give_the_same_bytes_whatever_the_number_of_workers(project_root, data, tmp_path):
    for stage in ("ingest", "synthesize", "emulate"):
        run_stage(project_root, stage, tmp_path, "runtime.workers=2", "runtime.threads=2")
    for name in GENERATED:
        assert files_of(tmp_path / name) == files_of(data / name), name


@pytest.mark.thorough
def test_a_point_of_a_sweep_leaves_what_the_pipeline_made_and_kept_alone(project_root, data, tmp_path):
    parts = ("train", "benchmark")
    before = {name: files_of(data / name) for name in parts}
    run_stage(project_root, "trial", data, "loss.ssim=0.5", f"hydra.sweep.dir={tmp_path}", "--multirun")
    assert {name: files_of(data / name) for name in parts} == before
    (point,) = sweep_points(tmp_path)
    assert "loss.ssim=0.5" in point["overrides"]
    own = json.loads((tmp_path / point["job"] / "benchmark" / "metrics.json").read_text())["simulated"]
    whole = json.loads((data / "benchmark" / "metrics.json").read_text())["simulated"]
    assert point["test"] == own["ours"] != whole["ours"]
    assert own["oracle_mean"]["mse"] == whole["oracle_mean"]["mse"]


@pytest.mark.parametrize(
    ("stage", "overrides", "message"),
    [
        ("emulate", [], "run the stage that writes it"),
        ("train", ["benchmark.methods=[zeros,e2v,ours]", "baseline=e2p"],
         "no row of benchmark.methods uses the weights of baselines.e2p"),
    ],
)  # fmt: skip
def test_a_stage_without_its_input_or_that_nothing_uses_says_so(project_root, tmp_path, stage, overrides, message):
    arguments = [*TINY, *overrides, f"paths.data={tmp_path / 'data'}", f"hydra.run.dir={tmp_path / 'log'}"]
    done = preloaded.run_stage(project_root, stage, arguments)
    assert done.returncode != 0
    assert message in done.stdout
    assert not (tmp_path / "data").exists()
