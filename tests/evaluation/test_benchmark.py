import json

import numpy as np
import pytest
import torch

from polarnet.evaluation.benchmark import recordings_of, run_benchmark, train_mean_dolp, write_benchmark
from polarnet.evaluation.methods import METHODS
from polarnet.evaluation.score import BenchmarkConfig
from polarnet.events.frames import FrameStore
from polarnet.events.store import EventStore
from polarnet.stokes import intensities_from_stokes, stokes_from_polarization

SCENES = {"t1": "photo", "a1": "lake", "a2": "lake", "b1": "wood", "c1": "town"}


@pytest.fixture
def stores(make_recording, tmp_path):
    splits = {name: "train" if name.startswith("t") else "test" for name in SCENES}
    frames = FrameStore.create(tmp_path / "frames.zarr", list(SCENES), splits, 5, 18, 20, {"scenes": SCENES})
    events = EventStore.create(tmp_path / "events.zarr", list(SCENES), 18, 20, {})
    for seed, name in enumerate(SCENES):
        made = make_recording(name, seed=seed)
        dolp, aolp, s0 = (torch.cat([x[:1], x]) for x in (made.dolp, made.aolp, made.s0))
        frames.write(name, made.t_us, intensities_from_stokes(stokes_from_polarization(s0, dolp, aolp)), dolp, aolp)
        events.write(name, made.events, 4000)
    for store in (frames, events):
        store.finish()
    return EventStore.open(tmp_path / "events.zarr"), FrameStore.open(tmp_path / "frames.zarr")


def config(**changes):
    values = {"methods": list(METHODS), "warmup_windows": 1, "precision": "fp32", "bootstrap_samples": 50}
    return BenchmarkConfig(**{**values, "panel_scenes": 2, **changes})


def test_a_recording_is_a_test_sequence_with_the_truth_at_the_end_of_each_window(stores, make_recording):
    recordings = list(recordings_of("test", *stores))
    assert [(r.name, r.scene) for r in recordings] == [("a1", "lake"), ("a2", "lake"), ("b1", "wood"), ("c1", "town")]
    made = make_recording("a1", seed=1)
    torch.testing.assert_close(recordings[0].dolp, made.dolp, atol=1e-5, rtol=0)
    torch.testing.assert_close(recordings[0].s0, made.s0, atol=2e-5, rtol=0)
    assert torch.equal(recordings[0].events[3].t, made.events[3].t)


def test_the_training_mean_counts_training_frames_after_the_warm_up(stores, make_recording):
    expected = make_recording("t1", seed=0).dolp[1:].mean().item()
    assert train_mean_dolp(stores[1], 1) == pytest.approx(expected, abs=1e-5)


def test_the_whole_benchmark_on_small_stores(stores, context, tmp_path):
    benchmark = run_benchmark(*stores, context, config(), None)
    folder = tmp_path / "benchmark"
    returned = write_benchmark(folder, benchmark, config(), 1, {"lpips": {"reason": "no weights"}, "train_mean": 0.25})
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics == returned
    assert list(metrics) == list(METHODS)
    for scores in metrics.values():
        assert scores["ms_per_window"] > 0
        assert scores["lpips"] is None
        assert scores["mse_ci"][0] <= scores["mse"] <= scores["mse_ci"][1]
        assert scores["mse"] == pytest.approx(scores["level_mse"] + scores["pattern_mse"], rel=1e-4)
    assert metrics["zeros"]["corr"] == metrics["oracle_mean"]["corr"] == 0
    assert metrics["oracle_mean"]["mse"] < min(metrics["zeros"]["mse"], metrics["train_mean"]["mse"])
    assert len((folder / "frames.csv").read_text().splitlines()) == 1 + len(METHODS) * 4 * 3
    details = json.loads((folder / "details.json").read_text())
    assert details["lpips"]["reason"] == "no weights"
    assert details["scenes"] == ["lake", "town", "wood"]
    assert details["frames"] == 12
    assert "lpips" not in details["scene_means"]
    assert set(details["scene_means"]["ssim"]["cf"]) == {"lake", "town", "wood"}


def test_panels_show_one_window_of_different_scenes_and_every_method(stores, context, tmp_path):
    wanted = config(methods=["zeros", "cf"])
    benchmark = run_benchmark(*stores, context, wanted, None)
    assert [(p.sequence, p.scene, p.window, p.t_us) for p in benchmark.panels] == [
        ("a1", "lake", 2, 3000),
        ("c1", "town", 2, 3000),
    ]
    folder = tmp_path / "benchmark"
    (folder / "panels").mkdir(parents=True)
    (folder / "panels" / "old.npz").touch()
    write_benchmark(folder, benchmark, wanted, 1, {})
    assert {p.name for p in (folder / "panels").iterdir()} == {"a1.npz", "c1.npz"}
    with np.load(folder / "panels" / "a1.npz") as panel:
        assert set(panel.files) == {
            *("window", "t_us", "events", "truth_dolp", "truth_aolp", "truth_s0", "dolp_zeros", "dolp_cf", "aolp_cf"),
        }
        assert panel["events"].shape == (4, 18, 20)
        assert panel["dolp_cf"].dtype == np.float32


def test_all_but_the_time_is_the_same_in_two_runs(stores, context, tmp_path):
    some = config(methods=["cf", "firenet", "ours"])
    for name in ("one", "two"):
        write_benchmark(tmp_path / name, run_benchmark(*stores, context, some, None), some, 1, {})
    for file in ("frames.csv", "details.json", "panels/a1.npz"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_no_test_sequence_is_an_error(stores, context, tmp_path):
    frames = FrameStore.create(tmp_path / "f.zarr", ["t1"], {"t1": "train"}, 5, 18, 20, {})
    frames.write("t1", *stores[1].frames("t1"))
    frames.finish()
    with pytest.raises(ValueError, match=r"has no test sequence; raise ingest.test_fraction"):
        run_benchmark(stores[0], FrameStore.open(tmp_path / "f.zarr"), context, config(), None)
