import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
import torch
import zarr

from polarnet.events.stream import Events
from polarnet.events.streaming import EventWindow
from polarnet.networks.blocks import Prediction
from polarnet.reports.recovery import RecoveryWriter, signed_events

HEIGHT, WIDTH = 15, 21


def window(k):
    one = Events(torch.tensor([1000 * k]), torch.tensor([k]).short(), torch.tensor([3]).short(),
                 torch.tensor([1]).to(torch.int8), HEIGHT, WIDTH)  # fmt: skip
    return EventWindow([one] * 4, 1000 * k, 1000 * (k + 1), [k] * 4)


def frame(k, *, angle=True):
    dolp = torch.full((HEIGHT, WIDTH), k / 20)
    return Prediction(dolp, torch.full_like(dolp, 0.1 * k) if angle else None, -dolp)


@pytest.fixture
def written(tmp_path):
    with RecoveryWriter(tmp_path, ("zarr", "png", "exr", "mp4"), 30.0) as writer:
        for k in range(20):
            writer.add(window(k), frame(k))
    writer.write_page("a & b", {"windows": "of 1 ms"}, ["one note"])
    return tmp_path


def test_the_numbers_are_in_a_zarr_group_of_its_own(written):
    group = zarr.open_group(written / "recovered.zarr", mode="r")
    assert group["t_us"][:].tolist() == [1000 * (k + 1) for k in range(20)]
    np.testing.assert_allclose(group["dolp"][:, 0, 0] / 65535, np.arange(20) / 20, atol=1e-5)
    np.testing.assert_allclose(group["aolp"][:, 3, 4] * np.pi / 65536, 0.1 * np.arange(20), atol=1e-4)
    np.testing.assert_allclose(group["log_variance"][:, 3, 4], -np.arange(20) / 20)
    assert set(group.attrs["conventions"]) == {"t_us", "dolp", "aolp", "log_variance"}


def test_exr_holds_the_floats_and_names_them(written):
    file = oiio.ImageInput.open(str(written / "exr" / "000007.exr"))
    assert set(file.spec().channelnames) == {"DoLP", "AoLP", "log_variance"}
    pixels = dict(zip(file.spec().channelnames, file.read_image()[2, 5], strict=True))
    assert pixels == pytest.approx({"DoLP": 0.35, "AoLP": 0.7, "log_variance": -0.35}, abs=1e-3)


def test_pictures_and_video_show_three_maps_side_by_side(written):
    picture = cv2.imread(str(written / "png" / "000019.png"))
    assert picture.shape == (16, 72, 3)  # 3 * 21 + 2 * 4, brought to even sides
    assert len(list((written / "png").iterdir())) == 20
    video, count = cv2.VideoCapture(str(written / "recovered.mp4")), 0
    while video.read()[0]:
        count += 1
    assert count == 20
    assert video.get(cv2.CAP_PROP_FRAME_WIDTH) == 72


def test_the_page_needs_no_network_and_escapes_names(written):
    page = (written / "index.html").read_text()
    assert "a &amp; b" in page
    assert "one note" in page
    assert page.count("data:image/png") >= 6
    assert 'src="http' not in page
    assert '<a href="recovered.mp4">' in page
    assert "steps(20,jump-none)" in page
    assert (written / "recovered.png").exists()


def test_without_an_angle_two_maps_are_shown_and_nothing_else_is_written(tmp_path):
    with RecoveryWriter(tmp_path, ("zarr",), 30.0) as writer:
        for k in range(3):
            writer.add(window(k), frame(k, angle=False))
    writer.write_page("x", {}, [])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["index.html", "recovered.png", "recovered.zarr"]
    assert "aolp" not in zarr.open_group(tmp_path / "recovered.zarr", mode="r")


def test_a_failure_while_writing_reaches_whoever_recovers(tmp_path):
    writer = RecoveryWriter(tmp_path, ("png",), 30.0)
    (tmp_path / "png").rmdir()
    writer.add(window(0), frame(0))
    with pytest.raises(OSError, match=r"000000\.png"):
        writer.__exit__()


def test_events_of_all_polarizers_add_up():
    assert signed_events(window(2))[3, 2] == 4
    assert signed_events(window(2)).sum() == 4
