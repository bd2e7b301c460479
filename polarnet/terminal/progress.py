"""Progress of work that takes longer than two seconds: a bar on a terminal, elsewhere a line every 30 s."""

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

PATIENCE_S = 2.0  # shorter work shows nothing
LINE_S = 30.0  # between two lines where the output is no terminal, such as a log file


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
        in_log = {"delay": LINE_S, "mininterval": LINE_S, "maxinterval": LINE_S}
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
