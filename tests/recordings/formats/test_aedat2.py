import numpy as np
import pytest

from polarnet.recordings.formats.aedat import aedat2_frames
from polarnet.recordings.source import RecordingError

HEADER = b"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.Davis346blue\r\n#End Of ASCII Header\r\n"


def write(path, words, header=HEADER):
    path.write_bytes(header + np.array(words, ">u4").tobytes())
    return path


def address(x_from_right, y_from_below, p):
    return y_from_below << 22 | x_from_right << 12 | p << 11


def test_events_of_a_davis_have_y_from_the_top_and_other_samples_are_left_out(tmp_path, read):
    sample, imu = 1 << 31 | address(5, 5, 1), 1 << 10 | address(6, 6, 0)
    path = write(tmp_path / "e.aedat", [(address(0, 259, 1), 10), (sample, 11), (imu, 12), (address(345, 0, 0), 13)])
    assert read(path) == (("aedat2", 260, 346), [[10, 13], [345, 0], [0, 259], [1, -1]], {})
    path.write_bytes(path.read_bytes()[:-3])
    assert read(path)[1:] == ([[10], [345], [0], [1]], {"cut_tail": 1})


def test_events_and_frames_of_one_moving_edge_lie_on_each_other(tmp_path, read):
    """jAER stores the columns of events from the right, those of a frame's samples from the left."""
    edge = 100  # the columns left of it are bright in the frame; its last bright column has just fired ON
    y, x = np.mgrid[:260, :346]
    place = (1 << 31 | (259 - y) << 22 | x << 12).ravel()
    light = np.where(x < edge, 200, 20).ravel()
    events = [(address(345 - (edge - 1), row, 1), 5000 + row) for row in range(260)]
    signal = place | 1 << 10 | (900 - light)
    frame = [(word, t_us) for words, t_us in ((place | 900, 1000), (signal, 9000)) for word in words]
    path = write(tmp_path / "e.aedat", sorted([*frame, *events], key=lambda entry: entry[1]))
    (level,) = aedat2_frames(path).levels
    columns, rows = read(path)[1][1:3]
    assert sorted(rows) == [*range(260)]
    for row, column in zip(rows, columns, strict=True):
        assert level[row, column] == 200
        assert level[row, column + 1] == 20


def test_an_event_may_look_like_a_line_of_the_header_and_times_run_on_when_32_bits_are_full(tmp_path, read):
    first = address(3, 140, 1)
    assert first >> 24 == ord("#")
    assert read(write(tmp_path / "e.aedat", [(first, 5)]))[1][2] == [119]
    path = write(tmp_path / "e.aedat", [(address(1, 1, 1), t) for t in (2**32 - 5, 2**32 - 1, 3)])
    assert read(path)[1][0] == [2**32 - 5, 2**32 - 1, 2**32 + 3]


def test_a_camera_that_the_header_does_not_name_needs_its_size(tmp_path, read):
    path = write(tmp_path / "e.aedat", [(address(1, 1, 1), 5)], b"#!AER-DAT2.0\r\n")
    with pytest.raises(RecordingError, match="the file does not say how large the sensor is"):
        read(path)
    assert read(path, height=180, width=240)[1][2] == [178]


@pytest.mark.parametrize(
    ("header", "message"),
    [(b"#!AER-DAT2.0\r\n# AEChip: ch.unizh.ini.jaer.chip.retina.DVS128\r\n", "got one of a DVS128"),
     (b"#!AER-DAT2.0\r\n# no end", "expected AEDAT-2's header")],
)  # fmt: skip
def test_other_cameras_and_broken_headers_are_refused(tmp_path, read, header, message):
    with pytest.raises(RecordingError, match=rf"e\.aedat: .*{message}"):
        read(write(tmp_path / "e.aedat", [(address(1, 1, 1), 5)], header))
