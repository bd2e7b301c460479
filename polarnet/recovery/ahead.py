"""Items that another thread prepares while this one works, such as the pieces of a recording."""

import os
from collections.abc import Iterable, Iterator
from queue import Queue
from threading import Thread
from typing import Generic, TypeVar

import torch

Item = TypeVar("Item")
NICE = 10  # of the thread: the threads of a network wait for each other, so it slows down most where one gives way


class Ahead(Generic[Item]):
    """The items of an iterable in their order, taken from it by another thread, at most `most` in advance.

    An exception of the iterable is raised after the items before it. As a context manager it lets the thread end.
    """

    def __init__(self, items: Iterable[Item], most: int):
        self._queue: Queue[tuple[list[Item], BaseException | None]] = Queue(most)
        self._end: BaseException | None = None
        self._stopped = False
        Thread(target=self._fill, args=[items], daemon=True).start()  # daemon: a camera may deliver nothing any more

    def __enter__(self) -> "Ahead[Item]":
        return self

    def __exit__(self, *problem: object) -> None:
        self._stopped = True
        while not self._queue.empty():  # the thread may wait for room
            self._queue.get()

    def __iter__(self) -> Iterator[Item]:
        while items := self.take(most=1):
            yield from items

    def take(self, most: int | None = None, *, wait: bool = True) -> list[Item]:
        """The items that are ready, `most` at most; `wait` for one if there is none. Empty at the end."""
        items: list[Item] = []
        most = most or self._queue.maxsize
        while self._end is None and len(items) < most and ((wait and not items) or not self._queue.empty()):
            more, self._end = self._queue.get()
            items += more
        if self._end is not None and wait and not items and not isinstance(self._end, StopIteration):
            raise self._end
        return items

    def _fill(self, items: Iterable[Item]) -> None:
        torch.set_num_threads(1)  # more would put those of the network to sleep between operations
        os.nice(NICE)  # Linux: of this thread alone
        end: BaseException = StopIteration()
        try:
            for item in items:
                self._queue.put(([item], None))
                if self._stopped:
                    return
        except BaseException as error:
            end = error
        self._queue.put(([], end))
