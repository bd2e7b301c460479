"""Polarizers of the simulated camera, against values worked out by hand."""

import dataclasses
import math
import re

import numpy as np
import pytest
import torch
from event_fixtures import equal

from polarnet import stokes
from polarnet.simulation import SENSORS, PolarizationScene, scene_from_polarization
from polarnet.simulation.camera import (
    IDEAL,
    Camera,
    PolarizersConfig,
    pixel_analyzers,
    split_cells,
    weights_of,
)
from polarnet.simulation.motion import Pose, render_poses, resting_trajectory
from polarnet.simulation.moving_sensor import channel_light, emulate_motion

FILM = dataclasses.replace(IDEAL, extinction_ratio=[100.0] * 4)
DOFP = dataclasses.replace(IDEAL, layout="dofp")


def uniform_scene(dolp: float, aolp_deg: float, s0: float = 1.0) -> PolarizationScene:
    plane = torch.ones(60, 80)
    return scene_from_polarization(s0 * plane, dolp * plane, math.radians(aolp_deg) * plane)


def channels_of(
    scene: PolarizationScene, polarizers: PolarizersConfig, place: tuple[float, float] = (39.5, 29.5), size=(20, 30)
) -> torch.Tensor:
    """Light of the four channels in [0, 1] of a sensor centred on a place (x, y) of the scene."""
    pose = Pose(*(np.array([value]) for value in (*place, 0.0, 1.0)))
    stokes = render_poses(scene, pose, *size).transpose(1, 0, 2, 3)
    frames = channel_light(stokes, polarizers, weights_of(polarizers, *size, key=3))
    return torch.from_numpy(frames[:, 0].astype(np.float64) / 255)


def measured(scene: PolarizationScene, polarizers: PolarizersConfig) -> tuple[float, float]:
    """(DoLP, AoLP in degrees) that Eq. 1 to 3 give, at the middle of a channel."""
    vector = stokes.stokes_from_intensities(channels_of(scene, polarizers))
    row, column = vector.shape[1] // 2, vector.shape[2] // 2
    return float(stokes.dolp(vector)[row, column]), math.degrees(float(stokes.aolp(vector)[row, column]))


def test_transmission_extinction_and_crosstalk_change_the_light_as_by_hand():
    polarizers = dataclasses.replace(FILM, transmission=[0.8, 0.6, 0.8, 0.8])
    i0, i45, i90, _ = channels_of(uniform_scene(1.0, 0.0), polarizers)[:, 5, 5].tolist()
    assert i0 == pytest.approx(0.8, abs=1e-6)  # along the axis
    assert i90 == pytest.approx(0.008, abs=1e-6)  # across it
    assert i45 == pytest.approx(0.6 * (1 + 0.01) / 2, abs=1e-6)  # half of either
    # In uniform light a pixel's neighbours in the mosaic 90 45 / 135 0 are, for 0: twice 45 and twice 135.
    polarizers = dataclasses.replace(DOFP, crosstalk=0.2)
    dolp, angle = measured(uniform_scene(1.0, 0.0), polarizers)
    assert dolp == pytest.approx(0.8, abs=1e-5)  # I0 = 0.8 + 0.2 / 2, I90 = 0.2 / 2
    assert angle % 180 == pytest.approx(0, abs=1e-3)


def test_each_channel_of_a_mosaic_sees_its_own_pixels():
    """Behind ideal polarizers, unpolarized light of brightness 0.001 (100 row + column) gives half of that."""
    rows, columns = torch.meshgrid(torch.arange(8.0), torch.arange(10.0), indexing="ij")
    scene = scene_from_polarization(0.001 * (100 * rows + columns), torch.zeros(8, 10), torch.zeros(8, 10))
    channels = channels_of(scene, dataclasses.replace(DOFP, mosaic="90 45 / 135 0"), (4.5, 3.5), (8, 10))
    assert channels.shape == (4, 4, 5)
    for channel, (row, column) in zip(channels, [(1, 1), (0, 1), (0, 0), (1, 0)], strict=True):
        expected = 0.0005 * (100 * rows + columns)[row::2, column::2]
        torch.testing.assert_close(channel, expected.double(), atol=1e-6, rtol=0)


def test_micropolarizers_differ_between_pixels_as_much_as_stated():
    polarizers = dataclasses.replace(
        DOFP, extinction_ratio=[50.0] * 4, extinction_spread=0.3, angle_spread_deg=1.5, transmission=[0.5] * 4,
        transmission_spread=0.04,
    )  # fmt: skip
    (weights,) = weights_of(polarizers, 200, 300, key=7).astype(np.float64)
    angles = np.degrees(np.arctan2(weights[2], weights[1]) / 2) % 180
    zero = split_cells(angles[None].astype(np.float32), "90 45 / 135 0")[0, 0]
    assert ((zero + 90) % 180 - 90).std() == pytest.approx(1.5, rel=0.03)
    polarized = np.hypot(weights[1], weights[2])
    along, across = weights[0] + polarized, weights[0] - polarized
    assert along.std() / along.mean() == pytest.approx(0.04, rel=0.03)
    assert np.log(along / across).std() == pytest.approx(0.3, rel=0.03)
    assert not np.array_equal(weights_of(polarizers, 200, 300, key=8)[0], weights.astype(np.float32))


@pytest.mark.parametrize("crosstalk", [0.0, 0.2])
def test_each_pixel_sees_uniform_light_through_its_analyzer(crosstalk):
    spread = {
        "extinction_ratio": [20.0] * 4,
        "extinction_spread": 0.3,
        "angle_spread_deg": 3.0,
        "transmission_spread": 0.1,
    }
    four = dataclasses.replace(IDEAL, transmission=[0.7, 0.5, 0.6, 0.4], **spread)
    dofp = dataclasses.replace(four, layout="dofp", crosstalk=crosstalk)
    scene = uniform_scene(0.7, 35.0)
    for polarizers, size in ((four, (20, 30)), (dofp, (10, 15))):
        analyzer = pixel_analyzers(Camera(SENSORS["clean"], polarizers, key=3), 20, 30)
        assert analyzer.shape == (4, 3, *size)
        expected = torch.einsum("cshw,s->chw", analyzer, scene.stokes[:, 0, 0]).double()
        torch.testing.assert_close(channels_of(scene, polarizers), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("polarizers", [IDEAL, DOFP, dataclasses.replace(FILM, angle_error_deg=[0.0, 1.0, 2.0, 3.0])])
def test_pixels_that_are_alike_have_one_analyzer_a_channel(polarizers):
    analyzer = pixel_analyzers(Camera(SENSORS["clean"], polarizers), 20, 30)
    angles = np.radians(np.add(stokes.POLARIZER_ANGLES_DEG, polarizers.angle_error_deg))
    ratio = polarizers.extinction_ratio[0] or math.inf
    torch.testing.assert_close(analyzer, torch.from_numpy(stokes.analyzer(angles, ratio).T).float())


@pytest.mark.parametrize("key", [2**64 - 1, -1])
def test_keys_count_modulo_2_to_the_64(key):
    polarizers = dataclasses.replace(IDEAL, angle_spread_deg=1.0)
    cameras = [Camera(SENSORS["noisy"], polarizers, key=k) for k in (key, key % 2**64)]
    rest = resting_trajectory(20, 30)
    ours, same = (emulate_motion(one, uniform_scene(0.5, 30.0), rest, 500_000, (20, 30)) for one in cameras)
    assert min(map(len, ours)) > 100
    assert all(map(equal, ours, same))


def test_a_spread_at_full_transmission_lowers_its_mean_as_stated():
    polarizers = dataclasses.replace(IDEAL, transmission_spread=0.03)
    analyzer = pixel_analyzers(Camera(SENSORS["clean"], polarizers), 200, 300)
    assert float(2 * analyzer[:, 0].mean()) == pytest.approx(0.988, abs=3e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"extinction_ratio": [100.0]}, "extinction_ratio: expected at least 4 values, got"),
        ({"crosstalk": 0.1}, "crosstalk: expected 0 with layout four_sensors"),
        ({"mosaic": "0 45 90"}, 'expected the angles 0, 45, 90 and 135 like "90 45 / 135 0"'),
        ({"transmission": [0.0, 1.0, 1.0, 1.0]}, "transmission[0]: expected > 0, got 0.0"),
    ],
)
def test_polarizers_that_cannot_be_are_refused(change, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        dataclasses.replace(IDEAL, **change)
