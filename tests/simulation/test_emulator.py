"""Properties of every pixel model: hand-worked ramps, equal bytes for any split of the work, clear errors."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from polarnet.events.stream import concatenate, validate
from polarnet.simulation.emulator import MODELS, EmulatorConfig, emulate
from polarnet.simulation.presets import SENSORS

IDEAL = dataclasses.replace(SENSORS["clean"], contrast_threshold_sigma_on=0.0, contrast_threshold_sigma_off=0.0)
NOISY = dataclasses.replace(
    IDEAL, contrast_threshold_sigma_on=0.03, contrast_threshold_sigma_off=0.03, cutoff_hz=100.0, leak_rate_hz=2.0,
    leak_jitter=0.1, noise_rate_cov_decades=0.1, shot_noise_rate_hz=5.0, refractory_period_us=500.0,
)  # fmt: skip
THRESHOLD_MODELS = ["v2e", "exact", "esim"]


def of(model: str, base: EmulatorConfig = IDEAL, **changes) -> EmulatorConfig:
    return dataclasses.replace(base, model=model, **changes)


def log_ramp(start: float, stop: float, steps: int) -> torch.Tensor:
    """One pixel whose natural-log digital number goes from start to stop in equal steps."""
    return torch.linspace(start, stop, steps + 1, dtype=torch.float64).exp().float().view(-1, 1, 1, 1)


def moving_clip(dtype: torch.dtype) -> torch.Tensor:
    """Twelve frames of four channels in which bright and dark bars of 0 to 255 DN drift."""
    phase = torch.arange(40.0) / 6 - torch.arange(12.0).view(-1, 1, 1, 1) / 3
    amplitude = torch.linspace(20, 127, 4).view(1, 4, 1, 1) * torch.linspace(0.5, 1, 24).view(1, 1, 24, 1)
    return (127.5 + amplitude * torch.sin(phase)).to(dtype)


def same(a, b) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("t", "x", "y", "p"))


@pytest.mark.parametrize("model", THRESHOLD_MODELS)
@pytest.mark.parametrize(("sign", "polarity"), [(1, 1), (-1, -1)])
def test_a_log_ramp_of_three_and_a_half_thresholds_fires_three_events(model, sign, polarity):
    ramp = log_ramp(4.5, 4.5 + sign * 0.7, 10)
    (events,), _ = emulate(ramp, 1000 * torch.arange(11), of(model, esim_log_eps=1e-9), key=1)
    assert events.p.tolist() == [polarity] * 3


@pytest.mark.parametrize("model", ["exact", "esim"])
def test_events_of_a_log_ramp_are_stamped_where_it_crosses_the_thresholds(model):
    ramp, config = log_ramp(4.5, 5.2, 10), of(model, esim_log_eps=1e-9)
    (events,), _ = emulate(ramp, 7000 * torch.arange(11), config, key=1)
    assert events.t.tolist() == pytest.approx([20_000, 40_000, 60_000], abs=1)  # 0.7 in 70 ms: 0.2 every 20 ms


@pytest.mark.parametrize(("model", "tolerance_us"), [("exact", 5), ("v2e", 60)])
@pytest.mark.parametrize("cutoff_hz", [50.0, 0.0])
def test_photoreceptor_and_source_follower_answer_a_step_of_light_like_a_second_order_low_pass(
    model, tolerance_us, cutoff_hz
):
    every_us, rate = 20, 2 * math.pi * 50
    t_us = np.append(0, 1 + every_us * np.arange(1500))
    frames = np.full((len(t_us), 1, 1, 1), 255.0, np.float32)
    frames[0] = 25
    config = of(model, cutoff_hz=cutoff_hz, source_follower_hz=100.0 if cutoff_hz else 50.0)
    (events,), _ = emulate(frames, t_us, config, key=1)
    risen = 0.2 * np.arange(1, 11) / math.log(255 / 25)  # fraction of the step at each ON event
    # poles at `rate` and 2 `rate` give the response (1 - exp(-rate t))^2, one pole alone 1 - exp(-rate t)
    expected_us = -1e6 / rate * np.log(1 - (np.sqrt(risen) if cutoff_hz else risen))
    assert events.p.tolist()[:10] == [1] * 10
    assert events.t[:10].numpy() == pytest.approx(expected_us, abs=tolerance_us)


def test_v2e_spreads_events_over_a_step_as_its_busiest_pixel_asks():
    frames = torch.tensor([[math.exp(4.0), math.exp(4.0)], [math.exp(4.61), math.exp(4.21)]]).float().view(2, 1, 1, 2)
    (events,), _ = emulate(frames, torch.tensor([0, 3000]), of("v2e"), key=1)
    # three events of the first pixel at thirds; the second pixel's only event shares the first slot
    assert events.t.tolist() == [1000, 1000, 2000, 3000]
    assert events.x.tolist() == [0, 1, 0, 0]


def test_v2e_does_not_consume_what_its_refractory_period_suppresses():
    frames = torch.tensor([4.0, 4.61, 4.61]).exp().float().view(3, 1, 1, 1)
    (events,), _ = emulate(frames, torch.tensor([0, 3000, 6000]), of("v2e", refractory_period_us=2500.0), key=1)
    # slots at 1, 2, 3 ms: only the first is taken; two thresholds remain, tried again at 4.5 and 6 ms
    assert events.t.tolist() == [1000, 4500]


def test_exact_fires_a_delayed_event_when_the_refractory_period_ends():
    frames = torch.tensor([4.0, 4.61, 4.61]).exp().float().view(3, 1, 1, 1)
    config = of("exact", refractory_period_us=2500.0)
    (events,), state = emulate(frames, torch.tensor([0, 6100, 9000]), config, key=1)
    # crossings at 2, 4 and 6 ms; the second has to wait for 4.5, the third for 7 ms
    assert events.t.tolist() == pytest.approx([2000, 4500, 7000], abs=1)
    assert state.pixels[0].change[0] == pytest.approx(0.01, abs=1e-6)


def test_exact_forgets_a_delayed_event_when_the_light_goes_back_in_time():
    frames = torch.tensor([4.0, 4.41, 4.21]).exp().float().view(3, 1, 1, 1)
    (events,), _ = emulate(frames, torch.tensor([0, 4100, 6100]), of("exact", refractory_period_us=4000.0), key=1)
    # crossings at 2 and 4 ms; at 6 ms, when the second may fire, only 0.22 - 0.2 of change is left
    assert events.t.tolist() == pytest.approx([2000], abs=1)


def test_the_photoreceptor_of_exact_follows_a_step_exponentially_whatever_the_frame_rate():
    # 255 DN from 26 DN on, at 275 DN of the scale the time constant is 1 / (2 pi 10 Hz) = 15.9 ms
    def filtered(steps: int) -> float:
        frames = torch.full((steps + 1, 1, 1, 1), 255.0)
        frames[0] = 254.999
        config = of("exact", cutoff_hz=10.0, contrast_threshold_on=5.0, contrast_threshold_off=5.0)
        _, state = emulate(frames[:1] * 0 + 100.0, torch.tensor([0]), config, key=1)
        jump_us = torch.cat([torch.tensor([1]), 1 + 20_000 * torch.arange(1, steps + 1) // steps])
        _, state = emulate(frames, jump_us, config, key=1, state=state)
        return float(state.pixels[0].change[0])

    expected = math.log(2.55) * (1 - math.exp(-2 * math.pi * 10 * 0.02))
    assert filtered(1) == pytest.approx(expected, abs=2e-4)
    assert filtered(200) == pytest.approx(expected, abs=2e-4)


@pytest.mark.parametrize("cutoff_hz", [0.5, 3.0, 40.0, 880.0])
def test_the_photoreceptor_of_exact_follows_a_step_of_light_within_a_frame(cutoff_hz):
    """Over a step, with a = bandwidth * duration, a rise of the response by r becomes r (1 - (1 - exp(-a)) / a)."""
    frames = torch.tensor([100.0, 255.0]).view(2, 1, 1, 1)
    config = of("exact", cutoff_hz=cutoff_hz, contrast_threshold_on=5.0, contrast_threshold_off=5.0)
    _, state = emulate(frames, torch.tensor([0, 20_000]), config, key=1)
    a = 2 * math.pi * cutoff_hz * 0.02 * (177.5 + 20) / 275
    assert float(state.pixels[0].change[0]) == pytest.approx(math.log(2.55) * (1 + math.expm1(-a) / a), rel=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.1])
@pytest.mark.parametrize("model", list(MODELS))
def test_pieces_threads_and_the_order_of_channels_change_no_event(model, share):
    """Of valid events in the order (t, y, x, p), from sensors with and without hot and dead pixels."""
    config = of(model, NOISY, hot_pixel_share=share, hot_pixel_rate_hz=500.0, dead_pixel_share=share)
    frames, t_us = moving_clip(torch.float32), 3333.5 * torch.arange(12, dtype=torch.float64)
    whole, end = emulate(frames, t_us, config, key=7)
    assert sum(map(len, whole)) > 2000
    for channel in whole:
        validate(channel)
        assert np.array_equal(np.lexsort((channel.p, channel.x, channel.y, channel.t)), np.arange(len(channel)))
    pieces, state = [], None
    for piece in (slice(0, 1), slice(1, 5), slice(5, 6), slice(6, 12)):
        events, state = emulate(frames[piece], t_us[piece], config, key=7, state=state)
        pieces.append(events)
    assert all(same(concatenate(parts), all_) for parts, all_ in zip(zip(*pieces, strict=True), whole, strict=True))
    assert (state.t_us, state.steps) == (end.t_us, end.steps) == (11 * 3333.5, 11)
    threaded, _ = emulate(frames, t_us, config, key=7, threads=2)
    turned, _ = emulate(frames.flip(1), t_us, config, key=7, channels=[3, 2, 1, 0])
    assert all(map(same, threaded, whole))
    assert all(map(same, turned[::-1], whole))


@pytest.mark.parametrize("model", list(MODELS))
def test_whole_numbers_mean_the_same_as_bytes_and_as_floats(model):
    t_us = 3333 * torch.arange(12)
    from_bytes, _ = emulate(moving_clip(torch.uint8), t_us, of(model, NOISY), key=3)
    from_floats, _ = emulate(moving_clip(torch.uint8).double(), t_us, of(model, NOISY), key=3)
    if model.startswith("esim"):  # bytes take the float32 closest to the logarithm, floats a faster one
        assert [len(e) for e in from_floats] == pytest.approx([len(e) for e in from_bytes], rel=1e-3)
    else:
        assert all(same(a, b) for a, b in zip(from_bytes, from_floats, strict=True))


@pytest.mark.parametrize("model", list(MODELS))
def test_what_comes_in_is_not_changed(model):
    frames, t_us = moving_clip(torch.float32), 3333 * torch.arange(12)
    _, state = emulate(frames[:6], t_us[:6], of(model, NOISY), key=3)
    before = [[array.copy() for array in pixels] for pixels in state.pixels]
    emulate(frames[6:], t_us[6:], of(model, NOISY), key=3, state=state)
    assert all(
        np.array_equal(a, b) for p, q in zip(before, state.pixels, strict=True) for a, b in zip(p, q, strict=True)
    )


@pytest.mark.parametrize("model", ["v2e", "exact"])
def test_every_channel_has_thresholds_of_its_own_around_the_nominal_ones(model):
    _, state = emulate(torch.full((1, 4, 100, 100), 100.0), torch.tensor([0]), of(model, NOISY), key=3)
    maps = [values for pixels in state.pixels for values in (pixels.threshold_on, pixels.threshold_off)]
    for values in maps:
        assert values.mean() == pytest.approx(0.2, abs=3 * 0.03 / 100)
        assert values.std() == pytest.approx(0.03, abs=3 * 0.03 / math.sqrt(2) / 100)
        assert values.min() >= 0.01
    correlations = np.corrcoef(maps)[np.triu_indices(8, 1)]
    assert abs(correlations).max() < 4 / 100  # of 28 pairs, standard deviation 1 / 100 each


@pytest.mark.parametrize("model", ["v2e", "exact"])
@pytest.mark.parametrize("correlation", [-0.5, 0.0, 0.8, 1.0])
def test_on_and_off_thresholds_have_deviations_of_their_own_and_the_configured_correlation(model, correlation):
    config = of(
        model, NOISY, contrast_threshold_on=0.25, contrast_threshold_off=0.38, contrast_threshold_sigma_on=0.05,
        contrast_threshold_sigma_off=0.04, contrast_threshold_correlation=correlation,
    )  # fmt: skip
    _, state = emulate(torch.full((1, 2, 100, 100), 100.0), torch.tensor([0]), config, key=3)
    for pixels in state.pixels:
        on, off = pixels.threshold_on, pixels.threshold_off
        assert (on.mean(), off.mean()) == pytest.approx((0.25, 0.38), abs=3 * 0.05 / 100)
        assert (on.std(), off.std()) == pytest.approx((0.05, 0.04), abs=3 * 0.05 / math.sqrt(2) / 100)
        error = (1 - correlation**2) / 100  # standard error of a correlation of 10,000 pairs
        assert np.corrcoef(on, off)[0, 1] == pytest.approx(correlation, abs=3 * error + 1e-6)
    across = np.corrcoef(state.pixels[0].threshold_on, state.pixels[1].threshold_off)[0, 1]
    assert abs(across) < 3 / 100  # another channel is another sensor


def test_the_correlation_changes_off_thresholds_alone():
    light, t_us = torch.full((1, 1, 8, 8), 100.0), torch.tensor([0])
    (apart, together) = (
        emulate(light, t_us, of("exact", NOISY, contrast_threshold_correlation=rho), key=3)[1].pixels[0]
        for rho in (0.0, 1.0)
    )
    assert np.array_equal(apart.threshold_on, together.threshold_on)
    # with equal nominal thresholds and deviations, full correlation makes both thresholds of a pixel equal
    assert np.array_equal(together.threshold_on, together.threshold_off)
    assert not np.array_equal(apart.threshold_off, together.threshold_off)


@pytest.mark.parametrize("model", ["v2e", "exact"])
def test_another_key_is_another_sensor_and_the_same_key_the_same(model):
    frames, t_us = moving_clip(torch.float32), 3333 * torch.arange(12)
    (first, *_), _ = emulate(frames, t_us, of(model, NOISY), key=2**64 - 1)
    (again, *_), _ = emulate(frames, t_us, of(model, NOISY), key=2**64 - 1)
    (other, *_), _ = emulate(frames, t_us, of(model, NOISY), key=1)
    assert same(first, again)
    assert not same(first, other)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": "iebcs"}, "model: expected one of v2e, exact, esim, dvs_voltmeter"),
        ({"contrast_threshold_on": 0.0}, "contrast_threshold_on: expected >= 0.01"),
        ({"leak_jitter": 1.5}, "leak_jitter: expected <= 1"),
        ({"contrast_threshold_correlation": 1.01}, "contrast_threshold_correlation: expected <= 1"),
        ({"hot_pixel_share": -0.1}, "hot_pixel_share: expected >= 0"),
    ],
)
def test_a_configuration_out_of_range_is_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(IDEAL, **changes)


CLIP, TIMES = torch.full((3, 2, 4, 5), 100.0), torch.tensor([0, 10, 20])


@pytest.mark.parametrize(
    ("frames", "t_us", "message"),
    [
        (CLIP, torch.tensor([0, 10, 10]), "strictly increasing times"),
        (CLIP, torch.tensor([0.0, 10.0, float("nan")], dtype=torch.float64), "strictly increasing times"),
        (CLIP, TIMES[:2], r"one time each .* got frames \(3, 2, 4, 5\) and 2 times"),
        (CLIP[:0], TIMES[:0], "at least one frame"),
        (CLIP.to(torch.int64), TIMES, "uint8 or float digital numbers .* got torch.int64"),
        (CLIP / 0, TIMES, "frames: expected finite numbers, got 120 of 120"),
        (-CLIP, TIMES, "got values down to -100"),
        (257 * CLIP, TIMES, r"expected digital numbers in \[0, 255\], got values up to 25700; scale white to 255"),
        (CLIP[0, 0, 0], TIMES, r"frames: expected \(\.\.\., channels, height, width\), got \(5,\)"),
    ],
)
def test_light_that_makes_no_sense_is_refused(unchecked_annotations, frames, t_us, message):
    with pytest.raises(ValueError, match=message):
        emulate(frames, t_us, IDEAL, key=1)


def test_a_state_goes_on_with_its_own_sensor_and_later_times_alone():
    _, state = emulate(CLIP, TIMES, IDEAL, key=1)
    with pytest.raises(ValueError, match=r"the first after the state's 20\.0"):
        emulate(CLIP, TIMES, IDEAL, key=1, state=state)
    with pytest.raises(ValueError, match=r"expected a state of .* 3x5 pixels, got .* channels \(0, 1\) of 4x5 pixels"):
        emulate(CLIP[:, :, :3], TIMES + 100, IDEAL, key=1, state=state)
    with pytest.raises(ValueError, match=r"expected a state of model v2e.*, got one of model exact"):
        emulate(CLIP, TIMES + 100, of("v2e"), key=1, state=state)
    with pytest.raises(ValueError, match="2 different channel numbers"):
        emulate(CLIP, TIMES, IDEAL, key=1, channels=[1, 1])
