import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from event_fixtures import events_of

from polarnet.benchmark.sequences import TestSequence
from polarnet.simulation.motion import Sine, resting_trajectory
from polarnet.simulation.scene import scene_from_polarization
from polarnet.stokes import StokesFrames, aolp, dolp, stokes_from_intensities
from studies.layers import Layers
from studies.robustness import FILTER_HZ, filtered_with
from studies.scored_pictures import settings

H, W = 20, 30


def uniform(s0: float, degree: float, angle: float):
    return scene_from_polarization(*(torch.full((H, W), value) for value in (s0, degree, angle)))


def test_a_cut_out_covers_what_is_behind_it_and_turns_its_polarization_with_it():
    rest = resting_trajectory(H, W)
    turning = replace(rest, roll=Sine(math.pi / 4, math.pi, 0.0))  # pi / 4 after half a second
    cover = torch.zeros(H, W)
    cover[5:15, 8:22] = 1
    opacity = scene_from_polarization(cover, 0 * cover, 0 * cover)
    layers = Layers((uniform(0.4, 0.2, 0.3), rest), (uniform(0.8, 0.6, 1.0), turning), opacity, H, W)
    vectors = stokes_from_intensities(layers.at([0, 500_000]))
    degree, angle = dolp(vectors), aolp(vectors)
    assert degree[:, 10, 15].tolist() == pytest.approx([0.6, 0.6], abs=1e-3)
    assert degree[:, 0, 0].tolist() == pytest.approx([0.2, 0.2], abs=1e-3)
    assert angle[:, 0, 0].tolist() == pytest.approx([0.3, 0.3], abs=1e-3)
    turned = (float(angle[1, 10, 15] - angle[0, 10, 15]) + math.pi / 2) % math.pi - math.pi / 2
    assert abs(turned) == pytest.approx(math.pi / 4, abs=1e-3)


def test_the_filter_with_frames_starts_at_a_frame_and_forgets_its_events_until_it_is_the_next():
    nothing = events_of([], 2, 2)
    brighter = events_of([(10_000, 0, 0, 1)], 2, 2)  # behind 0 degrees, in one pixel
    t_us = torch.tensor([0, 20_000, 3_000_000])
    unknown = torch.zeros(2, 2, 2)
    test = TestSequence("a", "a", [brighter, nothing, nothing, nothing], t_us, unknown, unknown, unknown, None)
    stokes = torch.zeros(1, 2, 2, 2)
    stokes[:, 0] = 0.4
    frames = StokesFrames(np.array([5_000]), stokes, torch.ones(1, 2, 2, dtype=torch.bool))
    found = filtered_with(frames, test, settings()).dolp
    assert found[0, 1, 1] == pytest.approx(0.4, abs=1e-6)
    rise = math.exp(0.2 * math.exp(-2 * math.pi * FILTER_HZ * 0.01))  # of one event, 10 ms later
    assert found[0, 0, 0] == pytest.approx((0.7 * rise - 0.3) / (0.7 * rise + 0.3), abs=1e-4)
    assert found[1, 0, 0] == pytest.approx(0.4, abs=1e-4)
