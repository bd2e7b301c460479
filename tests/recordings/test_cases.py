"""Files of the reference cases: layouts that once failed, and controls. Their kinds have tests of their own beside.

Each test records what it saw as the property "now", for the table of `studies.recordings`.
"""

from textwrap import shorten

import pytest

from polarnet.recordings.live import read_lines
from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError

VGA = {"height": 480, "width": 640}
SYNTHETIC = (1164, 199_805, [91, 359, 90], [10, 454, 339], [-1, -1, 1])
STEREO = (637, 199_911, [50, 326, 220], [5, 98, 52], [1, 1, -1])
AEDAT4 = (1_600_000_000_000_637, 1_600_000_000_199_911, *STEREO[2:])
FRAMES = (1_600_000_000_000_000, 1_600_000_000_039_900, [0, 1, 2], [0, 1, 2], [-1, 1, -1])
CUT = (1_600_000_000_000_050, 1_600_000_000_018_000, [1, 2, 3], [0, 1, 2], [-1, 1, -1])
LATE = (2_000_000, 3_999_000, *FRAMES[2:])
GLITCH = (0, 499_750, [30, 32, 48], [30, 26, 17], [-1, -1, -1])
CASES = {
    "aedat31.aedat": ({}, ("aedat3", 128, 128), 400, (1164, 199_805, [18, 71, 18], [2, 90, 67], [-1, -1, 1])),
    "aedat4_LZ4.aedat4": ({}, ("aedat4", 260, 346), 300, AEDAT4),
    "aedat4_NONE.aedat4": ({}, ("aedat4", 260, 346), 300, AEDAT4),
    "aedat4_ZSTD.aedat4": ({}, ("aedat4", 260, 346), 300, AEDAT4),
    "aedat4_frames16.aedat4": ({}, ("aedat4", 26, 34), 400, FRAMES),
    "aedat4_frames8.aedat4": ({}, ("aedat4", 26, 34), 400, FRAMES),
    "aedat4_full.aedat4": ({}, ("aedat4", 260, 346), 600, (CUT[0], 1_600_000_000_030_000, *CUT[2:])),
    "aedat4_cut.aedat4": ({}, ("aedat4", 260, 346), 360, CUT),
    "aedat4_stereo.aedat4": ({"part": "0"}, ("aedat4", 260, 346), 300, AEDAT4),
    "comment_first.txt": ({}, ("text", 480, 640), 400, SYNTHETIC),
    "dsec_blosc.h5": (
        VGA,
        ("dsec", 480, 640),
        400,
        (57_922_808_752, 57_923_007_393, [9, 35, 9], [1, 45, 33], [-1, -1, 1]),
    ),
    "e2vid_events.zip": ({}, ("text", 480, 640), 400, SYNTHETIC),
    "e2vid_monash.h5": ({}, ("monash", 480, 640), 400, SYNTHETIC),
    "evk4_evt21_legacy.raw": ({}, ("evt", 720, 1280), 400, SYNTHETIC),
    "evt3_lucid_0x9999.raw": ({}, ("evt", 720, 1280), 2, (1, 1, [3, 5], [5, 5], [-1, 1])),
    "first_time_1e-05.txt": ({}, ("text", 480, 640), 400, (10, 198_651, *SYNTHETIC[2:])),
    "jaer_davis346_x.aedat": ({}, ("aedat2", 260, 346), 2, (100, 200, [10, 10], [20, 20], [1, -1])),
    **{f"late_run_{n}.txt": ({}, ("text", 260, 346), 2000 - n, LATE) for n in (1, 3, 4, 10)},
    "long_72min.txt": ({}, ("text", 48, 64), 60, (1, 5_900_500_000, [1, 1, 2], [1, 3, 3], [1, 1, -1])),
    "metavision_file_to_csv.csv": (VGA, ("text", 480, 640), 400, SYNTHETIC),
    "metavision_geometry.csv": ({}, ("text", 480, 640), 400, SYNTHETIC),
    "metavision_vlen_geometry.hdf5": ({}, ("metavision", 480, 640), 400, SYNTHETIC),
    "live_one_wrong_time.txt": ({}, ("text", 480, 640), 399, SYNTHETIC),
    "live_glitch_20s.txt": ({}, ("text", 48, 64), 1999, GLITCH),
    "mono.bag": ({}, ("rosbag", 260, 346), 300, STEREO),
    "openeb_111_incomplete_vect.raw": ({}, ("evt", 720, 1280), 3, (1, 1_044_480, [0, 10, 1], [0, 0, 0], [-1, -1, -1])),
    "ros2_mono": ({}, ("rosbag", 260, 346), 300, STEREO),
    "ros2_mono/ros2_mono.mcap": ({}, ("rosbag", 260, 346), 300, STEREO),
    "ros2_event_packet": ({}, ("rosbag", 720, 1280), 0, ([], [], [])),
    "savetxt_us.txt": (VGA, ("text", 480, 640), 60, (1164, 32_901, *SYNTHETIC[2:])),
    "stale_first_3.txt": ({}, ("text", 48, 64), 400, (1164, 199_805, [9, 35, 9], [1, 45, 33], [-1, -1, 1])),
    "stereo.bag": ({"part": "/davis/left/events"}, ("rosbag", 260, 346), 300, STEREO),
    "v2e.h5": (VGA, ("e2p", 480, 640), 400, SYNTHETIC),
    "v2e_first_1e-05.txt": (VGA, ("text", 480, 640), 299, (10, 2990, [1, 2, 3], [1, 2, 3], [1, -1, 1])),
}
"""Arguments; format, height and width; events; times of the first and last event, and the first x, y and p."""
REPAIRED = {
    "aedat4_cut.aedat4": {"cut_tail": 1},
    "long_72min.txt": {"pauses": 59},
    "openeb_111_incomplete_vect.raw": {"pauses": 1},
    "live_glitch_20s.txt": {"time_glitches": 1},
    "live_one_wrong_time.txt": {"time_glitches": 1},
    **{f"late_run_{n}.txt": {"time_glitches": n} for n in (1, 3, 4, 10)},
    "stale_first_3.txt": {"stale": 3},
}
LIVE = {
    "comment_first.txt": (400, {}),
    "late_run_10.txt": (1990, {"time_glitches": 10}),
    "live_clock_reset.txt": (800, {"clock_resets": 1}),
    "live_glitch_20s.txt": (1999, {"time_glitches": 1}),
    "live_one_wrong_time.txt": (399, {"time_glitches": 1}),
    "stale_first_3.txt": (400, {"stale": 3}),
}
"""Events and repairs, read live."""
REFUSED = {
    "clock_reset.txt": "time goes back by 198641 us.*--stop 198642us.*--start 208641us",
    "live_clock_reset.txt": "time goes back by 1000198641 us",
    "aedat4_stereo.aedat4": "--part with one of 0, 1",
    "stereo.bag": "--part with one of /davis/left/events, /davis/right/events",
    "v2e_47_polarity.h5": "events of a polarity that is neither brighter nor darker",
}


def mended(repairs):
    """Repairs in words, such as "; time_glitches: 1"; empty if there were none."""
    return "".join(f"; {kind}: {count}" for kind, count in repairs.items())


@pytest.fixture
def cases(shared):
    for package in ("faery", "h5py", "hdf5plugin", "rosbags"):
        pytest.importorskip(package)
    return shared / "cases" / "recordings"


@pytest.mark.shared
@pytest.mark.parametrize("name", CASES)
def test_a_case_has_the_events_that_it_was_written_with(cases, read, name, record_property):
    arguments, stated, count, expected = CASES[name]
    form, (t, *columns), repairs = read(cases / name, **arguments)
    place = f" at {t[0]} to {t[-1]} us, first x={columns[0][0]}, y={columns[1][0]}" if len(t) else ""
    record_property("now", f"{len(t)} events{place}{mended(repairs)}")
    assert (form, len(t), repairs) == (stated, count, REPAIRED.get(name, {}))
    assert (*t[:1], *t[-1:], *(column[:3] for column in columns)) == expected


@pytest.mark.shared
@pytest.mark.parametrize("name", LIVE)
def test_a_case_goes_on_live(cases, name, record_property):
    with (cases / name).open("rb") as file:
        live = read_lines(file, name, ((90, 45), (135, 0)))
        events = sum(len(channel) for piece in live.pieces for channel in piece.channels)
    repairs = {kind: count for kind, count in live.repairs[0][1].items() if count}
    record_property("now", f"live {events} events{mended(repairs)}")
    assert (events, repairs) == LIVE[name]


@pytest.mark.shared
@pytest.mark.parametrize("name", REFUSED)
def test_a_case_that_cannot_be_read_as_it_is_says_why(cases, name, record_property):
    with pytest.raises(RecordingError, match=REFUSED[name]) as refused:
        read_recording(cases / name, **({} if name != "v2e_47_polarity.h5" else VGA))
    record_property("now", f"refused: {shorten(str(refused.value).partition(': ')[2], 110)}")
