"""Equal trainings at once, in processes of their own, with a network of one weight."""

import contextlib
import itertools
import time
from multiprocessing.synchronize import Barrier
from pathlib import Path
from types import SimpleNamespace

import pytest
from preloaded import FORKSERVER
from ruamel.yaml import YAML
from torch import nn

from polarnet.runtime.files import seal
from polarnet.training.engine.recorder import HISTORY, Progress, Recorder, best_row, read_history, write_history

EPOCHS = 30
WAITING = "waiting until an equal training ends"


def train(start: Barrier, folder: Path, seed: int, number: int) -> None:
    """Training `number` of a pair; the one that comes first goes on when the other one waits."""
    name, other = f"{seed}-{number}", folder / f"{seed}-{1 - number}.log"
    with (folder / f"{name}.log").open("w", buffering=1) as log, contextlib.redirect_stdout(log):
        start.wait()
        recorder = Recorder(folder / name, folder / "resume", {"seed": seed}, keep_every_s=0.0)
        deadline = time.monotonic() + 120
        while WAITING not in (folder / f"{name}.log").read_text() + other.read_text():
            assert time.monotonic() < deadline, "the other training does not wait"
            time.sleep(0.01)
        network = nn.Linear(1, 1)
        optimizer = SimpleNamespace(state_dict=dict)  # torch's import their compiler, for seconds in each process
        progress = recorder.resume(network, optimizer)
        assert progress == Progress(), "the running checkpoint of the other training was read"
        for _ in range(EPOCHS):
            progress.add([{"total": 1.0}], visits=1)
            recorder.keep(progress, network, optimizer)
            recorder.end_epoch(progress, network, {"mse": 1.0})
        recorder.finish()


@pytest.mark.parametrize("pairs", [1, pytest.param(20, marks=pytest.mark.thorough)])
def test_of_two_equal_trainings_at_once_the_second_waits_and_then_trains_too(tmp_path, pairs):
    start = FORKSERVER.Barrier(2 * pairs)
    trainings = list(itertools.product(range(pairs), range(2)))
    processes = [FORKSERVER.Process(target=train, args=(start, tmp_path, *training)) for training in trainings]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * len(trainings)
    for seed, number in trainings:
        assert len((tmp_path / f"{seed}-{number}" / "history.csv").read_text().splitlines()) == 1 + EPOCHS
    assert sum(WAITING in log.read_text() for log in tmp_path.glob("*.log")) == pairs
    assert not list((tmp_path / "resume").iterdir())


def test_an_output_folder_that_another_training_writes_is_refused(tmp_path):
    first = FORKSERVER.Process(target=hold, args=(tmp_path, ready := FORKSERVER.Event(), end := FORKSERVER.Event()))
    first.start()
    assert ready.wait(60)
    with pytest.raises(ValueError, match="out: another process is writing it"):
        Recorder(tmp_path / "out", tmp_path / "resume", {"seed": 2})
    end.set()
    first.join()
    assert first.exitcode == 0


def hold(folder: Path, ready, end) -> None:
    """A training that has begun and ends when it is told to."""
    recorder = Recorder(folder / "out", folder / "resume", {"seed": 1})
    ready.set()
    end.wait(60)
    recorder.finish()


ROWS = [
    {"epoch": 0, "train": {"total": 1 / 3, "ssim_loss": 0.5}, "val": {"mse": 0.25, "psnr": 6.0}},
    {"epoch": 1, "train": {"total": 1e-17, "ssim_loss": 0.1}, "val": {"mse": 0.25, "psnr": float("nan")}},
]


def test_a_history_is_read_to_the_last_digit(tmp_path):
    write_history(tmp_path, ROWS)
    seal(tmp_path)
    assert (tmp_path / HISTORY).read_text().splitlines()[0] == "epoch,train_total,train_ssim_loss,val_mse,val_psnr"
    assert str(read_history(tmp_path)) == str(ROWS)
    assert best_row(ROWS) is ROWS[0]  # the first of equally good epochs


def test_a_history_without_epochs_is_an_error(tmp_path):
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
