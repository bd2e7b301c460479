"""Progress of work that takes longer than two seconds: a bar on a terminal, elsewhere a line every 30 s.

A bar of tasks (`polarnet.runtime.cluster.pmap`) also moves inside a task: the task runs `within` its part of the bar,
and loops over `steps`.
"""

import sys
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

from tqdm import tqdm

Item = TypeVar("Item")
Move = Callable[[float], object]
"""Moves a bar on by a number of tasks."""

PATIENCE_S = 2.0  # shorter work shows nothing
LINE_S = 30.0  # between two lines where the output is no terminal, such as a log file


_move: ContextVar[Move] = ContextVar("move", default=lambda share: None)


@contextmanager
def within(move: Move) -> Iterator[None]:
    """Move a bar on by 1 in total: by a share after each of the `steps` inside, and by the rest at the end."""
    left = 1.0

    def move_by(share: float) -> None:
        nonlocal left
        left -= share
        move(share)

    token = _move.set(move_by)
    try:
        yield
    finally:
        _move.reset(token)
    move(max(0.0, left))


def steps(items: Collection[Item]) -> Iterator[Item]:
    """Yield items; after each, the bar of the running task moves on by an equal share of the task.

    >>> from polarnet.terminal.progress import steps, within
    >>> shares = []
    >>> with within(shares.append):
    ...     print(*steps("abcd"))
    a b c d
    >>> shares
    [0.25, 0.25, 0.25, 0.25, 0.0]
    """
    move = _move.get()
    for item in items:
        with within(lambda share: move(share / len(items))):
            yield item


@contextmanager
def said_after(seconds: float, message: str) -> Iterator[None]:
    """Print `message` to standard error if the work inside takes longer than `seconds`."""
    timer = threading.Timer(seconds, lambda: print(message, file=sys.stderr))
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


class ProgressBar(tqdm):
    """tqdm with the rate and the time left, from `PATIENCE_S` on; a line every `LINE_S` in a log.

    >>> from polarnet.terminal.progress import ProgressBar
    >>> sum(ProgressBar(range(10), "sum", unit="number"))
    45
    """

    def __init__(self, *arguments: Any, **options: Any):
        """Arguments of tqdm."""
        self.disable = False
        self.terminal = sys.stderr.isatty()
        in_log = {"delay": LINE_S, "mininterval": LINE_S, "maxinterval": LINE_S, "miniters": 0, "position": 0}
        pace = {"delay": PATIENCE_S} if self.terminal else in_log
        super().__init__(*arguments, **{**pace, **options})

    @staticmethod
    def status_printer(file: Any) -> Callable[[str], None]:
        """Draw a bar over the last one, or print a line."""
        if file.isatty():
            return tqdm.status_printer(file)
        return lambda text: print(text, file=file, flush=True)

    def close(self) -> None:
        """End the bar; a log needs no last line."""
        if self.terminal or self.disable:
            super().close()
        else:
            self.disable = True
            self._decr_instances(self)
