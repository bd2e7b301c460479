"""Properties of every pixel model: hand-worked ramps, equal bytes for any split of the work, clear errors."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from event_fixtures import equal
from simulation_fixtures import QUIET, REST, STILL, moving_bars

from polarnet.events.stream import concatenate, validate
from polarnet.simulation import PolarizationScene, Trajectory, emulate_motion
from polarnet.simulation.camera import Camera, grid
from polarnet.simulation.emulator import MODELS, Channels, EmulatorConfig, emulate, emulate_frames
from polarnet.simulation.pixels.columns import MAX_STEP_US
from polarnet.simulation.presets import SENSORS
from polarnet.simulation.rotating import RotatingConfig, emulate_rotating

NOISY = dataclasses.replace(
    QUIET, contrast_threshold_sigma_on=0.03, contrast_threshold_sigma_off=0.03, cutoff_hz=100.0, leak_rate_hz=2.0,
    leak_jitter=0.1, noise_rate_cov_decades=0.1, shot_noise_rate_hz=5.0, refractory_period_us=500.0,
)  # fmt: skip
THRESHOLD_MODELS = ["v2e", "exact", "esim"]


def of(model: str, base: EmulatorConfig = QUIET, **changes) -> EmulatorConfig:
    return dataclasses.replace(base, model=model, **changes)


def log_ramp(start: float, stop: float, steps: int) -> torch.Tensor:
    """One pixel whose natural-log digital number goes from start to stop in equal steps."""
    return torch.linspace(start, stop, steps + 1, dtype=torch.float64).exp().float().view(-1, 1, 1, 1)


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
def test_the_photoreceptor_answers_a_step_to_white_like_a_first_order_low_pass(model, tolerance_us):
    every_us, rate = 20, 2 * math.pi * 50
    t_us = np.append(0, 1 + every_us * np.arange(1500))
    frames = np.full((len(t_us), 1, 1, 1), 255.0, np.float32)
    frames[0] = 25
    (events,), _ = emulate(frames, t_us, of(model, cutoff_hz=50.0), key=1)
    risen = 0.2 * np.arange(1, 11) / math.log(255 / 25)  # fraction of the step at each ON event
    assert events.p.tolist()[:10] == [1] * 10
    assert events.t[:10].numpy() == pytest.approx(-1e6 / rate * np.log(1 - risen), abs=tolerance_us)


def test_v2e_spreads_events_over_a_step_and_does_not_consume_what_its_refractory_period_suppresses():
    frames = torch.tensor([[math.exp(4.0), math.exp(4.0)], [math.exp(4.61), math.exp(4.21)]]).float().view(2, 1, 1, 2)
    (events,), _ = emulate(frames, torch.tensor([0, 3000]), of("v2e"), key=1)
    # three events of the first pixel at thirds; the second pixel's only event shares the first slot
    assert events.t.tolist() == [1000, 1000, 2000, 3000]
    assert events.x.tolist() == [0, 1, 0, 0]
    frames = torch.tensor([4.0, 4.61, 4.61]).exp().float().view(3, 1, 1, 1)
    (events,), _ = emulate(frames, torch.tensor([0, 3000, 6000]), of("v2e", refractory_period_us=2500.0), key=1)
    # slots at 1, 2, 3 ms: only the first is taken; two thresholds remain, tried again at 4.5 and 6 ms
    assert events.t.tolist() == [1000, 4500]


def test_exact_fires_a_delayed_event_when_the_refractory_period_ends_unless_the_light_has_gone_back():
    frames = torch.tensor([4.0, 4.61, 4.61]).exp().float().view(3, 1, 1, 1)
    config = of("exact", refractory_period_us=2500.0)
    (events,), state = emulate(frames, torch.tensor([0, 6100, 9000]), config, key=1)
    # crossings at 2, 4 and 6 ms; the second has to wait for 4.5, the third for 7 ms
    assert events.t.tolist() == pytest.approx([2000, 4500, 7000], abs=1)
    assert state.pixels[0].change[0] == pytest.approx(0.01, abs=1e-6)
    frames = torch.tensor([4.0, 4.41, 4.21]).exp().float().view(3, 1, 1, 1)
    (events,), _ = emulate(frames, torch.tensor([0, 4100, 6100]), of("exact", refractory_period_us=4000.0), key=1)
    # crossings at 2 and 4 ms; at 6 ms, when the second may fire, only 0.22 - 0.2 of change is left
    assert events.t.tolist() == pytest.approx([2000], abs=1)


@pytest.mark.parametrize("share", [0.0, 0.1])
@pytest.mark.parametrize("model", list(MODELS))
def test_pieces_and_threads_change_no_event(model, share):
    """Of valid events in the order (t, y, x, p), from sensors with and without hot pixels."""
    config = of(model, NOISY, hot_pixel_share=share, hot_pixel_rate_hz=500.0)
    frames, t_us = moving_bars(), 3333.5 * torch.arange(12, dtype=torch.float64)
    whole, end = emulate(frames, t_us, config, key=7)
    assert sum(map(len, whole)) > 2000
    for channel in whole:
        validate(channel)
        assert np.array_equal(np.lexsort((channel.p, channel.x, channel.y, channel.t)), np.arange(len(channel)))
    pieces, state = [], None
    for piece in (slice(0, 1), slice(1, 5), slice(5, 6), slice(6, 12)):
        before = [array.copy() for pixels in state.pixels for array in pixels] if state else []
        events, after = emulate(frames[piece], t_us[piece], config, key=7, state=state)
        untouched = [array for pixels in state.pixels for array in pixels] if state else []
        assert all(map(np.array_equal, before, untouched))
        pieces, state = [*pieces, events], after
    assert all(equal(concatenate(parts), all_) for parts, all_ in zip(zip(*pieces, strict=True), whole, strict=True))
    assert (state.t_us, state.steps) == (end.t_us, end.steps) == (11 * 3333.5, 11)
    threaded, _ = emulate(frames, t_us, config, key=7, threads=2)
    assert all(map(equal, threaded, whole))


ONLY_HERE = ("exact", "dvs_voltmeter")
"""Models whose kernels for bytes no other test compiles, which takes seconds."""


@pytest.mark.parametrize(
    "model", [pytest.param(model, marks=[pytest.mark.thorough] * (model in ONLY_HERE)) for model in MODELS]
)
def test_whole_numbers_mean_the_same_as_bytes_and_as_floats(model):
    t_us = 3333 * torch.arange(12)
    from_bytes, _ = emulate(moving_bars().byte(), t_us, of(model, NOISY), key=3)
    from_floats, _ = emulate(moving_bars().byte().double(), t_us, of(model, NOISY), key=3)
    if model.startswith("esim"):  # bytes take the float32 closest to the logarithm, floats a faster one
        assert [len(e) for e in from_floats] == pytest.approx([len(e) for e in from_bytes], rel=1e-3)
    else:
        assert all(equal(a, b) for a, b in zip(from_bytes, from_floats, strict=True))


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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": "iebcs"}, "model: expected one of v2e, exact, esim, dvs_voltmeter"),
        ({"contrast_threshold_on": 0.0}, "contrast_threshold_on: expected >= 0.01"),
        ({"knee_dn": 1.0}, "knee_dn: expected >= 2.72"),
        ({"model": "esim", "dark_dn": 5.0}, r"dark_dn: expected None with model esim, got 5\.0; models .*: v2e, exact"),
        (
            {"dark_dn": 5.0, "randomise": {"model": ["exact", "esim"]}},
            "randomise.dark_dn: expected None with model esim",
        ),
    ],
)
def test_a_configuration_out_of_range_is_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(QUIET, **changes)


CLIP, TIMES = torch.full((3, 2, 4, 5), 100.0), torch.tensor([0, 10, 20])


@pytest.mark.parametrize(
    ("frames", "t_us", "message"),
    [
        (CLIP, torch.tensor([0, 10, 10]), "strictly increasing times"),
        (CLIP, torch.tensor([0.0, 10.0, float("nan")], dtype=torch.float64), "strictly increasing times"),
        (CLIP[:2], torch.tensor([2.0**54, 2.0**54 + 8], dtype=torch.float64), r"times in us, of at most 2\^53"),
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
        emulate(frames, t_us, QUIET, key=1)


def test_a_state_goes_on_with_its_own_sensor_and_later_times_alone():
    _, state = emulate(CLIP, TIMES, QUIET, key=1)
    with pytest.raises(ValueError, match=r"strictly increasing times .* got \[20\. +0\.\]"):
        emulate(CLIP, TIMES, QUIET, key=1, state=state)
    with pytest.raises(ValueError, match=r"expected a state of .* 3x5 pixels, got .* 2 channels of 4x5 pixels"):
        emulate(CLIP[:, :, :3], TIMES + 100, QUIET, key=1, state=state)
    with pytest.raises(ValueError, match=r"expected a state of model v2e.*, got one of model exact"):
        emulate(CLIP, TIMES + 100, of("v2e"), key=1, state=state)


@pytest.mark.parametrize("model", ["v2e", "exact"])
def test_a_sensor_without_noise_fires_nothing_once_the_light_has_stopped_changing_and_knows_no_seed(model):
    """No leak moves the remembered level, no photoreceptor lags behind, and without mismatch every key is the same."""
    levels = torch.arange(256.0).expand(2, 1, 16, 256)
    mismatched = dataclasses.replace(SENSORS["clean"], model=model)
    for key in (1, 3_000_000_000):
        assert len(emulate(levels, torch.tensor([0, 3_600_000_000]), mismatched, key=key)[0][0]) == 0  # an hour
    moving = moving_bars(1)
    held = torch.cat([moving, moving[-1:].expand(10, -1, -1, -1)])
    (first,), (other,) = (emulate(held, 10_000 * torch.arange(22), of(model), key=key)[0] for key in (1, 2))
    assert len(first) > 300
    assert first.t.max() <= 110_000
    assert equal(first, other)


@pytest.mark.parametrize("model", ["v2e", "exact"])
def test_with_dark_dn_a_step_by_a_factor_fires_alike_over_six_decades_of_light(model):
    """ln 3 is five thresholds of 0.2; v2e sees light below 1 DN then, also from pieces, which it rounds otherwise."""
    level = 255e-6 * torch.tensor([1.0, 1e2, 1e4, 3e5])
    frames, t_us = torch.stack([level, 3 * level]).view(2, 1, 1, 4), np.array([0, 10_000])
    config = of(model, dark_dn=0.0)
    (events,), _ = emulate(frames, t_us, config, key=1)
    assert torch.bincount(events.x.long()).tolist() == [4, 5, 5, 5]  # dark counts as 0.0001 DN, beside 0.000255 DN
    pieces = [(t_us, frames.numpy().transpose(1, 0, 2, 3))]
    (again,), _ = emulate_frames(Channels(1, 4, config, 1), pieces)
    assert equal(again, events)


def test_a_pixel_held_in_reset_forgets_the_change_and_the_leak_of_its_refractory_period():
    """A ramp of 1.0 in 1 ms crosses 0.2 at 200 us, is forgotten until 700 us, and crosses again at 900 us."""
    frames = log_ramp(4.0, 5.0, 1).repeat_interleave(torch.tensor([1, 2]), 0)
    t_us = np.array([0.0, 1000.0, 5000.0])
    for refractory, expected in (("keep", [199, 699, 1199, 1699]), ("reset", [199, 899])):
        config = of("exact", refractory_period_us=500.0, refractory=refractory)
        (events,), _ = emulate(frames, t_us, config, key=1)
        assert events.t.tolist()[:4] == pytest.approx(expected, abs=1)
    config = of("exact", leak_rate_hz=10.0, refractory_period_us=150_000.0, refractory="reset")
    (events,), _ = emulate(torch.full((101, 1, 1, 1), 90.0), 100_000 * np.arange(101), config, key=1)
    assert events.t.diff().tolist() == pytest.approx([250_000] * (len(events) - 1), abs=2)


@pytest.mark.parametrize("name", ["davis346", "gen41", "celex5"])
def test_presets_of_real_cameras_fire_signal_and_noise_over_six_decades(name):
    """Their thresholds are crossed as often at 1 DN as at 100 DN, and rarely at a thousandth of their dark current."""
    t_us = 1000.0 * np.arange(1001)
    swing = np.exp(np.sin(2 * math.pi * t_us / 1e6 - math.pi / 2))
    levels = np.array([1e-4, 1.0, 90.0]).repeat(400)
    frames = np.minimum(swing[:, None] * levels, 255).astype(np.float32).reshape(-1, 1, 1, 1200)
    (events,), _ = emulate(frames, t_us, SENSORS[name], key=1)
    dark, dim, bright = torch.bincount(events.x.long() // 400, minlength=3).tolist()
    assert dim == pytest.approx(bright, rel=0.15)
    assert 0 < dark < 0.2 * dim


STEP = torch.tensor([50.0, 200.0]).view(2, 1, 1, 1).expand(2, 1, 3, 3)
MODEL_NAMES = pytest.mark.parametrize("model", list(MODELS))


@MODEL_NAMES
@pytest.mark.parametrize("start_us", [0.0, -5e6, 2.0**31 - 1e6, 2.0**51])
def test_a_step_of_71_minutes_has_its_events_within_it_and_a_longer_one_is_refused(model, start_us):
    config = of(model, refractory_period_us=500.0)
    t_us = torch.tensor([start_us, start_us + MAX_STEP_US], dtype=torch.float64)
    (events,), state = emulate(STEP, t_us, config, key=1)
    assert len(validate(events)) >= 9 * 5
    assert events.t.min() >= start_us
    assert events.t.max() <= start_us + MAX_STEP_US
    with pytest.raises(ValueError, match=r"at most 4295 s from one frame to the next, got 5000 s .* insert frames"):
        emulate(STEP, torch.tensor([start_us, start_us + 5e9], dtype=torch.float64), config, key=1)
    with pytest.raises(ValueError, match="at most 4295 s from one frame to the next"):  # after a pause of a live camera
        emulate(STEP[:1], t_us[1:] + 5e9, config, key=1, state=state)


@MODEL_NAMES
def test_a_rotating_and_a_moving_sensor_refuse_long_steps_too(model):
    scene, rest = PolarizationScene(torch.full((3, 8, 8), 0.1)), Trajectory(3.5, 3.5, REST, REST, STILL, STILL, 0.0)
    config = of(model, render_rate_hz=2e-4)
    with pytest.raises(ValueError, match="from one frame to the next, got 5000 s"):
        emulate_motion(Camera(config, key=1), scene, rest, 5_000_000_000, (4, 4))
    slow = RotatingConfig(rate_hz=1e-6, start_angle_deg=0.0, extinction_ratio=None, frames_per_turn=32)
    with pytest.raises(ValueError, match="from one frame to the next, got 5000 s"):
        emulate_rotating(slow, Camera(config, key=1), scene, rest, 5_000_000_000, grid("four_sensors", 4, 4))


@pytest.mark.parametrize("model", ["v2e", "exact"])
def test_a_pixel_can_fire_a_million_times_in_one_step(model):
    config = of(model, leak_rate_hz=1e4, contrast_threshold_on=0.01)
    (events,), _ = emulate(STEP[:1, :, :1, :1].expand(2, 1, 1, 1), np.array([0.0, 1e8]), config, key=1)
    assert len(validate(events)) == pytest.approx(1e6, rel=1e-3)
    assert int(events.t.max()) <= 1e8


def test_shot_noise_goes_on_since_1970_and_v2es_refractory_period_holds_at_negative_times():
    """There float64 resolves quarters of a microsecond: a shorter wait would draw the same wait again, without end."""
    config, start_us = of("exact", shot_noise_rate_hz=1e5, refractory_period_us=100.0), 1.76e15
    pieces, state = [], None
    for k in range(3):
        (events,), state = emulate(STEP[:1], np.array([start_us + 1e5 * k]), config, key=1, state=state)
        pieces.append(events)
    assert len(concatenate(pieces)) > 9 * 1000
    config = of("v2e", refractory_period_us=500.0)
    late, early = (emulate(STEP, np.array([t, t + 1e4]), config, key=1)[0][0] for t in (0.0, -1e6))
    assert (early.t + 1_000_000).tolist() == late.t.tolist()
