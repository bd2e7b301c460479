import csv
import dataclasses
import functools
import json
import math
import re

import pytest
import torch

from polarnet.benchmark.results import write_benchmark
from polarnet.benchmark.run import at_stored_precision, run_benchmark
from polarnet.benchmark.score import BenchmarkConfig
from polarnet.benchmark.sequences import BenchmarkSet, train_mean_dolp
from polarnet.metrics.references import REFERENCES
from polarnet.runtime.cluster import pmap
from polarnet.stokes import Prediction
from polarnet.storage.frames import Contents, FrameStore
from polarnet.storage.panels import read_panel

pytestmark = pytest.mark.usefixtures("brief_costs")

ROWS = ["zeros", "train_mean", "oracle_mean", "cf", "highpass+gain", "rotating_polarizer", "e2v", "e2p", "ours"]


def config(**changes):
    settings = BenchmarkConfig(ROWS, ["simulated"], 1, "fp32", False, "alex", 50, 2)
    return dataclasses.replace(settings, **changes)


def test_a_test_sequence_has_the_truth_at_window_ends_and_there_is_a_training_mean(five_scenes, make_sequence):
    sequences = [five_scenes.sequence(name) for name in five_scenes.sequences]
    assert [(r.name, r.scene) for r in sequences] == [("a1", "lake"), ("a2", "lake"), ("b1", "wood"), ("c1", "town")]
    expected = make_sequence("a1", seed=1)
    torch.testing.assert_close(sequences[0].dolp, expected.dolp, atol=1e-5, rtol=0)
    torch.testing.assert_close(sequences[0].s0, expected.s0, atol=2e-5, rtol=0)
    assert torch.equal(sequences[0].events[3].t, expected.events[3].t)
    training_mean = make_sequence("t1", seed=0).dolp[1:].mean().item()
    assert train_mean_dolp(five_scenes.frames, 1) == pytest.approx(training_mean, abs=1e-5)


def test_the_whole_benchmark_on_small_test_set(five_scenes, context, tmp_path):
    benchmark = run_benchmark(five_scenes, context, config(), None)
    folder = tmp_path / "benchmark"
    returned = write_benchmark(folder, benchmark, config(), 1, {"lpips": {"backbone": None}, "train_mean": 0.25})
    metrics, costs = (json.loads((folder / f"{name}.json").read_text()) for name in ("metrics", "cost"))
    assert returned == {row: metrics[row] | costs[row] for row in metrics}
    assert list(metrics) == list(costs) == ROWS
    for row, scores in metrics.items():
        assert costs[row]["ms_per_window"] > 0
        assert not set(costs[row]) & set(scores)
        assert scores["lpips"] is None
        assert "lpips_backbone" not in scores
        assert scores["mse_ci"][0] <= scores["mse"] <= scores["mse_ci"][1]
        assert scores["mse"] == pytest.approx(scores["level_mse"] + scores["pattern_mse"], rel=1e-4)
    assert metrics["oracle_mean"]["skill"] == pytest.approx(0, abs=1e-3)  # frames are scored in steps of 1/65535
    assert metrics["zeros"]["aolp_deg"] is None
    assert 0 < metrics["cf"]["aolp_deg"] < 90
    assert costs["ours"]["gflop"] > 0
    assert costs["ours"]["params"] > 1000
    assert costs["cf"]["gflop"] is None
    assert metrics["zeros"]["corr"] == metrics["oracle_mean"]["corr"] == 0
    assert metrics["oracle_mean"]["mse"] < min(metrics["zeros"]["mse"], metrics["train_mean"]["mse"])
    with (folder / "frames.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(ROWS) * 4 * 3
    assert {line["lpips"] for line in lines} == {""}
    details = json.loads((folder / "details.json").read_text())
    assert details["lpips"] == {"backbone": None}
    assert details["scenes"] == ["lake", "town", "wood"]
    assert details["frames"] == 12
    assert "lpips" not in details["scene_means"]
    assert details["paired"]["cf"]["scenes"] == 3
    assert set(details["paired"]) == set(ROWS) - {"ours"}
    assert set(details["scene_means"]["ssim"]["cf"]) == {"lake", "town", "wood"}


def test_expected_errors_are_held_against_those_of_scored_windows(five_scenes, context, tmp_path, monkeypatch):
    def sure(truth, valid, train_mean):
        """Off by 0.1 everywhere and knows it, but in the warm-up."""
        log_variance = torch.full_like(truth, math.log(0.01))
        log_variance[0] = 0.0
        return Prediction(truth + torch.where(truth < 0.5, 0.1, -0.1), None, log_variance)

    monkeypatch.setitem(REFERENCES, "train_mean", dataclasses.replace(REFERENCES["train_mean"], predict=sure))
    benchmark = run_benchmark(five_scenes, context, config(methods=["zeros", "train_mean"]), None)
    assert set(benchmark.reliability) == {"train_mean"}
    assert benchmark.reliability["train_mean"].pixels.sum() == 4 * 3 * 18 * 20
    assert benchmark.reliability["train_mean"].log_error() < 0.01
    write_benchmark(tmp_path / "out", benchmark, config(methods=["zeros", "train_mean"]), 1, {})
    written = json.loads((tmp_path / "out" / "details.json").read_text())["reliability"]["train_mean"]
    ((predicted, measured, pixels),) = written["curve"]
    assert (predicted, measured, pixels) == (pytest.approx(0.01, rel=0.01), pytest.approx(0.01, rel=0.01), 4320)


def test_panels_show_one_window_of_different_scenes_and_every_method(five_scenes, context, tmp_path):
    wanted = config(methods=["zeros", "cf"])
    benchmark = run_benchmark(five_scenes, context, wanted, None)
    assert [(panel.sequence, panel.window, panel.t_us) for panel in benchmark.panels] == [
        ("a1", 2, 3000),
        ("c1", 2, 3000),
    ]
    folder = tmp_path / "benchmark"
    (folder / "panels").mkdir(parents=True)
    (folder / "panels" / "old.npz").touch()
    write_benchmark(folder, benchmark, wanted, 1, {})
    assert {p.name for p in (folder / "panels").iterdir()} == {"a1.npz", "c1.npz"}
    written, given = read_panel(folder / "panels" / "a1.npz"), benchmark.panels[0]
    assert written.events.shape == (4, 18, 20)
    assert torch.equal(written.film_events, given.film_events)
    assert list(written.predictions) == ["zeros", "cf"]
    assert torch.equal(written.predictions["cf"].aolp, given.predictions["cf"].aolp)
    assert written.predictions["zeros"].aolp is None
    assert torch.equal(written.truth.film_aolp, given.truth.film_aolp)


def test_no_test_sequence_is_an_error(five_scenes, context, tmp_path):
    frames = FrameStore.create(tmp_path / "f.zarr", Contents({"t1": "train"}), 18, 20)
    frames.write("t1", *five_scenes.frames.frames("t1"))
    frames.finish()
    without = BenchmarkSet("simulated", five_scenes.events, FrameStore.open(tmp_path / "f.zarr"))
    with pytest.raises(ValueError, match=r"has no test sequence; raise ingest.test_fraction"):
        run_benchmark(without, context, config(), None)


def test_a_prediction_is_scored_in_the_steps_of_the_stored_truth(sequence):
    given = Prediction(sequence.dolp, sequence.aolp, 3 * sequence.dolp - 4)
    stored = at_stored_precision(given)
    torch.testing.assert_close(stored.dolp, given.dolp, atol=0.51 / 65535, rtol=0)
    torch.testing.assert_close(stored.log_variance, given.log_variance, atol=0.002, rtol=0)
    again = at_stored_precision(stored)
    assert all(torch.equal(one, two) for one, two in zip(stored[:3], again[:3], strict=True))
    assert at_stored_precision(Prediction(sequence.dolp)).aolp is None


def test_a_log_shows_the_progress_of_a_benchmark_method_by_method(five_scenes, context, progress_log):
    mapper = functools.partial(pmap, workers=1, label="test")
    run_benchmark(five_scenes, context, config(methods=["zeros", "cf"]), None, mapper)
    lines = progress_log()
    shares = re.findall(r"test: .+\| ([\d.]+)/4 ", "\n".join(lines))
    assert list(dict.fromkeys(shares)) == ["0", "0.5", "1", "1.5", "2", "2.5", "3", "3.5", "4"]
    assert sum(line.startswith("cost: ") for line in lines) == 3
