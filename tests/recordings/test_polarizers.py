"""Recordings without polarizers, or with another order of them, are named."""

import dataclasses
import itertools

import pytest
import torch

from polarnet.events.stream import Events, join_mosaic, split_mosaic
from polarnet.recordings.arrangements import Piece, read_mosaic
from polarnet.recordings.polarizers import ChannelCheck
from polarnet.simulation import BUILTIN_PHOTOS, MOTIONS, SENSORS, read_rgb, scene_from_polarization, simulate
from polarnet.simulation.scene import polarization_from_rgb
from polarnet.stokes import POLARIZER_ANGLES_DEG

DURATION_US = 200_000
SONY = ((90, 45), (135, 0))
ORDERS = [((a, b), (c, d)) for a, b, c, d in itertools.permutations(POLARIZER_ANGLES_DEG)]


def events_of(dolp_factor):
    """Four channels of a photograph whose DoLP is reduced by a factor."""
    (photo,) = (photo for photo in BUILTIN_PHOTOS if photo.file == "rocket.jpg")
    s0, dolp, aolp = polarization_from_rgb(read_rgb(photo.path)[:, :400, :600])
    motion = dataclasses.replace(MOTIONS["default"], sensor_height=160, sensor_width=240, duration_s=DURATION_US * 1e-6)
    return simulate(scene_from_polarization(s0, dolp_factor * dolp, aolp), motion, SENSORS["default"], seed=1).events


@pytest.fixture(scope="module")
def polarized():
    return events_of(1.0)


@pytest.fixture(scope="module")
def unpolarized():
    return events_of(0.0)


def camera_of(channels):
    """Events of a sensor whose 2x2 pixels have polarizers in Sony's order."""
    return join_mosaic([split_mosaic(events, SONY)[number] for number, events in enumerate(channels)], SONY)


def findings(channels, *, mosaic=False):
    check = ChannelCheck(channels[0].height, channels[0].width, mosaic=mosaic)
    piece = Piece(channels, DURATION_US, 0.0)
    assert list(check.watch([piece])) == [piece]
    assert check.counts == [len(events) for events in channels]
    return " ".join(check.findings())


def right_angles(order):
    """The two angles of each pair, 0 with 90 and 45 with 135, lie where the Sony order has a pair."""
    place = {order[r][c]: SONY[r][c] for r in (0, 1) for c in (0, 1)}
    return abs(place[0] - place[90]) == 90


def test_four_files_in_their_order_are_not_named_and_in_another_order_are(polarized):
    assert findings(polarized) == ""
    i0, i45, i90, i135 = polarized
    assert "0 and 45, 90 and 135 degrees fit better" in findings([i0, i90, i45, i135])
    assert "exchange 45 and 90 in --mosaic or --angles" in findings([i0, i90, i45, i135])
    assert "0 and 135, 45 and 90 degrees fit better" in findings([i0, i45, i135, i90])
    assert "exchange 90 and 135" in findings([i0, i45, i135, i90])


def test_every_order_of_a_mosaic_that_changes_dolp_is_named(polarized):
    camera = camera_of(polarized)
    for order in ORDERS:
        warning = findings(split_mosaic(camera, order), mosaic=True)
        assert ("another order" in warning) == (not right_angles(order)), order


def test_a_mosaic_without_polarizers_is_named_whatever_its_order(unpolarized):
    camera = camera_of(unpolarized)
    sentence = "Either the recording was made without polarizers, or its scene is hardly"
    assert all(sentence in findings(split_mosaic(camera, order), mosaic=True) for order in ORDERS[::5])


def test_channels_that_cannot_be_right_are_named(polarized, unpolarized):
    silent = Events.empty(polarized[0].height, polarized[0].width)
    assert "The four channels show the same" in findings(unpolarized)
    assert "The four channels are the same" in findings([polarized[0]] * 4)
    assert "no events behind the polarizer at 45 degrees" in findings([polarized[0], silent, *polarized[2:]])


@pytest.mark.parametrize(("rate_hz", "sentence"), [(5_000, ""), (20_000, "Hot pixels with more than 10,000 events")])
def test_a_hot_pixel_that_disturbs_the_whole_image_is_named(rate_hz, sentence):
    times = torch.arange(0, DURATION_US, 1_000_000 // rate_hz)
    where = torch.full((len(times),), 8, dtype=torch.int16)
    hot = Events(times, where, where, torch.ones(len(times), dtype=torch.int8), 16, 16)
    one = Events(times[:1], where[:1] - 5, where[:1], torch.ones(1, dtype=torch.int8), 16, 16)
    assert findings([hot, one, one, one]).startswith(sentence)
    assert bool(findings([hot, one, one, one])) == bool(sentence)


def test_of_too_few_events_nothing_is_said():
    few = Events(torch.arange(100), *(torch.ones(100, dtype=torch.int16),) * 2, torch.ones(100).to(torch.int8), 40, 40)
    assert findings([few] * 4) == ""


@pytest.mark.shared
def test_real_recordings_without_polarizers_are_named(shared):
    for name in ("event_stream/dvs.es", "aedat4/tonic_sample.aedat4", "prophesee/evt2.raw"):
        channels = read_mosaic(shared / "data" / "recordings" / name, SONY)
        check = ChannelCheck(channels[0].height, channels[0].width, mosaic=True)
        list(check.watch([Piece(channels, max(int(events.t[-1]) for events in channels) + 1, 0.0)]))
        assert "without polarizers" in " ".join(check.findings()), name
