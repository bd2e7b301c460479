"""Events on the fly: a sequence is emulated on its first read, and no event is written to disk."""

from collections import OrderedDict
from typing import Any

from polarnet.events.stream import Events, slice_time
from polarnet.simulation.dataset import emulate_sequence, origin_of
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.storage.scenes import SceneStore

KEPT_SEQUENCES = 8  # about 25 MB each at 120x180 px and 2 million events


class EmulatedEvents:
    """An `EventSource` that emulates in memory the same events that `emulate_scenes` would store.

    Sequences are emulated as a whole, because the pixels have memory. The last `kept` sequences stay in memory for
    further reads. A copy in another process starts with none.
    """

    def __init__(
        self, scenes: SceneStore, config: EmulatorConfig, seed: int, threads: int = 1, kept: int = KEPT_SEQUENCES
    ):
        if kept < 1:
            raise ValueError(f"expected at least one sequence to keep in memory, got kept={kept}")
        self.path = scenes.path
        self.sequences = scenes.sequences
        self.height = scenes.sensor_height
        self.width = scenes.sensor_width
        self.attributes = origin_of(scenes, config, seed)
        self._scenes, self._config, self._seed, self._threads, self._kept = scenes, config, seed, threads, kept
        self._in_memory: OrderedDict[str, list[Events]] = OrderedDict()

    def read(self, sequence: str, start_us: int | None = None, stop_us: int | None = None) -> list[Events]:
        """Events of the four channels with start_us <= t < stop_us (default: all), in microseconds of the sequence.

        Raises ValueError for a sequence that the scene store does not have.
        """
        channels = self._emulated(sequence)
        if start_us is None and stop_us is None:
            return channels
        start_us = start_us or 0
        stop_us = self._scenes.duration_us(sequence) + 1 if stop_us is None else max(start_us, stop_us)
        return [slice_time(events, start_us, stop_us) for events in channels]

    def _emulated(self, sequence: str) -> list[Events]:
        if sequence not in self._scenes.scene_of:
            raise ValueError(f"{self.path}: expected the name of one of its sequences, got {sequence!r}")
        if sequence not in self._in_memory:
            while len(self._in_memory) >= self._kept:
                self._in_memory.popitem(last=False)
            self._in_memory[sequence] = emulate_sequence(
                self._scenes, sequence, self._config, self._seed, self._threads
            )
        self._in_memory.move_to_end(sequence)
        return list(self._in_memory[sequence])

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_in_memory": OrderedDict()}
