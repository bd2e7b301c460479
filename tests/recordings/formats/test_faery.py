import numpy as np
import pytest

from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError

ROWS = [(5, 1, 2, True), (9, 345, 259, False), (9, 3, 4, True)]


def write(path, **options):
    faery = pytest.importorskip("faery")
    events = np.array(ROWS, faery.EVENTS_DTYPE)
    faery.events_stream_from_array(events, (346, 260)).to_file(path, **options)
    return path


def write_streams(path, **streams):
    """AEDAT4 with a packet of 60 events for each stream of events: its sensor's width and height, and its rows."""
    dv = pytest.importorskip("dv_processing", reason="the extra live is not installed")
    config = dv.io.MonoCameraWriter.Config("DAVIS346")
    for name, (size, _) in streams.items():
        config.addEventStream(size, name)
    writer = dv.io.MonoCameraWriter(str(path), config)
    writer.setPackagingCount(60)
    for name, (_, rows) in streams.items():
        for start in range(0, len(rows), 60):
            store = dv.EventStore()
            for row in rows[start : start + 60]:
                store.push_back(*row)
            writer.writeEvents(store, name)
    return path


def test_a_file_with_two_streams_of_events_needs_the_stream(tmp_path, read):
    path = write_streams(tmp_path / "e.aedat4", left=((346, 260), ROWS), right=((640, 480), [(7, 639, 479, True)]))
    with pytest.raises(RecordingError, match=r"e\.aedat4: say which stream of events to read, --part with one of 0, 1"):
        read(path)
    assert read(path, part="0")[1] == [[5, 9, 9], [1, 345, 3], [2, 259, 4], [1, -1, 1]]
    assert read(path, part="1") == (("aedat4", 480, 640), [[7], [639], [479], [1]], {})


def test_a_file_that_ends_within_a_packet_is_read_up_to_there_and_one_cut_within_its_header_refused(tmp_path, read):
    rows = [(1000 * k, k % 346, k % 260, k % 2 == 0) for k in range(600)]
    path = write_streams(tmp_path / "e.aedat4", left=((346, 260), rows))
    _, (whole, *_), repairs = read(path)
    assert (whole, repairs) == ([row[0] for row in rows], {})
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    _, (t, *_), repairs = read(path)
    assert (t, repairs) == (whole[: len(t)], {"cut_tail": 1})
    assert 200 < len(t) < 500
    path = write(tmp_path / "e.aedat4")
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(RecordingError, match=r"e\.aedat4: faery cannot read it: "):
        read_recording(path)
