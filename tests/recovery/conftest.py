"""Events of four channels of 16 x 20 pixels in 0.1 s."""

import pytest
from event_fixtures import events_of, random_events

from polarnet.events.stream import merge
from polarnet.storage.events import EventStore

HEIGHT, WIDTH, DURATION_US = 16, 20, 100_000


@pytest.fixture(scope="session")
def make_channel():
    """Random events from time 0 to the last microsecond."""

    def channel(seed, height=HEIGHT, width=WIDTH):
        ends = events_of([(0, 1, 1, 1), (DURATION_US - 1, 1, 1, -1)], height, width)
        return merge([random_events(seed, 2000, DURATION_US - 1, height, width), ends])

    return channel


@pytest.fixture(scope="session")
def channels(make_channel):
    return [make_channel(seed) for seed in range(4)]


@pytest.fixture(scope="session")
def store(channels, tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "events.zarr"
    writer = EventStore.create(path, ["lake", "road"], HEIGHT, WIDTH, {})
    for name in writer.sequences:
        writer.write(name, channels, DURATION_US)
    writer.finish()
    return path


@pytest.fixture
def at_root(project_root, monkeypatch):
    monkeypatch.chdir(project_root)
