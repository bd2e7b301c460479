"""Events on the fly: a sequence is emulated on its first read, and no event is written to disk."""

import functools
from typing import Any

from polarnet.events.stream import Events, slice_time
from polarnet.simulation.camera import Camera
from polarnet.simulation.dataset import emulate_sequence, origin_of
from polarnet.simulation.polarizers import channel_size
from polarnet.storage.scenes import SceneStore

CAPACITY = 8  # sequences in memory, about 25 MB each at 120x180 px and 2 million events


class EmulatedEvents:
    """A source of events that emulates in memory the same events that `emulate_scenes` would store.

    Sequences are emulated as a whole, because the pixels have memory. The last `capacity` sequences stay in memory for
    further reads. A copy in another process starts with none.
    """

    def __init__(self, scenes: SceneStore, camera: Camera, seed: int, threads: int = 1, capacity: int = CAPACITY):
        if capacity < 1:
            raise ValueError(f"expected at least one sequence to keep in memory, got capacity={capacity}")
        self.path = scenes.path
        self.sequences = scenes.sequences
        self.height, self.width = channel_size(camera.polarizers.layout, scenes.sensor_height, scenes.sensor_width)
        self.attributes = origin_of(scenes, camera, seed)
        self._settings = scenes, camera, seed, threads, capacity
        self._emulated = functools.lru_cache(capacity)(
            lambda sequence: emulate_sequence(scenes, sequence, camera, seed, threads)
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._settings

    def read(self, sequence: str, start_us: int | None = None, stop_us: int | None = None) -> list[Events]:
        """Events of the four channels with start_us <= t < stop_us (default: all), in microseconds of the sequence.

        Raises ValueError for a sequence that the scene store does not have.
        """
        channels = self._emulated(sequence)
        if start_us is None and stop_us is None:
            return list(channels)
        start_us = start_us or 0
        stop_us = self._settings[0].duration_us(sequence) + 1 if stop_us is None else max(start_us, stop_us)
        return [slice_time(events, start_us, stop_us) for events in channels]
