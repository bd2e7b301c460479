import pytest
from ruamel.yaml import YAML

from polarnet.training.engine.history import HISTORY, best_row, read_history, write_history

ROWS = [
    {"epoch": 0, "train": {"total": 1 / 3, "ssim_loss": 0.5}, "val": {"mse": 0.25, "psnr": 6.0}},
    {"epoch": 1, "train": {"total": 1e-17, "ssim_loss": 0.1}, "val": {"mse": 0.25, "psnr": float("nan")}},
]


def test_a_history_is_read_to_the_last_digit(tmp_path):
    write_history(tmp_path, ROWS)
    assert (tmp_path / HISTORY).read_text().splitlines()[0] == "epoch,train_total,train_ssim_loss,val_mse,val_psnr"
    assert str(read_history(tmp_path)) == str(ROWS)


def test_the_first_of_equally_good_epochs_is_the_best():
    assert best_row(ROWS) is ROWS[0]


def test_a_history_without_epochs_is_an_error(tmp_path):
    (tmp_path / HISTORY).write_text("epoch,train_total\n")
    with pytest.raises(ValueError, match="a line for each epoch"):
        read_history(tmp_path)


def test_dvc_plots_draw_columns_of_a_history(tmp_path, project_root):
    write_history(tmp_path, [{"epoch": 0, "train": {"total": 1.0}, "val": {"total": 1.0, "psnr": 1.0}}])
    columns = set((tmp_path / HISTORY).read_text().splitlines()[0].split(","))
    curves, psnr = YAML(typ="safe").load(project_root / "dvc.yaml")["plots"]
    assert {curves["data/benchmark/history"]["x"], *curves["data/benchmark/history"]["y"]} <= columns
    (settings,) = psnr.values()
    assert {settings["x"], *settings["y"].values()} <= columns
