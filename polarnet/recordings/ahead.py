"""Items that another thread takes from an iterable in advance."""

import os
from collections.abc import Iterable
from queue import Empty, Queue
from threading import Thread
from typing import Generic, TypeVar

import torch

Item = TypeVar("Item")


class Ahead(Generic[Item]):
    """The items of an iterable in their order, taken from it by another thread, at most `most` in advance.

    An exception of the iterable is raised after the items before it. As a context manager it lets the thread end.
    """

    def __init__(self, items: Iterable[Item], most: int, nice: int = 0):
        """`nice` lowers the thread's priority, as the command of that name does."""
        self._queue: Queue[Item | BaseException] = Queue(most)
        self._end: BaseException | None = None
        self._stopped = False
        Thread(target=self._fill, args=[items, nice], daemon=True).start()  # daemon: a camera may be silent for ever

    def __enter__(self) -> "Ahead[Item]":
        return self

    def __exit__(self, *problem: object) -> None:
        self._stopped = True
        while not self._queue.empty():  # the thread may wait for room
            self._queue.get()

    def __iter__(self) -> "Ahead[Item]":
        return self

    def __next__(self) -> Item:
        return self._next(None)

    def within(self, timeout_s: float | None) -> Item | None:
        """The next item; None if none comes within that time. After the last, StopIteration or what ended them."""
        try:
            return self._next(timeout_s)
        except Empty:
            return None

    def _next(self, timeout_s: float | None) -> Item:
        if self._end is None:
            item = self._queue.get(timeout=timeout_s)
            if not isinstance(item, BaseException):
                return item
            self._end = item
        raise self._end

    def ready(self) -> bool:
        """Whether the next item, or the end, is there."""
        return not self._queue.empty()

    def _fill(self, items: Iterable[Item], nice: int) -> None:
        torch.set_num_threads(1)  # more would put those of a network to sleep between operations
        os.nice(nice)  # Linux: of this thread alone
        end: BaseException = StopIteration()
        try:
            for item in items:
                self._queue.put(item)
                if self._stopped:
                    return
        except BaseException as error:
            end = error
        self._queue.put(end)
