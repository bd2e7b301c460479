import math

import pytest
import torch

from polarnet.config.tree import load
from polarnet.events.stream import Events
from polarnet.events.streaming import EventWindow
from polarnet.methods.between import BetweenConfig, anchored, carried
from polarnet.stokes import Prediction

HEIGHT, WIDTH, WINDOW_US = 24, 32, 30_000
EVENTS_ALONE = BetweenConfig(reach=12, share=1.0, width=1, threshold_on=0.2, threshold_off=0.3)
MOTION_ALONE = BetweenConfig(reach=12, share=0.0, width=1, threshold_on=0.2, threshold_off=0.3)
NONE = Events.empty(HEIGHT, WIDTH)


def events_of(*columns):
    """Events from (t, x, y, p) of each."""
    t, x, y, p = (torch.tensor(column) for column in zip(*columns, strict=True))
    return Events(t, x.short(), y.short(), p.to(torch.int8), HEIGHT, WIDTH)


def window_of(events, number=0):
    return EventWindow([events, NONE, NONE, NONE], number * WINDOW_US, (number + 1) * WINDOW_US)


def flat(s1, s2):
    """A frame of one polarization, whose DoLP is the length of (s1, s2)."""
    stokes = torch.tensor([s1, s2])[:, None, None].expand(2, HEIGHT, WIDTH)
    return Prediction(torch.hypot(*stokes), torch.atan2(stokes[1], stokes[0]) / 2 % math.pi, None, stokes)


def pattern(seed=0):
    """A frame that differs from pixel to pixel, with a log-variance."""
    generator = torch.Generator().manual_seed(seed)
    stokes = torch.rand(2, HEIGHT, WIDTH, generator=generator) - 0.5
    log_variance = torch.randn(HEIGHT, WIDTH, generator=generator)
    return Prediction(torch.hypot(*stokes), torch.atan2(stokes[1], stokes[0]) / 2 % math.pi, log_variance, stokes)


def test_an_event_moves_atanh_s1_or_s2_of_its_pixel_by_half_a_threshold():
    state = anchored(None, window_of(NONE), flat(0.3, 0.1), EVENTS_ALONE)
    t_us = WINDOW_US + 10
    one = {
        0: events_of((t_us, 5, 2, 1)), 45: events_of((t_us, 6, 3, -1)),
        90: events_of((t_us, 7, 4, 1), (t_us, 7, 4, 1)), 135: events_of((t_us, 8, 5, -1)),
    }  # fmt: skip
    _, frame = carried(state, list(one.values()), t_us + 1, EVENTS_ALONE)
    s1, s2 = math.atanh(0.3), math.atanh(0.1)
    moved = {(2, 5): (s1 + 0.1, s2), (3, 6): (s1, s2 - 0.15), (4, 7): (s1 - 0.2, s2), (5, 8): (s1, s2 + 0.15)}
    for (y, x), along in moved.items():
        expected = [math.tanh(u) for u in along]
        assert frame.stokes[:, y, x].tolist() == pytest.approx(expected, abs=1e-6)
        assert float(frame.dolp[y, x]) == pytest.approx(math.hypot(*expected), abs=1e-6)
        assert float(frame.aolp[y, x]) == pytest.approx(math.atan2(*expected[::-1]) / 2 % math.pi, abs=1e-5)
    others = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    others[tuple(zip(*moved, strict=True))] = False
    torch.testing.assert_close(frame.dolp[others], flat(0.3, 0.1).dolp[others])


def test_the_share_and_the_mean_over_neighbours_spread_an_event():
    config = BetweenConfig(reach=12, share=0.25, width=3, threshold_on=0.2, threshold_off=0.2)
    state = anchored(None, window_of(NONE), flat(0.3, 0.0), config)
    _, frame = carried(state, [events_of((WINDOW_US, 10, 10, 1)), NONE, NONE, NONE], WINDOW_US + 100, config)
    expected = torch.full((HEIGHT, WIDTH), 0.3)
    expected[9:12, 9:12] = math.tanh(math.atanh(0.3) + 0.25 * 0.1 / 9)
    torch.testing.assert_close(frame.dolp, expected)


def test_events_at_or_after_the_time_of_a_frame_change_nothing():
    state = anchored(None, window_of(NONE), pattern(), EVENTS_ALONE)
    early, late = (WINDOW_US + 50, 3, 3, 1), (WINDOW_US + 100, 9, 9, -1)
    _, alone = carried(state, [events_of(early), NONE, NONE, NONE], WINDOW_US + 100, EVENTS_ALONE)
    after, both = carried(state, [events_of(early, late), NONE, NONE, NONE], WINDOW_US + 100, EVENTS_ALONE)
    assert torch.equal(alone.dolp, both.dolp)
    _, later = carried(after, [events_of(early, late), NONE, NONE, NONE], WINDOW_US + 101, EVENTS_ALONE)
    assert not torch.equal(later.dolp, both.dolp)


def test_a_frame_does_not_depend_on_the_frames_before_it():
    state = anchored(None, window_of(NONE), pattern(), EVENTS_ALONE)
    channels = [
        events_of((WINDOW_US + 10, 3, 3, 1), (WINDOW_US + 20, 3, 3, 1), (WINDOW_US + 90, 4, 4, -1)),
        *[NONE] * 3,
    ]
    _, at_once = carried(state, channels, WINDOW_US + 100, EVENTS_ALONE)
    for t_us in (WINDOW_US + 15, WINDOW_US + 20, WINDOW_US + 100):
        state, frame = carried(state, channels, t_us, EVENTS_ALONE)
    torch.testing.assert_close(frame.dolp, at_once.dolp)


def moving_events(displacement, seed=0):
    """Two windows of the same random events, displaced by (x, y) from the first to the second."""
    generator = torch.Generator().manual_seed(seed)
    y, x = (
        torch.randint(6, HEIGHT - 6, (150,), generator=generator),
        torch.randint(6, WIDTH - 6, (150,), generator=generator),
    )
    p = torch.randint(0, 2, (150,), generator=generator) * 2 - 1
    windows = []
    for number in range(2):
        t = torch.full((150,), number * WINDOW_US)
        moved_x, moved_y = x + number * displacement[0], y + number * displacement[1]
        events = Events(t, moved_x.short(), moved_y.short(), p.to(torch.int8), HEIGHT, WIDTH)
        windows.append(window_of(events, number))
    return windows


def test_the_frame_moves_on_with_the_displacement_from_window_to_window():
    first, second = moving_events((4, -2))
    frame = pattern()
    state = anchored(anchored(None, first, flat(0.3, 0.1), MOTION_ALONE), second, frame, MOTION_ALONE)
    torch.testing.assert_close(state.velocity * WINDOW_US, torch.tensor([-4.0, 2.0]), atol=0.2, rtol=0)
    exact = state._replace(velocity=torch.tensor([-4.0, 2.0], dtype=torch.float64) / WINDOW_US)
    _, half = carried(exact, [NONE] * 4, second.stop_us + WINDOW_US // 2, MOTION_ALONE)
    torch.testing.assert_close(half.dolp[:-1, 2:], frame.dolp[1:, :-2], atol=1e-5, rtol=0)
    torch.testing.assert_close(half.stokes[:, :-1, 2:], frame.stokes[:, 1:, :-2], atol=1e-5, rtol=0)
    torch.testing.assert_close(half.log_variance[:-1, 2:], frame.log_variance[1:, :-2], atol=1e-5, rtol=0)
    _, quarter = carried(exact, [NONE] * 4, second.stop_us + WINDOW_US // 4, MOTION_ALONE)
    between_rows = (frame.dolp[:-1, :-1] + frame.dolp[1:, :-1]) / 2
    torch.testing.assert_close(quarter.dolp[:-1, 1:], between_rows, atol=1e-5, rtol=0)


def test_events_that_the_motion_explains_change_nothing():
    config = BetweenConfig(reach=12, share=0.5, width=1, threshold_on=0.2, threshold_off=0.2)
    state = anchored(None, window_of(NONE), pattern(), config)._replace(velocity=torch.tensor([1.0, 0.0]) / 1000)
    _, moved = carried(state, [NONE] * 4, WINDOW_US + 1000, MOTION_ALONE)
    corrected = state._replace(change=torch.atanh(moved.stokes) - torch.atanh(pattern().stokes))
    _, frame = carried(corrected, [NONE] * 4, WINDOW_US + 1000, config)
    torch.testing.assert_close(frame.dolp, moved.dolp, atol=1e-5, rtol=0)


def test_without_a_confirmed_motion_the_frame_stays():
    first, second = moving_events((4, -2))[0], window_of(NONE, 1)
    state = anchored(anchored(None, first, pattern(), MOTION_ALONE), second, pattern(), MOTION_ALONE)
    assert state.velocity.tolist() == [0.0, 0.0]
    _, frame = carried(state, [NONE] * 4, second.stop_us + 1000, MOTION_ALONE)
    torch.testing.assert_close(frame.dolp, pattern().dolp)


def test_at_the_end_of_a_window_the_frame_is_that_of_the_method():
    config = BetweenConfig(reach=12, share=0.25, width=3, threshold_on=0.2, threshold_off=0.2)
    state = anchored(None, window_of(NONE), pattern(), config)
    assert carried(state, [NONE] * 4, WINDOW_US, config)[1] is state.prediction


def test_a_method_without_s1_and_s2_goes_by_its_dolp_and_aolp():
    with_stokes, without = flat(0.3, -0.1), flat(0.3, -0.1)._replace(stokes=None)
    channels = [events_of((WINDOW_US, 10, 10, 1)), NONE, NONE, NONE]
    frames = [
        carried(anchored(None, window_of(NONE), one, EVENTS_ALONE), channels, WINDOW_US + 1, EVENTS_ALONE)[1]
        for one in (with_stokes, without)
    ]
    torch.testing.assert_close(frames[0].stokes, frames[1].stokes)


def test_a_frame_without_aolp_moves_and_takes_no_events():
    frame = Prediction(pattern().dolp)
    state = anchored(None, window_of(NONE), frame, EVENTS_ALONE)._replace(velocity=torch.tensor([0.001, 0.0]))
    channels = [events_of((WINDOW_US, 10, 10, 1)), NONE, NONE, NONE]
    _, moved = carried(state, channels, WINDOW_US + 1000, EVENTS_ALONE)
    torch.testing.assert_close(moved.dolp[:, :-1], frame.dolp[:, 1:])
    assert (moved.aolp, moved.stokes, moved.log_variance) == (None, None, None)


def test_settings_take_the_thresholds_of_a_camera_and_odd_widths_only(project_root):
    config = load(project_root).between
    assert config.with_thresholds(None) == config
    given = config.with_thresholds([0.12, 0.16])
    assert (given.threshold_on, given.threshold_off, given.share) == (0.12, 0.16, config.share)
    with pytest.raises(ValueError, match="expected an odd number of pixels, got 4"):
        load(project_root, ["between.width=4"])
