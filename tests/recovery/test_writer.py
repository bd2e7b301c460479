import shutil

import cv2
import numpy as np
import pytest
import torch
import zarr
from event_fixtures import events_of

from polarnet.events.streaming import EventWindow
from polarnet.recovery import writer as recovery
from polarnet.recovery.writer import RecoveryWriter
from polarnet.stokes import Prediction
from polarnet.storage.frames import FRAMES_PER_CHUNK

HEIGHT, WIDTH = 15, 21
FRAMES = 40
assert FRAMES > FRAMES_PER_CHUNK


def window(k):
    return EventWindow([events_of([(1000 * k, k, 3, 1)], HEIGHT, WIDTH)] * 4, 1000 * k, 1000 * (k + 1))


def frame(k, *, angle=True):
    dolp = torch.full((HEIGHT, WIDTH), k / FRAMES)
    return Prediction(dolp, torch.full_like(dolp, 0.05 * k) if angle else None, -dolp)


@pytest.fixture(params=[2, 4], ids=["two cores", "four cores"])
def cores(request, monkeypatch):
    monkeypatch.setattr(recovery, "usable_cores", lambda: request.param)
    return request.param


@pytest.fixture
def written(tmp_path, cores):
    with RecoveryWriter(tmp_path, ("zarr", "mp4")) as writer:
        for k in range(FRAMES):
            writer.add(window(k), frame(k), live=True)
    writer.write_page("a & b", {"windows": "of 1 ms"}, ["one note"])
    return tmp_path


def test_the_numbers_the_video_and_a_page_that_escapes_names_are_written(written):
    group = zarr.open_group(written / "recovered.zarr", mode="r")
    assert group["t_us"][:].tolist() == [1000 * (k + 1) for k in range(FRAMES)]
    np.testing.assert_allclose(group["dolp"][:, 0, 0] / 65535, np.arange(FRAMES) / FRAMES, atol=1e-5)
    np.testing.assert_allclose(group["aolp"][:, 3, 4] * np.pi / 65536, 0.05 * np.arange(FRAMES), atol=1e-4)
    np.testing.assert_allclose(group["log_variance"][:, 3, 4], -np.arange(FRAMES) / FRAMES, rtol=1e-6)
    assert set(group.attrs["conventions"]) == {"t_us", "dolp", "aolp", "log_variance"}
    video, count = cv2.VideoCapture(str(written / "recovered.mp4")), 0
    while video.read()[0]:
        count += 1
    assert count == FRAMES
    assert video.get(cv2.CAP_PROP_FRAME_WIDTH) == 536  # 2 enlarged panels of 252, a gap of 8, margins of 12
    page = (written / "index.html").read_text()
    assert "a &amp; b" in page
    assert "one note" in page
    assert page.count("data:image/webp") == 3  # strips of events, DoLP and AoLP
    assert 'src="http' not in page
    assert '<video src="recovered.mp4" controls' in page
    assert (written / "recovered.png").exists()


def test_without_an_angle_two_maps_are_shown_and_nothing_else_is_written(tmp_path):
    with RecoveryWriter(tmp_path, ("zarr",)) as writer:
        for k in range(3):
            writer.add(window(k), frame(k, angle=False))
    writer.write_page("x", {}, [])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["index.html", "recovered.png", "recovered.zarr"]
    assert "aolp" not in zarr.open_group(tmp_path / "recovered.zarr", mode="r")


def test_a_full_disk_stops_at_a_whole_frame_and_says_so(tmp_path, cores, monkeypatch):
    free = iter([2**30] * 3 + [2**20] * FRAMES)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(recovery.shutil, "disk_usage", lambda _: usage._replace(free=next(free)))

    def write() -> None:
        with RecoveryWriter(tmp_path, ("zarr",)) as writer:
            for k in range(FRAMES):
                writer.add(window(k), frame(k), live=True)

    with pytest.raises(OSError, match=r"the disk is full; all 3 frames"):
        write()
    assert zarr.open_group(tmp_path / "recovered.zarr", mode="r")["t_us"].shape == (3,)
