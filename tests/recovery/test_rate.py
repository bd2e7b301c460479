import pytest
import torch
import zarr

from polarnet.cli import main
from polarnet.events.stream import slice_time
from polarnet.events.streaming import WindowRule
from polarnet.methods.between import BetweenConfig
from polarnet.methods.method import Recoverer
from polarnet.recordings.arrangements import Piece
from polarnet.recovery.rate import Rate, check_rate, frames_at_rate
from polarnet.recovery.stream import Input, frames_of
from polarnet.stokes import Prediction

HEIGHT, WIDTH, DURATION_US, WINDOW_US = 16, 20, 100_000, 20_000
CONFIG = BetweenConfig(reach=12, share=0.25, width=3, threshold_on=0.2, threshold_off=0.2)
WINDOWS = WindowRule(WINDOW_US, None, None)


def _predicted(state, windows):
    """A stand-in for a network: s1 and s2 from each window's events, without state."""
    stokes = []
    for window in windows:
        sums = torch.zeros(4, HEIGHT * WIDTH)
        for image, events in zip(sums, window.channels, strict=True):
            image.index_add_(0, events.y.long() * WIDTH + events.x.long(), events.p.float())
        differences = torch.stack([sums[0] - sums[2], sums[1] - sums[3]]).view(2, HEIGHT, WIDTH)
        stokes.append(torch.tanh(0.1 * differences))
    s1, s2 = torch.stack(stokes, dim=1)
    return state, Prediction(torch.hypot(s1, s2), torch.atan2(s2, s1) / 2 % torch.pi, None, torch.stack([s1, s2], 1))


NETWORK = Recoverer(lambda height, width: None, _predicted)


def source_of(channels, ends=(DURATION_US,)):
    """The events in pieces that end at these times."""
    starts = [0, *ends[:-1]]
    pieces = [
        Piece([slice_time(one, start, stop) for one in channels], stop, 0.0)
        for start, stop in zip(starts, ends, strict=True)
    ]
    return Input("events", HEIGHT, WIDTH, pieces)


def at_rate(hz, channels, rule=WINDOWS, ends=(DURATION_US,)):
    return list(frames_at_rate(source_of(channels, ends), rule, NETWORK, Rate(hz, CONFIG)))


def test_frames_come_at_multiples_of_the_period_from_the_first_window_to_the_last_event(channels):
    assert [frame.window.stop_us for frame in at_rate(1000, channels)] == list(range(20_000, 100_001, 1000))
    thirds = [frame.window.stop_us for frame in at_rate(3000, channels)]
    assert thirds == [round(1e6 * number / 3000) for number in range(60, 301)]
    of_33_ms = [frame.window.stop_us for frame in at_rate(2000, channels, WindowRule(33_333, None, None))]
    assert of_33_ms == list(range(33_500, 100_001, 500))


def test_frames_at_the_ends_of_windows_are_those_of_the_windows(channels):
    of_windows = {frame.window.stop_us: frame for frame in frames_of(source_of(channels), WINDOWS, NETWORK)}
    frames = {frame.window.stop_us: frame for frame in at_rate(1000, channels)}
    assert len(of_windows) == 5
    for stop_us, expected in of_windows.items():
        assert torch.equal(frames[stop_us].prediction.dolp, expected.prediction.dolp)
        assert torch.equal(frames[stop_us].prediction.aolp, expected.prediction.aolp)
    between = frames[30_000]
    assert not torch.equal(between.prediction.dolp, frames[20_000].prediction.dolp)
    assert [len(e) for e in between.window.channels] == [len(slice_time(e, 10_000, 30_000)) for e in channels]


@pytest.mark.parametrize("rule", [WINDOWS, WindowRule(None, 2000, None)])
def test_pieces_of_any_length_give_the_same_frames(channels, rule):
    whole, pieces = (
        at_rate(1000, channels, rule, ends) for ends in ((DURATION_US,), (777, 20_500, 41_000, 99_000, DURATION_US))
    )
    assert [frame.window.stop_us for frame in whole] == [frame.window.stop_us for frame in pieces]
    for one, other in zip(whole, pieces, strict=True):
        torch.testing.assert_close(one.prediction.dolp, other.prediction.dolp)
        assert [len(events) for events in one.window.channels] == [len(events) for events in other.window.channels]


@pytest.mark.parametrize(("hz", "step_us", "once", "reason"), [
    (50.0, None, False, "expected more than the 50 frames a second that windows of 20 ms give, got 50"),
    (20_000.0, None, False, "at most 10,000 frames a second, got 20000"),
    (-1.0, None, False, "expected more than 0"),
    (2000.0, 5000, False, "--rate and --step: expected one of them"),
    (2000.0, None, True, "frames are as cheap with --step 0.5ms"),
])  # fmt: skip
def test_rates_that_make_no_sense_are_refused(hz, step_us, once, reason):
    with pytest.raises(ValueError, match=reason):
        check_rate(hz, WindowRule(WINDOW_US, None, step_us), NETWORK._replace(takes_events_once=once))
    check_rate(60.0, WINDOWS, NETWORK)
    check_rate(2000.0, WindowRule(None, 2000, None), NETWORK)


def test_the_command_writes_frames_at_the_rate_and_refuses_it_with_a_rotating_polarizer(
    store, at_root, tmp_path, capsys
):
    lake, out = (str(store), "--sequence", "lake"), ("--out", str(tmp_path / "out"), "--write", "zarr")
    assert main(["recover", *lake, "--rate", "1000", "--device", "cpu", *out]) == 0
    assert "1000 frames a second" in capsys.readouterr().out
    times = zarr.open_group(tmp_path / "out" / "recovered.zarr", mode="r")["t_us"][:]
    assert times.tolist() == list(range(34_000, 100_001, 1000))
    assert main(["recover", *lake, "--rate", "20", *out]) == 1
    assert "windows of 33.333 ms give, got 20" in capsys.readouterr().err
    camera = tmp_path / "camera.txt"
    camera.write_text("20 16\n0 0 0 1\n")
    assert main(["recover", str(camera), "--rotating", "15", "--rate", "2000", *out]) == 1
    assert "expected no --rate" in capsys.readouterr().err
