import numpy as np
import pytest

from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError

DAT_HEADER = b"% Data file containing CD events.\n% Version 2\n% Height 720\n% Width 1280\n"
EVT_HEADER = {2: b"% evt 2.0\n% geometry 640x480\n", 3: b"% format EVT3;height=720;width=1280\n% end\n"}


@pytest.fixture
def read_words(tmp_path, read):
    """Columns and repairs of a file of these words."""

    def columns(version, words):
        path = tmp_path / "e.raw"
        path.write_bytes(EVT_HEADER[version] + np.array(words, {2: "<u4", 3: "<u2"}[version]).tobytes())
        (form, *_), *rows = read(path)
        assert form == "evt"
        return rows

    return columns


def test_evt2_and_evt3_words_worked_out_by_hand(read_words):
    """The time is 28 high bits and 6 low ones; 0 is OFF, 1 is ON."""
    words = [8 << 28 | 100, 1 << 28 | 5 << 22 | 639 << 11 | 7, 63 << 22 | 1 << 11 | 479, 8 << 28 | 101, 1 << 28]
    assert read_words(2, words) == [[[6405, 6463, 6464], [639, 1, 0], [7, 479, 0], [1, -1, 1]], {}]
    # The time is 12 high bits and 12 low ones; vectors of 12 and 8 pixels follow a base.
    first = [0x8001, 0x6002, 0x0007, 0x2000 | 5, 0x2800 | 6]
    vectors = [0x3800 | 100, 0x4000 | 0b1001, 0x5000 | 0b10]
    (t, *rows), repairs = read_words(3, [*first, *vectors, 0x6003, 0x0008, 0x2001])
    assert t == [4098] * 5 + [4099]
    assert rows == [[5, 6, 100, 103, 113, 1], [7, 7, 7, 7, 7, 8], [-1, 1, 1, 1, 1, -1]]
    assert repairs == {}


GEOMETRY = b"% evt 2.1\n% geometry 640x480\n"


@pytest.mark.parametrize(
    ("header", "legacy"),
    [
        (GEOMETRY, False),
        (b"% format EVT21;height=480;width=640\n", False),
        (b"% format EVT21;endianness=little;height=480;width=640\n% system_ID 49\n% end\n", False),
        (b"% camera_integrator_name Prophesee\n" + GEOMETRY + b"% system_ID 55\n% end\n", False),
        (b"% camera_integrator_name Other\n" + GEOMETRY + b"% system_ID 49\n% end\n", False),
        (b"% format EVT21;endianness=legacy;height=480;width=640\n% geometry 640x480\n% end\n", True),
        (GEOMETRY + b"% endianness legacy\n% end\n", True),
        (b"% integrator_name Prophesee\n" + GEOMETRY + b"% system_ID 49\n% end\n", True),
    ],
)
def test_evt21_has_32_pixels_in_a_word_whose_halves_older_cameras_exchange(tmp_path, read, header, legacy):
    def word(kind, low6_us, x, y, valid):
        return kind << 60 | low6_us << 54 | x << 43 | y << 32 | valid

    words = np.array(
        [word(1, 5, 32, 7, 1), 8 << 60 | 3 << 32, word(1, 5, 32, 7, 0b101), word(0, 63, 608, 479, 1 << 31)], "<u8"
    )
    halves = words.view("<u4").reshape(-1, 2)
    (tmp_path / "e.raw").write_bytes(header + (halves[:, ::-1] if legacy else halves).tobytes())
    form, columns, repairs = read(tmp_path / "e.raw")
    assert (form, repairs) == (("evt", 480, 640), {"orphans": 1})
    assert columns == [[3 * 64 + 5, 3 * 64 + 5, 3 * 64 + 63], [32, 34, 639], [7, 7, 479], [1, 1, -1]]


def test_evt_times_run_on_when_the_high_bits_are_full_and_orphans_are_counted(read_words):
    assert read_words(3, [0x8FFF, 0x6FFF, 0x0007, 0x2000, 0x8000, 0x2000])[0][0] == [2**24 - 1, 2**24]
    assert read_words(2, [8 << 28 | 2**28 - 1, 63 << 22, 8 << 28, 0])[0][0] == [2**34 - 1, 2**34]
    assert read_words(3, [0x2000, 0x8001, 0x2000, 0x0007, 0x2000])[1] == {"orphans": 2}
    assert read_words(2, [1 << 28, 8 << 28, 1 << 28])[1] == {"orphans": 1}


@pytest.mark.parametrize(
    ("line", "size"),
    [
        ("plugin_name hal_plugin_gen41_evk3", (720, 1280)),
        ("sensor_name Gen3.1", (480, 640)),
        ("sensor_name IMX646", (720, 1280)),
        ("sensor_generation 4.2", (720, 1280)),
        ("sensor_name GenX320", (320, 320)),
        ("system_ID 21", (480, 640)),
    ],
)
def test_the_sensors_name_generation_or_system_stands_for_its_size(tmp_path, read, line, size):
    words = np.array([0x8001, 0x0007, 0x2000], "<u2").tobytes()
    (tmp_path / "e.raw").write_bytes(b"% evt 3.0\n% " + line.encode() + b"\n% end\n" + words)
    assert read(tmp_path / "e.raw")[0] == ("evt", *size)
    (tmp_path / "e.raw").write_bytes(b"% evt 3.0\n" + words)
    with pytest.raises(RecordingError, match="give --height and --width"):
        read(tmp_path / "e.raw")


@pytest.mark.parametrize("wrong", [2**32 - 50_000_000, 2**31 + 9, 0])
def test_one_corrupt_stamp_moves_no_other_event(tmp_path, read, wrong):
    """Of DAT here; AEDAT-2 unwraps its stamps by the same function."""
    t = np.arange(100, 5000, 10) + (2**32 - 200 if wrong == 0 else 0)  # with 0, the stamps wrap after 20 events
    stamps = t % 2**32
    stamps[250] = wrong if wrong else 2**31 + 5
    rows = np.stack([stamps, np.full(len(t), 1 << 28)], axis=1).astype("<u4")
    (tmp_path / "e.dat").write_bytes(DAT_HEADER + b"\x0c\x08" + rows.tobytes())
    _, (found, *_), repairs = read(tmp_path / "e.dat")
    assert (found, repairs) == (np.delete(t, 250).tolist(), {"time_glitches": 1})


def test_late_stamps_around_a_wrap_and_a_long_pause_keep_their_times(tmp_path, read):
    around = [*range(2**32 - 140, 2**32 - 20, 10), 2**32 - 15, 2, 2**32 - 10, 5, *range(10, 200, 10)]
    rows = np.stack([around, np.full(len(around), 1 << 28)], axis=1).astype("<u4")
    (tmp_path / "e.dat").write_bytes(DAT_HEADER + b"\x0c\x08" + rows.tobytes())
    times = sorted(t if t > 2**31 else t + 2**32 for t in around)
    assert read(tmp_path / "e.dat")[1:] == ([times, *read(tmp_path / "e.dat")[1][1:]], {"unsorted": 1})
    paused = [*range(0, 200, 10), *range(2**31 + 2**30, 2**31 + 2**30 + 200, 10)]
    rows = np.stack([paused, np.full(len(paused), 1 << 28)], axis=1).astype("<u4")
    (tmp_path / "e.dat").write_bytes(DAT_HEADER + b"\x0c\x08" + rows.tobytes())
    assert read(tmp_path / "e.dat")[1][0] == paused


def test_dat_version_2_has_14_bits_for_each_coordinate_and_version_1_has_9_and_8(tmp_path, read):
    rows = [(5, 1279, 0, 1), (7, 0, 719, 0)]
    words = np.array([(t, x | y << 14 | p << 28) for t, x, y, p in rows], "<u4").tobytes()
    (tmp_path / "e.dat").write_bytes(DAT_HEADER + b"\x0c\x08" + words)
    assert read(tmp_path / "e.dat") == (("dat", 720, 1280), [[5, 7], [1279, 0], [0, 719], [1, -1]], {})
    words = np.array([(5, 303 | 239 << 9 | 1 << 17)], "<u4").tobytes()
    (tmp_path / "e.dat").write_bytes(b"% Version 1\n\x00\x08" + words)
    assert read(tmp_path / "e.dat", height=240, width=304)[1] == [[5], [303], [239], [1]]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("e.raw", b"% evt 4.0\n1234", r"states EVT 2, 2\.1 or 3, got 4"),
        ("e.dat", DAT_HEADER, "the file ends within its header"),
        ("e.dat", DAT_HEADER + b"\x0e\x08", "expected events of type 0 or 12 and 8 bytes, .* got type 14"),
        ("e.dat", b"% Version 7\n\x0c\x08", "expected DAT of version 1 or 2, got 7"),
    ],
)
def test_other_files_are_refused_with_the_reason(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=rf"{name}: .*{message}"):
        read_recording(tmp_path / name)
