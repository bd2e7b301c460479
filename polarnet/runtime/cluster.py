"""Map a function over many sequences: in this process, in processes of this machine, or on a Dask cluster."""

import functools
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import zip_longest
from typing import Any, TypeVar

from polarnet.runtime.machine import end_with_parent, limit_threads, on_one_thread, tune, usable_cores
from polarnet.terminal.installation import installation
from polarnet.terminal.progress import ProgressBar as Bar
from polarnet.terminal.progress import within

ATTEMPTS = 4  # of Dask for a task whose workers die (its allowed-failures of 3)
POLL_S = 0.2  # between two looks at the progress of worker processes
BAR = "{l_bar}{bar}| {n:.4g}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"

Item = TypeVar("Item")
Result = TypeVar("Result")


def pmap(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    workers: int,
    label: str,
    address: str | None = None,
) -> list[Result]:
    """`[function(item) for item in items]`, in that order, with a progress bar called `label`.

    The bar also moves inside an item, by `polarnet.terminal.progress.steps`, unless a Dask worker runs it. `address`
    names a Dask scheduler (extra `cluster`); without it, `workers` processes share the items, and one worker means this
    process. RuntimeError names the unfinished items after a worker process has died, or a scheduler that has ended;
    exceptions of `function` end the map unchanged.
    """
    with Bar(total=len(items), desc=label, unit="", bar_format=BAR) as bar:
        if address is not None:
            return _over_dask(function, items, address, bar)
        if workers > 1 and len(items) > 1:
            return _over_processes(function, items, min(workers, len(items)), bar, label)
        results = []
        for item in items:
            with within(bar.update):
                results.append(function(item))
        return results


def _start_worker(threads: int, done: Any) -> None:
    """Set up a worker process; `done` is the number of items that all workers have finished, with fractions."""
    global _done
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends a worker without a traceback
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    end_with_parent()
    limit_threads(threads)
    tune()
    _done = done


def _in_worker(function: Callable[[Item], Result], item: Item) -> Result:
    def move(share: float) -> None:
        with _done.get_lock():
            _done.value += share

    with within(move):
        return function(item)


def _over_processes(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int, bar: Bar, label: str
) -> list[Result]:
    spawn = multiprocessing.get_context("spawn")  # forking a process with running OpenMP threads can hang
    threads = max(1, usable_cores() // workers)
    try:
        done = spawn.Value("d", 0.0)
        executor = ProcessPoolExecutor(workers, spawn, initializer=_start_worker, initargs=(threads, done))
    except OSError as error:
        raise RuntimeError(
            f"several processes need semaphores in /dev/shm, which cannot be made there: {error}; run again with "
            "runtime.workers=1"
        ) from error
    futures: list[Future[Result]] = []
    with executor as pool:
        try:
            with _interrupts_held():  # by the workers too, until they are set up: their imports would show tracebacks
                futures += (pool.submit(_in_worker, function, item) for item in items)
            waiting = set(futures)
            while waiting:
                finished, waiting = wait(waiting, POLL_S, FIRST_EXCEPTION)
                bar.update(done.value - bar.n)
                for future in finished:
                    future.result()
            return [future.result() for future in futures]
        except BrokenProcessPool:
            undone = [str(item) for item, one in zip_longest(items, futures) if one is None or one.exception()]
            raise RuntimeError(
                f"{label}: a worker process died (out of memory?) with these undone: {', '.join(undone[:8])}; run "
                "again, which makes what is missing, with fewer runtime.workers if memory is short"
            ) from None
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                for worker in multiprocessing.active_children():
                    worker.kill()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Put off Ctrl-C in this thread until the end, and in processes that it starts meanwhile until they allow it."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _over_dask(function: Callable[[Item], Result], items: Sequence[Item], address: str, bar: Bar) -> list[Result]:
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise RuntimeError(
            f"cluster.address needs Dask on this machine and on the workers: {installation('cluster')}"
        ) from None
    with Client(address, timeout="30s") as client:
        one_by_one = functools.partial(on_one_thread, function)  # Dask runs several tasks of one worker side by side
        futures = client.map(one_by_one, items, retries=ATTEMPTS - 1, pure=False)
        results = {}
        for future in as_completed(futures):
            if future.cancelled():
                raise RuntimeError(f"{address}: the Dask scheduler has ended; start it and run the same command again")
            results[future.key] = future.result()
            bar.update()
        return [results[future.key] for future in futures]
