"""Two processes on this processor, at the size of test_loop."""

import dataclasses
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import torch.multiprocessing
from preloaded import FORKSERVER
from test_loop import CPU, TRAIN, run, small_task

from polarnet.config.tree import load
from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.training.engine.parallel import add_up, join, launched, place
from polarnet.training.engine.recorder import read_history
from polarnet.training.engine.sequences import Batch, parts_of

ASLEEP = """
import os, pathlib, sys, time, torch
from polarnet.training.engine.parallel import join
join(torch.device("cpu"))
pathlib.Path(sys.argv[1], str(os.getpid())).touch()
time.sleep(600)
"""
START = """
from types import SimpleNamespace
from polarnet.training.engine.parallel import launched
launched("asleep", SimpleNamespace(devices=2))
"""
CONFIG = dataclasses.replace(TRAIN, batch_size=5)  # of six visits: one process has nothing of the last batch


def train_as(rank: int, port: int, stores: tuple[Path, Path], folder: Path) -> None:
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    join(CPU)
    run(small_task(), stores, folder, CONFIG)
    torch.distributed.destroy_process_group()


@pytest.mark.thorough
def test_two_processes_train_like_one_with_the_same_batches(stores, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.multiprocessing.start_processes(
        train_as, (port, stores, tmp_path / "two"), nprocs=2, start_method=FORKSERVER.get_start_method()
    )
    alone = run(small_task(), stores, tmp_path / "one", CONFIG)
    assert not list((tmp_path / "two" / "resume").iterdir())
    curves = [read_history(out) for out in (alone, tmp_path / "two" / "out")]
    for one, two in zip(*curves, strict=True):
        for split in ("train", "val"):
            assert two[split] == pytest.approx(one[split], rel=1e-4)
    one, two = (load_checkpoint(out / "last.safetensors")[0] for out in (alone, tmp_path / "two" / "out"))
    for name, tensor in one.items():
        torch.testing.assert_close(two[name], tensor, atol=1e-4, rtol=1e-3)


def test_a_batch_in_parts_takes_the_same_steps(stores, tmp_path):
    whole, parts = (
        load_checkpoint(
            run(small_task(), stores, tmp_path / str(count), dataclasses.replace(CONFIG, accumulate=count))
            / "last.safetensors"
        )[0]
        for count in (1, 3)
    )
    for name, tensor in whole.items():
        torch.testing.assert_close(parts[name], tensor, atol=1e-4, rtol=1e-3)


def test_parts_are_the_batch_in_its_order():
    frames = torch.arange(10.0).view(2, 5, 1, 1)
    batch = Batch(list("abcde"), frames[:, :, None], frames, frames, frames[:, :, None])
    parts = parts_of(batch, 3)
    assert [part.names for part in parts] == [["a", "b"], ["c", "d"], ["e"]]
    assert torch.equal(torch.cat([part.dolp for part in parts], dim=1), frames)
    assert all(part.valid is None for part in parts)
    assert len(parts_of(batch, 8)) == 5


def test_one_process_starts_no_others(project_root, monkeypatch):
    runtime = load(project_root).runtime
    assert not launched("stages.train", runtime)
    assert place() == (0, 1)
    tensor = torch.ones(2)
    add_up([tensor])
    assert torch.equal(tensor, torch.ones(2))
    monkeypatch.setenv("WORLD_SIZE", "2")  # this is one of two already
    assert not launched("stages.train", dataclasses.replace(runtime, devices=2))


@pytest.mark.thorough
def test_a_stage_that_cannot_start_is_an_error(project_root):
    with pytest.raises(RuntimeError, match=r"stages\.missing: a process of 2 on this machine failed"):
        launched("stages.missing", dataclasses.replace(load(project_root).runtime, devices=2))


@pytest.mark.thorough
def test_the_processes_of_a_training_end_with_the_one_that_started_them(tmp_path):
    (tmp_path / "asleep.py").write_text(ASLEEP)
    notes = tmp_path / "notes"
    notes.mkdir()
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    main = subprocess.Popen([sys.executable, "-c", START, str(notes)], env={**os.environ, "PYTHONPATH": paths})
    until(lambda: len(list(notes.iterdir())) == 2 or main.poll() is not None)
    main.kill()
    assert main.wait() == -signal.SIGKILL
    until(lambda: not any(Path("/proc", note.name).exists() for note in notes.iterdir()))


def until(true) -> None:
    start = time.monotonic()
    while not true():
        assert time.monotonic() - start < 300
        time.sleep(0.05)
