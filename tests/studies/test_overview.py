"""The overview of the README, from the small simulated sequences."""

import numpy as np
import pytest
import torch

from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.panels import Panel, Shown, fraction_bytes
from polarnet.storage.scenes import SceneStore
from studies.overview import MAX_EVENTS, hue_wheel, overview_figure, overview_of_panel

WINDOW = 3


@pytest.fixture(scope="module")
def frames(simulated):
    return FrameStore.open(simulated.frames).frames("a-0")


@pytest.fixture(scope="module")
def overview(simulated, frames):
    dolp, end_us = frames.dolp[WINDOW + 1], int(frames.t_us[WINDOW + 1])
    film, times = fraction_bytes(dolp)[None], torch.tensor([end_us])
    ours = Shown(dolp, None, film, None)
    events = torch.zeros(4, *dolp.shape)
    panel = Panel("a-0", WINDOW, end_us, events, dolp, times, film, film, ours, {"ours": ours})
    stores = SceneStore.open(simulated.scenes), FrameStore.open(simulated.frames), EventStore.open(simulated.events)
    return overview_of_panel(panel, *stores)


def test_the_overview_shows_every_event_of_the_panels_window(overview, frames):
    start_us, end_us = frames.t_us[WINDOW : WINDOW + 2].tolist()
    assert (overview.start_us, overview.duration_us) == (start_us, end_us - start_us)
    for stream in overview.streams:
        assert start_us <= int(stream.t.min()) <= int(stream.t.max()) < end_us
    clouds = [axes.collections[0] for axes in overview_figure(overview).axes if axes.collections]
    assert [len(cloud.get_offsets()) for cloud in clouds] == [len(stream) for stream in overview.streams]
    assert max(map(len, overview.streams)) < MAX_EVENTS


def test_the_outline_has_the_size_of_the_sensor_and_lies_on_the_picture(overview, frames):
    height, width = frames.dolp.shape[1:]
    side = np.hypot(*np.diff(overview.outline, axis=1))
    assert side == pytest.approx([width, height, width, height], rel=0.3)
    assert (overview.outline.min(axis=1) >= -1).all()
    assert (overview.outline.max(axis=1) <= np.array(overview.picture.shape[1::-1]) + 1).all()


@pytest.mark.parametrize(
    ("direction_deg", "colour"),
    [(0, (255, 0, 0)), (60, (0, 255, 0)), (120, (0, 0, 255)), (180, (255, 0, 0))],
)
def test_the_wheel_shows_at_each_direction_the_colour_of_that_angle(direction_deg, colour):
    middle, radius, angle = 200, 196, np.radians(direction_deg)
    place = middle - round(radius * np.sin(angle)), middle + round(radius * np.cos(angle))
    assert hue_wheel(401)[place][:3].astype(int) == pytest.approx(colour, abs=10)
