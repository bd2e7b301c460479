"""Known light: frames with their times, flicker, and the photoreceptor's response at any time."""

import math

import numpy as np
import pytest

from polarnet.characterization.light import Flicker, MovingLight, flicker_cycle, moving_responses, read_light


def light_of(values, times_ms) -> MovingLight:
    return MovingLight(np.array(values, np.float32).reshape(-1, 1, 1), np.array(times_ms) * 1e3)


def responses(light: MovingLight, times_ms, cutoff_hz: float) -> np.ndarray:
    return moving_responses(light, np.zeros(len(times_ms), np.int64), np.array(times_ms) * 1e3, cutoff_hz)


def test_without_a_photoreceptor_the_response_is_linear_between_the_logarithms_of_two_frames():
    light = light_of([100, 200], [0, 10])
    assert responses(light, [0, 5, 7.5], 0.0) == pytest.approx(
        [math.log(100), math.log(100) + 0.5 * math.log(2), math.log(100) + 0.75 * math.log(2)]
    )


def test_below_20_digital_numbers_the_response_is_linear_in_the_light():
    slope = math.log(20) / 20
    assert responses(light_of([0, 20], [0, 10]), [0, 9.9999], 0.0) == pytest.approx([0, 20 * slope], abs=1e-4)


def test_the_photoreceptor_lags_a_ramp_by_one_time_constant():
    light = light_of([100, 100 * math.e], [0, 1000])  # 1 per second, in four pieces: the last from 750 to 1000 ms
    bandwidth_hz = 50 * ((100 * math.exp(0.75) + 100 * math.e) / 2 + 20) / 275
    lag = math.log(100) + 0.9 - responses(light, [900], 50.0)[0]
    assert lag == pytest.approx(1 / (2 * math.pi * bandwidth_hz), rel=1e-4)


def test_a_parabola_of_the_logarithm_is_met_between_frames():
    """4 + 0.1 (t / 10 ms)^2: 4.225 at 15 ms, where a straight line between the frames gives 4.25."""
    light = light_of(np.exp([4, 4.1, 4.4, 4.9]), [0, 10, 20, 30])
    assert responses(light, [15], 0.0) == pytest.approx([4.225])


def test_events_outside_the_frames_have_no_response():
    assert np.isnan(responses(light_of([100, 200], [0, 10]), [-1, 10, 12], 0.0)).all()


def test_a_flicker_at_the_bandwidth_of_its_level_loses_a_factor_of_root_two():
    slow, fast = (np.ptp(flicker_cycle(Flicker(127.5, 0.05, f), 275.0)) for f in (0.1, 147.5))
    assert slow == pytest.approx(math.log(1.05 / 0.95), rel=1e-3)
    assert fast == pytest.approx(slow / math.sqrt(2), rel=1e-2)


@pytest.mark.parametrize(("level", "contrast", "word"), [(127.5, 1.2, "contrast"), (200.0, 0.5, "lower the mean")])
def test_impossible_flicker_is_refused(level, contrast, word):
    with pytest.raises(ValueError, match=word):
        Flicker(level, contrast, 10.0)


def test_a_folder_of_frames_is_read_in_the_order_of_names_with_its_times(tmp_path):
    for k, dn in enumerate((10.0, 20.0)):
        np.save(tmp_path / f"{k}.npy", np.full((2, 3), dn))
    (tmp_path / "timestamps.txt").write_text("# us\n0\n4000\n")
    light = read_light(tmp_path, 2, 3)
    assert light.frames[:, 0, 0].tolist() == [10, 20]
    assert light.t_us.tolist() == [0, 4000]


@pytest.mark.parametrize(
    ("times", "height", "remedy"),
    [("0\n", 2, "one line per frame"), ("5\n3\n", 2, "sort"), ("0\n1\n", 4, "cut and scale"), ("a\nb\n", 2, "time in")],
)
def test_frames_that_do_not_fit_are_refused_with_a_remedy(tmp_path, times, height, remedy):
    for k in range(2):
        np.save(tmp_path / f"{k}.npy", np.zeros((2, 3)))
    (tmp_path / "timestamps.txt").write_text(times)
    with pytest.raises(ValueError, match=remedy):
        read_light(tmp_path, height, 3)
