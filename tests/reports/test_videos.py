"""Videos that browsers play, whole or after a kill."""

import signal
from multiprocessing import Pipe, get_context

import av
import numpy as np
import pytest

from polarnet.reports.preview import VideoWriter


def grey(level, height=64, width=96):
    return np.full((height, width, 3), level, np.uint8)


def levels(path):
    with av.open(str(path)) as file:
        return [frame.to_ndarray(format="rgb24").mean() for frame in file.decode(video=0)]


def test_pictures_come_back_at_their_rate_with_even_sides_and_have_one_size(tmp_path):
    with VideoWriter(tmp_path / "a.mp4", 25.0) as video:
        for level in range(0, 250, 10):
            video.add(grey(level, 63, 95))
    np.testing.assert_allclose(levels(tmp_path / "a.mp4"), range(0, 250, 10), atol=2)
    with av.open(str(tmp_path / "a.mp4")) as file:
        stream = file.streams.video[0]
        assert (stream.codec.canonical_name, stream.pix_fmt) == ("h264", "yuv420p")
        assert (stream.height, stream.width, float(stream.average_rate), stream.frames) == (64, 96, 25.0, 25)
        assert file.duration == pytest.approx(1e6)  # a finished file states its duration
    with VideoWriter(tmp_path / "a.mp4", 25.0) as video:
        video.add(grey(1))
        with pytest.raises(ValueError, match="expected pictures of 64 x 96 px, got 32 x 96"):
            video.add(grey(1, 32))
    with VideoWriter(tmp_path / "none.mp4", 25.0):
        pass
    assert not (tmp_path / "none.mp4").exists()


def test_after_a_kill_the_complete_fragments_play(tmp_path):
    written, sender = Pipe(duplex=False)
    process = get_context("fork").Process(target=write_and_wait, args=(tmp_path / "a.mp4", sender))
    process.start()
    assert written.poll(60), "the process writes nothing"
    process.kill()
    process.join()
    played = levels(tmp_path / "a.mp4")
    assert 40 <= len(played) < 100  # the encoder and the last fragment, of 2 s, are lost
    np.testing.assert_allclose(played, range(len(played)), atol=2)


def write_and_wait(path, sender):
    video = VideoWriter(path, 10.0)
    for level in range(100):
        video.add(grey(level))
    sender.send(True)
    signal.pause()
