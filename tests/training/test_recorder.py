from multiprocessing import get_context

import pytest
from ruamel.yaml import YAML

from polarnet.runtime.files import seal
from polarnet.training.engine.recorder import HISTORY, Recorder, best_row, read_history, write_history


@pytest.mark.parametrize(("out", "seed", "named"), [("out", 2, "out"), ("other", 1, r"resume/\w{16}")])
def test_a_training_with_the_output_folder_of_another_or_equal_to_it_is_refused(tmp_path, out, seed, named):
    fork = get_context("fork")
    first = fork.Process(target=hold, args=(tmp_path, ready := fork.Event(), end := fork.Event()))
    first.start()
    assert ready.wait(60)
    with pytest.raises(ValueError, match=rf"{named}: another process is writing it"):
        Recorder(tmp_path / out, tmp_path / "resume", {"seed": seed})
    end.set()
    first.join()
    assert first.exitcode == 0


def hold(folder, ready, end):
    """A training that has begun and ends when it is told to."""
    recorder = Recorder(folder / "out", folder / "resume", {"seed": 1})
    ready.set()
    end.wait(60)
    recorder.finish()


ROWS = [
    {"epoch": 0, "train": {"total": 1 / 3, "ssim_loss": 0.5}, "val": {"mse": 0.25, "psnr": 6.0}},
    {"epoch": 1, "train": {"total": 1e-17, "ssim_loss": 0.1}, "val": {"mse": 0.25, "psnr": float("nan")}},
]


def test_a_history_is_read_to_the_last_digit_and_refused_without_epochs(tmp_path):
    write_history(tmp_path, ROWS)
    seal(tmp_path)
    assert (tmp_path / HISTORY).read_text().splitlines()[0] == "epoch,train_total,train_ssim_loss,val_mse,val_psnr"
    assert str(read_history(tmp_path)) == str(ROWS)
    assert best_row(ROWS) is ROWS[0]  # the first of equally good epochs
    (tmp_path / HISTORY).write_text("epoch,train_total\n")
    seal(tmp_path)
    with pytest.raises(ValueError, match="a line for each epoch"):
        read_history(tmp_path)


def test_dvc_plots_draw_columns_of_a_history(tmp_path, project_root):
    write_history(tmp_path, [{"epoch": 0, "train": {"total": 1.0}, "val": {"total": 1.0, "psnr": 1.0}}])
    columns = set((tmp_path / HISTORY).read_text().splitlines()[0].split(","))
    curves, psnr = YAML(typ="safe").load(project_root / "dvc.yaml")["plots"]
    assert {curves["data/benchmark/history"]["x"], *curves["data/benchmark/history"]["y"]} <= columns
    (settings,) = psnr.values()
    assert {settings["x"], *settings["y"].values()} <= columns
