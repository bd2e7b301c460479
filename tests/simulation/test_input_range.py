"""Range and bit depth of the light: what each pixel model sees of photographs and videos of 8 and 16 bits."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from polarnet.events.stream import Events
from polarnet.pictures.images import read_rgb
from polarnet.simulation.emulator import emulate
from polarnet.simulation.presets import SENSORS
from polarnet.simulation.scene import scene_from_rgb

IDEAL = dataclasses.replace(
    SENSORS["clean"],
    contrast_threshold_sigma_on=0.0,
    contrast_threshold_sigma_off=0.0,
    contrast_threshold_on=0.05,
    contrast_threshold_off=0.05,
)
RAMP_DN = 10 * np.exp(np.linspace(0, math.log(4), 401))
TIMES_US = 5_000 * torch.arange(401)


def emulated(frames: np.ndarray, model: str = "exact") -> Events:
    light = torch.from_numpy(frames)[:, None, None, None]
    (events,), _ = emulate(light, TIMES_US, dataclasses.replace(IDEAL, model=model), key=1)
    return events


def test_a_ramp_in_floating_point_numbers_fires_one_event_at_a_time():
    events = emulated(RAMP_DN.astype(np.float32))
    assert len(events.t.unique()) == len(events)


def test_the_steps_of_8_bits_fire_events_in_groups():
    """Below 20 DN a step of one DN is ln(20) / 20 = 0.15, three thresholds of 0.05: ten steps from 10 to 20 DN."""
    events = emulated(np.rint(RAMP_DN).astype(np.uint8))
    linear = int((torch.from_numpy(RAMP_DN) < 19.5).sum()) * 5_000
    steps = events.t[events.t < linear] // 5_000
    assert len(steps.unique()) == 10
    assert steps.unique(return_counts=True)[1].tolist() == pytest.approx([3] * 10, abs=1)


@pytest.mark.parametrize(("dtype", "levels"), [(np.uint8, 16), (np.uint16, 4096)])
def test_a_photograph_keeps_the_levels_of_its_file(tmp_path, dtype, levels):
    """A sixteenth of the range: 16 levels of 8 bits, 4,096 of 16 bits, all of them different light in the scene."""
    cv2 = pytest.importorskip("cv2")
    grey = np.arange(levels, dtype=dtype).reshape(16, -1) + np.iinfo(dtype).max // 2
    cv2.imwrite(str(tmp_path / "p.png"), np.stack([grey] * 3, axis=-1))
    assert len(scene_from_rgb(read_rgb(tmp_path / "p.png")).stokes[0].unique()) == levels


def test_light_above_white_in_a_floating_point_photograph_becomes_white(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(tmp_path / "p.tif", np.full((20, 30, 3), (0.25, 1.0, 4.0), np.float32), photometric="rgb")
    assert read_rgb(tmp_path / "p.tif")[:, 3, 4].tolist() == pytest.approx([0.25, 1.0, 1.0])
