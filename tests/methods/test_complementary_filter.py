import math

import numpy as np
import pytest
import torch

from polarnet.events.stream import Events, slice_count, slice_time
from polarnet.methods.complementary_filter import (
    FilterConfig,
    at_rest,
    highpass_intensity,
    image_of,
    integrate,
)

LN2 = math.log(2)
HALVING_PER_MS_HZ = LN2 / (2 * math.pi * 1e-3)  # the cut-off at which log intensity halves every millisecond


def cf_config(cutoff_hz=HALVING_PER_MS_HZ, contrast_on=0.1, contrast_off=-0.1, intensity_range=(-0.1, 1.2)):
    return FilterConfig(cutoff_hz, 0.0, contrast_on, contrast_off, list(intensity_range))


def highpass_config(cutoff_hz=HALVING_PER_MS_HZ, decay_per_event=LN2, intensity_range=(-0.5, 1.5)):
    return FilterConfig(cutoff_hz, decay_per_event, 0.1, -0.1, list(intensity_range))


def events_of(*rows, height=2, width=3):
    """From (t_us, x, y, p)."""
    columns = zip(*rows, strict=True)
    types = (torch.int64, torch.int16, torch.int16, torch.int8)
    return Events(*(torch.tensor(c, dtype=d) for c, d in zip(columns, types, strict=True)), height, width)


@pytest.fixture
def hand_list():
    """Pixel (1, 2): ON at 1 and 2 ms, OFF at 4 ms. Pixel (0, 0): OFF at 3 ms."""
    return events_of((1000, 2, 1, 1), (2000, 2, 1, 1), (3000, 0, 0, -1), (4000, 2, 1, -1))


def times(*t_us):
    return torch.tensor(t_us)


def reconstructed(intensity, channels, t_us, config):
    """Images at rising times, each from the events before it: windows are half-open."""
    state = at_rest(len(channels), channels[0].height, channels[0].width)
    images = []
    for t in t_us.tolist():
        state = integrate(state, [slice_time(events, state.t_us, t) for events in channels], t, config)
        images.append(image_of(state, config, intensity))
    return torch.stack(images)


def reconstruct_cf(channels, t_us, config):
    return reconstructed(np.expm1, channels, t_us, config)


def test_a_hand_worked_event_list(hand_list):
    """An event shows after its time. The high-pass filter halves log intensity at each event once more."""
    at = times(500, 2000, 3000, 5000)
    expected = np.zeros((4, 2, 3))
    expected[:, 0, 0] = [0, 0, 0, -0.1 / 4]
    expected[:, 1, 2] = [0, 0.1 / 2, (0.1 / 2 + 0.1) / 2, (0.15 / 4 - 0.1) / 2]
    images = reconstruct_cf([hand_list], at, cf_config())
    np.testing.assert_allclose(images[:, 0], (np.exp(expected) - 1 + 0.1) / 1.3, rtol=0, atol=1e-12)
    expected[:, 1, 2] = [0, 0.1 / 2, (0.1 / 4 + 0.1) / 2, (0.125 / 8 - 0.1) / 2]
    images = reconstructed(highpass_intensity, [hand_list], at, highpass_config())
    np.testing.assert_allclose(images[:, 0], (1.5 * np.exp(expected) - 1 + 0.5) / 2, rtol=0, atol=1e-12)


def test_without_a_cutoff_log_intensity_is_the_sum_of_the_steps(hand_list):
    images = reconstruct_cf([hand_list], times(9_000_000), cf_config(cutoff_hz=0.0, contrast_on=0.3, contrast_off=-0.2))
    assert images[0, 0, 1, 2].item() == pytest.approx((math.exp(0.4) - 0.9) / 1.3, abs=1e-12)


def test_intensities_outside_the_range_are_clipped():
    bright, dark = (events_of(*((t, 0, 0, p) for t in range(9))) for p in (1, -1))
    images = reconstruct_cf([bright, dark], times(9), cf_config(cutoff_hz=0.0))
    assert images[0, :, 0, 0].tolist() == [1, 0]  # exp(0.9) - 1 = 1.46 > 1.2


def test_asking_for_more_output_times_changes_no_frame(hand_list):
    sparse = reconstruct_cf([hand_list], times(5000), cf_config())
    dense = reconstruct_cf([hand_list], torch.arange(0, 5001, 100), cf_config())
    assert torch.equal(dense[-1], sparse[0])


def test_events_in_two_pieces_leave_the_state_of_one_and_the_old_state_alone(hand_list):
    config = highpass_config()
    whole = integrate(at_rest(1, 2, 3), [hand_list], 6000, config)
    half = integrate(at_rest(1, 2, 3), [slice_count(hand_list, 0, 2)], 2500, config)
    before = half.log_intensity.copy()
    again = integrate(half, [slice_count(hand_list, 2, 4)], 6000, config)
    assert np.array_equal(again.log_intensity, whole.log_intensity)
    assert np.array_equal(again.updated_us, whole.updated_us)
    assert np.array_equal(half.log_intensity, before)


def test_an_event_from_the_past_is_refused():
    with pytest.raises(ValueError, match="older than the last event of its pixel"):
        integrate(at_rest(1, 2, 3), [events_of((5, 0, 0, 1), (4, 0, 0, 1))], 9, cf_config())


@pytest.mark.parametrize("bad", [[0.5, 0.5], [1.0, 0.0], [0.0], [0.0, 0.5, 1.0]])
def test_an_intensity_range_must_rise_and_the_contrast_of_off_events_be_negative(bad):
    with pytest.raises(ValueError, match=r"intensity_range: expected \[low, high\] with low < high"):
        cf_config(intensity_range=bad)
    with pytest.raises(ValueError, match=r"contrast_off: expected <= 0, got 0.1"):
        cf_config(contrast_off=0.1)
