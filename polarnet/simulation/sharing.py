"""Planes that threads share piece by piece of time: none of them waits long for the plane with the most events."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float64

from polarnet.simulation.pixels.columns import Columns, trimmed

PIECES = 8  # of a plane's time


class PlaneRun:
    """A plane that is being emulated: `advance(first, last, columns)` takes it from times[first] to times[last].

    It writes into the columns that it is given, or into larger ones if they are too small, and returns them with the
    number of events.
    """

    def __init__(self, advance: Callable[[int, int, Columns], tuple[Columns, int]], columns: Columns):
        self.advance, self.columns, self.used = advance, columns, 0
        self.done, self.busy = 0, False

    def go_on(self, last: int) -> None:
        """Emulate until times[last]."""
        room = Columns(*(column[self.used :] for column in self.columns))
        written, count = self.advance(self.done, last, room)
        if written.t.size > room.t.size:
            pairs = zip(self.columns, written, strict=True)
            self.columns = Columns(*(np.concatenate([before[: self.used], after]) for before, after in pairs))
        self.used, self.done = self.used + count, last

    @property
    def events(self) -> Columns:
        """All so far."""
        return trimmed(self.columns, self.used)


def run_planes(planes: Sequence[PlaneRun], times_us: Float64[np.ndarray, " n"], threads: int) -> None:
    """Emulate each plane from the first of the times to the last."""
    last = len(times_us) - 1
    if threads <= 1 or len(planes) == 1 or last < PIECES:
        for plane in planes:
            plane.go_on(last)
        return
    even = np.linspace(0, last, PIECES + 1).round().astype(int)[1:].tolist()
    stops = [k for k in even if k == last or times_us[k].is_integer()]  # else pieces could share a microsecond
    lock = threading.Lock()

    def work() -> None:
        while True:
            with lock:
                waiting = [plane for plane in planes if plane.done < last and not plane.busy]
                if not waiting:  # the planes that are left have their threads
                    return
                plane = min(waiting, key=lambda plane: plane.done)
                plane.busy = True
            try:
                plane.go_on(next(k for k in stops if k > plane.done))
            finally:
                plane.busy = False

    with ThreadPoolExecutor(min(threads, len(planes))) as pool:
        for future in [pool.submit(work) for _ in range(min(threads, len(planes)))]:
            future.result()
