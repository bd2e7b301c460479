import csv
import io
import json

import pytest
from omegaconf import OmegaConf

from polarnet.config.sweep import SweepTable, mark_finished, sweep_points, sweep_rows, why_unfinished
from polarnet.runtime.files import seal


def scored(mse, lpips=None):
    return {"mse": mse, "psnr": 15.0, "ssim": 0.5, "lpips": lpips, "corr": 0.25}


def write_trial(job, overrides=(), seed=1, validation=None, test=None, failure=None):
    """The folder of one job of a sweep of `stages.trial`, in miniature."""
    files = {".hydra/config.yaml": json.dumps({"seed": seed}), ".hydra/overrides.yaml": json.dumps(list(overrides))}
    if validation or test:
        scores = validation or {"mse": 0.5, "psnr": 3.0}
        row = {"epoch": 0, "train_total": 0.5} | {f"val_{name}": value for name, value in scores.items()}
        files["train/ours/history.csv"] = f"{','.join(row)}\n{','.join(map(str, row.values()))}\n"
    if test:
        files["benchmark/metrics.json"] = json.dumps({"simulated": {"ours": test, "zeros": {}}})
    if failure:
        files["failure.txt"] = f"{failure}\n"
    for name, text in files.items():
        (job / name).parent.mkdir(parents=True, exist_ok=True)
        (job / name).write_text(text)
    if validation or test:
        seal(job / "train" / "ours")


@pytest.fixture
def sweep(tmp_path):
    """Four jobs: two seeds of one point, a point with better test and worse validation scores, a point that failed."""
    ssim = ["loss.ssim=0.0"]
    validation = {"mse": 0.03, "psnr": 14.0}
    write_trial(tmp_path / "0", [*ssim, "seed=1"], validation=validation, test=scored(0.04))
    write_trial(tmp_path / "1", [*ssim, "seed=2"], seed=2, validation={**validation, "mse": 0.05}, test=scored(0.06))
    write_trial(tmp_path / "2", ["loss.ssim=1.0"], validation={**validation, "mse": 0.08}, test=scored(0.01, lpips=0.3))
    write_trial(tmp_path / "10", ["loss.mse=-1.0"], failure="train: configuration error: loss.mse: expected >= 0")
    (tmp_path / "11").mkdir()  # not a trial
    return tmp_path


def test_rows_are_ranked_by_validation_scores_and_seeds_become_mean_and_standard_deviation(sweep):
    rows = sweep_rows(sweep_points(sweep))
    assert [row["jobs"] for row in rows] == ["0 1", "2", "10"]  # by test scores 2 would be the first
    assert rows[0]["seeds"] == "1 2"
    assert rows[0]["point"] == "loss.ssim=0.0"
    assert (rows[0]["validation_mse"], rows[0]["validation_mse_std"]) == pytest.approx((0.04, 0.0002**0.5))
    assert (rows[1]["test_mse"], rows[1]["test_mse_std"]) == (0.01, None)
    assert (rows[2]["validation_mse"], rows[2]["test_mse"], rows[2]["point"]) == (None, None, "loss.mse=-1.0")
    assert rows[2]["failures"] == "seed 1 failed: train: configuration error: loss.mse: expected >= 0"


def test_a_point_is_named_by_the_overrides_that_not_all_share_and_a_failed_seed_counts_in_no_mean(tmp_path):
    for number, weight in enumerate(("0.0", "1.0")):
        write_trial(tmp_path / "a" / str(number), ["network=paper", f"loss.ssim={weight}"], test=scored(0.04))
    assert [row["point"] for row in sweep_rows(sweep_points(tmp_path / "a"))] == ["loss.ssim=0.0", "loss.ssim=1.0"]
    one, other = tmp_path / "b" / "0", tmp_path / "b" / "1"
    write_trial(one, ["seed=1"], validation={"mse": 0.03, "psnr": 14.0}, test=scored(0.04))
    write_trial(other, ["seed=2"], seed=2, validation={"mse": 9.0, "psnr": 14.0}, failure="benchmark: killed")
    (row,) = sweep_rows(sweep_points(tmp_path / "b"))
    assert (row["point"], row["seeds"]) == ("params.yaml", "1")
    assert (row["validation_mse"], row["validation_mse_std"]) == (0.03, None)
    assert row["failures"] == "seed 2 failed: benchmark: killed"


def test_a_sweep_with_a_failed_point_writes_its_tables_and_ends_with_an_error(sweep, capsys):
    with pytest.raises(SystemExit, match="1 of 4 points failed"):
        SweepTable().on_multirun_end(OmegaConf.create({"hydra": {"sweep": {"dir": str(sweep)}}}))
    lines = list(csv.DictReader(io.StringIO((sweep / "comparison.csv").read_text())))
    assert [line["validation_mse"] for line in lines] == ["0.04", "0.08", ""]
    assert lines[0]["seeds"] == "1 2"
    assert str(sweep / "comparison.csv") in capsys.readouterr().out
    assert (sweep / "comparison.png").read_bytes().startswith(b"\x89PNG")


def test_a_job_is_finished_for_its_own_values_and_inputs_alone_and_says_what_changed(tmp_path):
    record = {"values": {"loss": {"mse": 10.0}}, "inputs": {"data/events.zarr": "ab"}}
    assert why_unfinished(tmp_path, record) == "it has not finished"
    mark_finished(tmp_path, record)
    assert why_unfinished(tmp_path, record) is None
    assert why_unfinished(tmp_path, record | {"values": {"loss": {"mse": 12.0}}}) == "values.loss.mse was 10.0, is 12.0"
    assert why_unfinished(tmp_path, record | {"inputs": {"data/events.zarr": "cd"}}).startswith("inputs.data/events")
