import pytest

from polarnet.reports.artefacts import read_artefacts
from polarnet.reports.maps import png
from polarnet.reports.overview import MAX_EVENTS, overview_figure


@pytest.fixture(scope="module")
def overview(paths):
    return read_artefacts(paths, []).overview


def test_the_overview_has_the_same_bytes_each_time(overview):
    assert png(overview_figure(overview)) == png(overview_figure(overview))


def test_every_event_of_a_sparse_stream_is_drawn(overview):
    clouds = [axes.collections[0] for axes in overview_figure(overview).axes if axes.collections]
    assert [len(cloud.get_offsets()) for cloud in clouds] == [len(stream) for stream in overview.streams]
    assert max(len(stream) for stream in overview.streams) < MAX_EVENTS
