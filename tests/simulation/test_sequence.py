"""From a picture in memory to events and truth."""

import re
from dataclasses import asdict, replace

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
import torch
from event_fixtures import equal
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from simulation_fixtures import picture

from polarnet.config.tree import load
from polarnet.events.stream import validate
from polarnet.simulation import MOTIONS, SENSORS, PolarizationScene, scene_from_rgb, simulate
from polarnet.stokes import dolp, stokes_from_intensities

MOTION = replace(MOTIONS["default"], sensor_height=20, sensor_width=30, duration_s=0.2, acceleration_max_px_s2=4000.0)


def test_the_truth_belongs_to_the_events_and_the_light_to_the_truth():
    result = simulate(picture(), MOTION, SENSORS["default"], seed=3)
    assert result.t_us.tolist() == [0, 33333, 66667, 100000, 133333, 166667, 200000]
    assert result.intensities.shape == (7, 4, 20, 30)
    torch.testing.assert_close(dolp(stokes_from_intensities(result.intensities)), result.dolp, atol=2e-3, rtol=0)
    for events in result.events:
        validate(events)
        assert len(events) > 100
        assert 0 <= events.t[0] <= events.t[-1] <= result.t_us[-1]


@pytest.mark.parametrize(
    "same",
    [torch.Tensor.numpy, torch.Tensor.double, lambda rgb: rgb.double().numpy(), torch.Tensor.requires_grad_,
     scene_from_rgb],
    ids=["numpy", "float64", "numpy float64", "with gradient", "scene"],
)  # fmt: skip
def test_the_container_of_a_picture_changes_no_event(same):
    expected = simulate(picture(), MOTION, SENSORS["clean"], seed=1)
    assert all(map(equal, simulate(same(picture()), MOTION, SENSORS["clean"], seed=1).events, expected.events))


def with_gaps() -> torch.Tensor:
    gaps = picture()
    gaps[1, 5, 7], gaps[2, 0, 0] = torch.nan, torch.inf
    return gaps


@pytest.mark.parametrize(
    ("rgb", "message"),
    [
        (255 * picture(), r"picture: expected RGB in \[0, 1\], got values up to 2\d\d.*; divide by 255"),
        ((255 * picture()).byte(), r"picture: expected RGB in \[0, 1\], got values up to 2\d\d; divide by 255"),
        ((65535 * picture()).numpy().astype(np.uint16), r"got values up to 6\d+; divide by 65535"),
        (picture() - 0.5, r"expected RGB in \[0, 1\], got values down to -0\.\d+"),
        (with_gaps(), r"got 2 of 20736 that are NaN or infinite, the first at \(1, 5, 7\)"),
        (picture().permute(1, 2, 0), r"expected \(3, height, width\), got \(72, 96, 3\); use permute\(2, 0, 1\)"),
        (picture()[0], r"expected \(3, height, width\), got \(72, 96\)"),
        (picture()[:, :19], r"scene of 19x96 .* too small: a sensor of 20x30 .* needs more than 20x30"),
    ],
)
def test_a_picture_of_another_form_is_refused_with_what_to_do(unchecked_annotations, rgb, message):
    with pytest.raises(ValueError, match=message):
        simulate(rgb, MOTION, SENSORS["clean"], seed=1)


def test_a_picture_too_small_to_move_over_is_told_which_size_would_do():
    motion = replace(MOTION, acceleration_max_px_s2=800.0)
    with pytest.raises(ValueError, match=r"too little room .* use pictures of about") as caught:
        simulate(picture()[:, :22, :32], motion, SENSORS["clean"], seed=1)
    height, width = map(int, re.findall(r"about (\d+)x(\d+),", str(caught.value))[0])
    assert simulate(picture()[:, :height, :width], motion, SENSORS["clean"], seed=1).trajectory.speed_px_s >= 40


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"picture": "coffee.png"}, "picture: expected a numpy array or torch tensor of real numbers, got str"),
        ({"motion": "default"}, r'motion: expected SynthesizeConfig such as MOTIONS\["default"\], got'),
        ({"sensor": "noisy"}, r'sensor: expected EmulatorConfig or Camera such as SENSORS\["default"\], got'),
        ({"seed": None}, "seed: expected a whole number, got None"),
    ],
)
def test_an_argument_of_another_kind_is_named(unchecked_annotations, changes, message):
    arguments = {"picture": picture(), "motion": MOTION, "sensor": SENSORS["clean"], "seed": 1}
    with pytest.raises(TypeError, match=message):
        simulate(**(arguments | changes))


@pytest.mark.parametrize(
    ("stokes", "message"),
    [
        (2 * scene_from_rgb(picture()).stokes, r"scene: expected S0 in \[0, 1\], got values up to"),
        (torch.full((3, 60, 80), 0.5), r"scene: expected hypot\(S1, S2\) <= S0, got an excess of 0\.2071"),
        (with_gaps(), "scene: expected finite numbers, got 2"),
    ],
)
def test_a_scene_that_no_light_can_make_is_refused(stokes, message):
    with pytest.raises(ValueError, match=message):
        simulate(PolarizationScene(stokes), MOTION, SENSORS["clean"], seed=1)


SMALL = replace(MOTION, sensor_height=2, sensor_width=2, duration_s=0.01, frame_rate_hz=100.0, speed_min_px_s=1.0)
SIDES = st.one_of(st.lists(st.integers(0, 9), max_size=4), st.tuples(st.just(3), st.integers(4, 9), st.integers(4, 9)))
DTYPES = st.one_of(
    arrays.scalar_dtypes(), arrays.unicode_string_dtypes(), arrays.byte_string_dtypes(), st.just(np.dtype(object))
)


@settings(settings.default, max_examples=2 * settings.default.max_examples,
          suppress_health_check=[HealthCheck.function_scoped_fixture])  # fmt: skip
@given(values=DTYPES.flatmap(lambda dtype: SIDES.flatmap(lambda shape: arrays.arrays(dtype, tuple(shape)))))
@example(values=np.full((3, 9, 9), 0.5, np.float16))
@example(values=np.linspace(0, 1, 243, dtype=np.longdouble).reshape(3, 9, 9))
def test_any_array_is_simulated_or_refused_in_our_words(unchecked_annotations, values):
    refusal = None
    try:
        simulate(values, SMALL, SENSORS["clean"], seed=1)
    except (TypeError, ValueError) as error:
        refusal = str(error)
    assert refusal is None or re.search(r"^picture: expected .*, got |^a scene of .*(too small|too little)", refusal)


@pytest.mark.parametrize("name", list(SENSORS))
def test_the_presets_are_those_of_the_configuration(project_root, name):
    config = load(project_root, [f"sensor={name}"])
    assert asdict(SENSORS[name]) == asdict(config.emulate)
    assert asdict(MOTIONS["default"]) == asdict(config.synthesize)
