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


@pytest.mark.parametrize(
    ("name", "options", "form"),
    [
        ("e.aedat4", {}, "aedat4"),
        ("e.es", {}, "event_stream"),
        ("e.raw", {"version": "evt3"}, "evt"),
        ("e.raw", {"version": "evt2"}, "evt"),
        ("e.dat", {"version": "dat2"}, "dat"),
    ],
)
def test_files_that_faery_writes_are_read(tmp_path, read, name, options, form):
    stated, (t, *columns), repairs = read(write(tmp_path / name, **options))
    assert (stated, repairs) == ((form, 260, 346), {})
    assert [one - t[0] for one in t] == [0, 4, 4]
    assert columns == [[1, 345, 3], [2, 259, 4], [1, -1, 1]]


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


def test_a_file_that_ends_within_a_packet_is_read_up_to_there(tmp_path, read):
    rows = [(1000 * k, k % 346, k % 260, k % 2 == 0) for k in range(600)]
    path = write_streams(tmp_path / "e.aedat4", left=((346, 260), rows))
    _, (whole, *_), repairs = read(path)
    assert (whole, repairs) == ([row[0] for row in rows], {})
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    _, (t, *_), repairs = read(path)
    assert (t, repairs) == (whole[: len(t)], {"cut_tail": 1})
    assert 200 < len(t) < 500


def test_a_file_cut_within_its_header_is_refused_with_what_the_library_says(tmp_path):
    path = write(tmp_path / "e.aedat4")
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(RecordingError, match=r"e\.aedat4: faery cannot read it: "):
        read_recording(path)


@pytest.mark.thorough
def test_damage_that_crashes_the_library_ends_in_events_or_in_the_reason(tmp_path):
    """Bytes that state sizes and places: some of them end the process that faery runs in, and none ours."""
    sound = write(tmp_path / "e.aedat4").read_bytes()
    path, reasons = tmp_path / "damaged.aedat4", []
    for place in range(len(sound) // 2, len(sound), 3):
        path.write_bytes(sound[:place] + b"\xff" + sound[place + 1 :])
        try:
            assert len(read_recording(path).events) <= len(ROWS)
        except RecordingError as error:
            reasons.append(str(error))
    assert len(reasons) > 20
    assert all(reason.startswith("damaged.aedat4: ") for reason in reasons)
