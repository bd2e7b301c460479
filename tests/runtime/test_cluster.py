import errno
import itertools
import os
import re
import signal
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest
from preloaded import FORKSERVER

from polarnet.runtime.cluster import pmap
from polarnet.terminal.progress import ProgressBar, said_after, steps


def square(value: int) -> int:
    return value * value


def die_once(marker_and_value: tuple[str, int]) -> int:
    """Kills its own process the first time it sees value 3; the marker file remembers that."""
    marker, value = marker_and_value
    if value == 3 and not Path(marker).exists():
        Path(marker).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def die(value: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return value


def note_and_sleep(folder: str) -> None:
    """Leaves the number of its process in the folder."""
    Path(folder, str(os.getpid())).touch()
    time.sleep(600)


def fail_on_two(value: int) -> int:
    if value == 2:
        raise ValueError("two is not allowed here")
    return value


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_items(workers):
    assert pmap(square, list(range(7)), workers=workers, label="squares") == [0, 1, 4, 9, 16, 25, 36]
    assert pmap(square, [], workers=workers, label="squares") == []


def count_slowly(number: int) -> int:
    """Counts to the number, in steps that the parent process has time to see."""
    return sum(1 for _ in steps(range(number)) if time.sleep(0.05) is None)


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.parametrize("workers", [1, 2])
def test_a_log_shows_progress_inside_an_item_too(progress_log, monkeypatch, workers):
    monkeypatch.setattr("polarnet.runtime.cluster.POLL_S", 0.01)
    assert pmap(count_slowly, [4, 8], workers=workers, label="count") == [4, 8]
    shares = [float(share) for share in re.findall(r"count: .+\| ([\d.]+)/2 ", "\n".join(progress_log()))]
    assert shares == sorted(shares)
    assert shares[-1] == 2
    assert sum(share % 1 > 0 for share in shares) >= 8


def test_a_log_has_a_line_with_the_time_left_every_half_minute(capfd, monkeypatch):
    clock = itertools.count(0, 5)
    monkeypatch.setattr("tqdm.std.time", lambda: float(next(clock)))
    for _ in ProgressBar(range(60), "work", unit=""):
        pass
    lines = capfd.readouterr().err.splitlines()
    spent = [line.split("[")[1].split("<") for line in lines]
    seconds = [60 * int(elapsed[:2]) + int(elapsed[3:]) for elapsed, _ in spent]
    assert all(30 <= after - before <= 45 for before, after in itertools.pairwise([0, *seconds]))
    assert all(re.match(r"\d\d:\d\d, ", left) for _, left in spent)
    assert len(lines) >= 5


@pytest.mark.thorough
@pytest.mark.parametrize("moment", ["while they import", "at work"])
def test_workers_end_with_the_process_that_started_them(tmp_path, moment):
    script = "import sys, test_cluster as t; t.pmap(t.note_and_sleep, [sys.argv[1]] * 2, workers=2, label='asleep')"
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    main = psutil.Popen([sys.executable, "-c", script, str(tmp_path)], env={**os.environ, "PYTHONPATH": paths})
    until(lambda: len(main.children() if moment == "while they import" else list(tmp_path.iterdir())) >= 2)
    workers = main.children()
    main.kill()
    assert main.wait() == -signal.SIGKILL
    until(lambda: not any(worker.is_running() for worker in workers))


def until(true) -> None:
    start = time.monotonic()
    while not true():
        assert time.monotonic() - start < 60
        time.sleep(0.05)


@pytest.mark.usefixtures("forked_workers")
def test_the_items_of_a_worker_that_dies_are_named():
    with pytest.raises(RuntimeError, match=r"values: a worker process died .* undone: 1, 2; run again"):
        pmap(die, [1, 2], workers=2, label="values")


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_the_function_comes_through_as_it_is(workers):
    with pytest.raises(ValueError, match="two is not allowed here"):
        pmap(fail_on_two, [1, 2, 3], workers=workers, label="values")


@pytest.fixture
def cluster():
    dask = pytest.importorskip("dask")
    distributed = pytest.importorskip("distributed")
    forking = dask.config.set({"distributed.worker.multiprocessing-method": FORKSERVER.get_start_method()})
    with forking, distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster


@pytest.mark.thorough
def test_a_dask_cluster_gives_the_same_results_and_loses_nothing_with_a_killed_worker(cluster, tmp_path):
    items = [(str(tmp_path / "died"), value) for value in range(6)]
    assert pmap(die_once, items, workers=1, label="values", address=cluster.scheduler_address) == list(range(6))
    assert (tmp_path / "died").exists()


@pytest.mark.thorough
def test_a_dask_scheduler_that_ends_is_an_error(cluster, tmp_path):
    def end() -> None:
        until(lambda: list(tmp_path.iterdir()))
        cluster.close()

    ender = threading.Thread(target=end)
    ender.start()
    with pytest.raises(RuntimeError, match="the Dask scheduler has ended; start it"):
        pmap(note_and_sleep, [str(tmp_path)] * 3, workers=1, label="asleep", address=cluster.scheduler_address)
    ender.join()


def test_without_semaphores_the_message_says_where_and_what_helps(monkeypatch):
    def refuse(*arguments, **options):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("polarnet.runtime.cluster.ProcessPoolExecutor", refuse)
    with pytest.raises(RuntimeError, match=r"/dev/shm.+Read-only file system.+runtime.workers=1"):
        pmap(str, [1, 2], workers=2, label="numbers")


def test_a_message_explains_long_work_and_stays_away_from_short_work(capsys):
    with said_after(60.0, "short"):
        pass
    with said_after(0.0, "long"):
        time.sleep(0.5)
    assert capsys.readouterr().err == "long\n"
