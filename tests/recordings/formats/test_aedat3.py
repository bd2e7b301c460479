import struct

import numpy as np
import pytest

from polarnet.recordings.source import RecordingError

HEADER = b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DAVIS346\r\n#Source 7: DVS128\r\n#!END-HEADER\r\n"


def packet(events, kind=1, source=1, overflows=0):
    """A packet of events t, x, y, p, valid."""
    words = [(valid | p << 1 | y << 2 | x << 17, t) for t, x, y, p, valid in events]
    header = struct.pack("<2h6i", kind, source, 8, 4, overflows, len(words), len(words), len(words))
    return header + np.array(words, "<u4").tobytes()


def write(path, *packets, header=HEADER):
    path.write_bytes(header + b"".join(packets))
    return path


def test_pixel_events_of_a_source_have_the_higher_bits_of_their_time_in_the_packet(tmp_path, read):
    first = packet([(5, 345, 0, 1, 1), (6, 9, 9, 1, 0), (9, 0, 259, 0, 1)])
    others = packet([(7, 127, 0, 1, 1)], source=7) + packet([(8, 1, 1, 1, 1)], kind=2)
    path = write(tmp_path / "e.aedat", first, others, packet([(5, 3, 4, 1, 1)], overflows=1))
    with pytest.raises(RecordingError, match=r"e\.aedat: say which source of events to read, --part with one of 1, 7"):
        read(path)
    times = [5, 9, 2**31 + 5]
    assert read(path, part="1") == (("aedat3", 260, 346), [times, [345, 0, 3], [0, 259, 4], [1, -1, 1]], {"pauses": 1})
    assert read(path, part="7")[:2] == (("aedat3", 128, 128), [[7], [127], [0], [1]])
    path.write_bytes(path.read_bytes()[:-3])
    assert read(path, part="1")[1:] == ([[5, 9], [345, 0], [0, 259], [1, -1]], {"cut_tail": 1})


@pytest.mark.parametrize(
    ("header", "content", "message"),
    [
        (HEADER.replace(b"RAW", b"SerializedTS"), b"", "expected AEDAT 3.1 of format RAW, got SerializedTS"),
        (HEADER[:-20], b"", "expected AEDAT 3.1's header of # lines up to #!END-HEADER"),
        (HEADER.replace(b"#Source 7: DVS128\r\n", b""), b"\1\0\1\0" + b"\7" * 24, "the packet before byte .* damaged"),
    ],
)
def test_other_files_are_refused_with_the_reason(tmp_path, read, header, content, message):
    with pytest.raises(RecordingError, match=rf"e\.aedat: .*{message}"):
        read(write(tmp_path / "e.aedat", content, header=header))
