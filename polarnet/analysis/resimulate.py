"""Simulate stored scenes again, in memory, with other window lengths, sensors or speeds."""

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Int64
from torch import Tensor

from polarnet.benchmark.sequences import TestSequence
from polarnet.events.stream import Events
from polarnet.runtime.machine import generator_for
from polarnet.simulation.camera import Camera, grid
from polarnet.simulation.motion import SynthesizeConfig, Trajectory, frame_times_us, random_trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization
from polarnet.simulation.truth import frames_of, valid_frames
from polarnet.storage.events import EventStore
from polarnet.storage.scenes import SceneRecord, SceneStore


@dataclasses.dataclass(frozen=True)
class StoredSequences:
    """Some sequences of a store of events, and the scenes behind them."""

    scenes: SceneStore
    events: EventStore
    names: Sequence[str]

    def sequence(self, name: str, t_us: Int64[Tensor, " n"]) -> TestSequence:
        """A sequence with exact truth at the window boundaries `t_us`."""
        return sequence_at(self.scenes, name, self.events.read(name), t_us)


def sequence_at(scenes: SceneStore, sequence: str, events: Sequence[Events], t_us: Int64[Tensor, " n"]) -> TestSequence:
    """Events of a stored sequence, with exact truth at the window boundaries `t_us`."""
    record = scenes.read(sequence)
    trajectory = Trajectory.from_vector(record.trajectory.numpy())
    scene = scene_from_polarization(record.s0, record.dolp, record.aolp)
    return _test_sequence(scenes, record, scene, trajectory, events, t_us)


def resimulated(
    scenes: SceneStore,
    sequence: str,
    motion: SynthesizeConfig,
    cameras: Sequence[Camera],
    seed: int,
    speed: float = 1.0,
    threads: int = 1,
) -> TestSequence:
    """Emulate a stored sequence again, with one camera for each of the four channels.

    The noise equals that of the stored sequence. A `speed` other than 1 multiplies the configured speed and moves
    the sensor over the same picture along another path.
    """
    record = scenes.read(sequence)
    scene = scene_from_polarization(record.s0, record.dolp, record.aolp)
    trajectory = Trajectory.from_vector(record.trajectory.numpy())
    if speed != 1:
        quicker = dataclasses.replace(
            motion,
            speed_min_px_s=speed * motion.speed_min_px_s,
            speed_max_px_s=speed * motion.speed_max_px_s,
            acceleration_max_px_s2=speed**2 * motion.acceleration_max_px_s2,  # the same path takes 1 / speed the time
        )
        trajectory = random_trajectory(quicker, scene.height, scene.width, generator_for(seed, sequence, "motion"))
    t_us = torch.tensor(frame_times_us(motion))
    drawn = [camera.drawn(seed, sequence) for camera in cameras]
    distinct = [camera for i, camera in enumerate(drawn) if camera not in drawn[:i]]
    size = scenes.sensor_height, scenes.sensor_width
    channels = [emulate_motion(one, scene, trajectory, int(t_us[-1]), size, threads) for one in distinct]
    events = [channels[distinct.index(camera)][channel] for channel, camera in enumerate(drawn)]
    return _test_sequence(scenes, record, scene, trajectory, events, t_us)


def _test_sequence(
    scenes: SceneStore,
    record: SceneRecord,
    scene: PolarizationScene,
    trajectory: Trajectory,
    events: Sequence[Events],
    t_us: Int64[Tensor, " n"],
) -> TestSequence:
    size = grid(scenes.attributes["layout"], scenes.sensor_height, scenes.sensor_width)
    intensity, dolp, aolp = (frames[1:] for frames in frames_of(scene, trajectory, t_us.tolist(), *size))
    valid = None if record.valid is None else valid_frames(record.valid, trajectory, t_us.tolist()[1:], *size)
    s0 = intensity[:, 0] + intensity[:, 2]
    return TestSequence(record.name, record.scene, events, t_us, dolp, aolp, s0, valid)
