import math

import numpy as np
import pytest
import torch
from event_fixtures import events_of

from polarnet.events.stream import slice_time
from polarnet.methods.complementary_filter import FilterConfig, at_rest, highpass_intensity, image_of, integrate

LN2 = math.log(2)
HALVING_PER_MS_HZ = LN2 / (2 * math.pi * 1e-3)  # the cut-off at which log intensity halves every millisecond


def cf_config(cutoff_hz=HALVING_PER_MS_HZ, contrast_on=0.1, contrast_off=-0.1, intensity_range=(-0.1, 1.2)):
    return FilterConfig(cutoff_hz, 0.0, contrast_on, contrast_off, list(intensity_range))


def highpass_config(cutoff_hz=HALVING_PER_MS_HZ, decay_per_event=LN2, intensity_range=(-0.5, 1.5)):
    return FilterConfig(cutoff_hz, decay_per_event, 0.1, -0.1, list(intensity_range))


@pytest.fixture
def hand_list():
    """Pixel (1, 2): ON at 1 and 2 ms, OFF at 4 ms. Pixel (0, 0): OFF at 3 ms."""
    return events_of([(1000, 2, 1, 1), (2000, 2, 1, 1), (3000, 0, 0, -1), (4000, 2, 1, -1)], 2, 3)


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


def test_without_a_cutoff_steps_add_up_within_the_range_and_an_event_from_the_past_is_refused(hand_list):
    images = reconstruct_cf([hand_list], times(9_000_000), cf_config(cutoff_hz=0.0, contrast_on=0.3, contrast_off=-0.2))
    assert images[0, 0, 1, 2].item() == pytest.approx((math.exp(0.4) - 0.9) / 1.3, abs=1e-12)
    bright, dark = (events_of([(t, 0, 0, p) for t in range(9)], 2, 3) for p in (1, -1))
    images = reconstruct_cf([bright, dark], times(9), cf_config(cutoff_hz=0.0))
    assert images[0, :, 0, 0].tolist() == [1, 0]  # exp(0.9) - 1 = 1.46 > 1.2
    with pytest.raises(ValueError, match="older than the last event of its pixel"):
        integrate(at_rest(1, 2, 3), [events_of([(5, 0, 0, 1), (4, 0, 0, 1)], 2, 3)], 9, cf_config())


@pytest.mark.parametrize("bad", [[0.5, 0.5], [1.0, 0.0], [0.0], [0.0, 0.5, 1.0]])
def test_an_intensity_range_must_rise_and_the_contrast_of_off_events_be_negative(bad):
    with pytest.raises(ValueError, match=r"intensity_range: expected \[low, high\] with low < high"):
        cf_config(intensity_range=bad)
    with pytest.raises(ValueError, match=r"contrast_off: expected <= 0, got 0.1"):
        cf_config(contrast_off=0.1)
