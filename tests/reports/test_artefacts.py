import numpy as np
import pytest
import torch
from matplotlib.colors import rgb_to_hsv

from polarnet.reports.artefacts import event_budget, read_artefacts, training_history
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore


@pytest.fixture(scope="module")
def artefacts(paths):
    return read_artefacts(paths, ["e2v"])


def test_a_panel_holds_the_truth_of_the_window_it_names(artefacts, paths):
    panel = artefacts.results.panels[0]
    frames = FrameStore.open(paths.frames).frames(panel.sequence)
    assert int(frames.t_us[panel.window + 1]) == panel.t_us
    assert torch.equal(frames.dolp[panel.window + 1], panel.truth.dolp)
    assert set(panel.predictions) == {"zeros", "oracle_mean", "e2v", "ours"}
    assert [row for row, one in panel.predictions.items() if one.aolp is not None] == ["e2v"]


def test_photographs_come_before_dead_leaves(artefacts):
    assert [panel.sequence for panel in artefacts.results.panels] == ["tree-00", "leaf-00"]
    assert artefacts.overview.name == "tree-00"


def test_the_overview_shows_the_events_of_the_panels_window(artefacts, paths):
    overview, panel = artefacts.overview, artefacts.results.panels[0]
    assert overview.start_us + overview.duration_us == panel.t_us
    assert overview.duration_us == pytest.approx(1e6 / 30, abs=1)
    for stream in overview.streams:
        assert len(stream) > 0
        assert int(stream.t.min()) >= overview.start_us
        assert int(stream.t.max()) < panel.t_us


def test_the_outlined_part_of_the_picture_is_what_the_window_shows(artefacts):
    overview = artefacts.overview
    height, width = overview.picture.shape[:2]
    left, top = overview.outline.min(axis=1) * (width, height)
    right, bottom = overview.outline.max(axis=1) * (width, height)
    assert (right - left, bottom - top) == pytest.approx((36, 24))
    assert overview.path.min() >= 0
    assert overview.path.max() <= 1
    hue = overview.aolp[12, 18] / torch.pi  # grows to the right in these pictures
    middle = overview.picture[round(top) + 12, round(left) + 18]
    assert rgb_to_hsv(middle / 255)[0] == pytest.approx(float(hue), abs=0.05)


def test_a_thumbnail_of_a_scene_looks_like_its_picture(artefacts, source_picture):
    ((name, small),) = artefacts.thumbnails["train"].items()
    assert name == "park"
    expected = np.rint(255 * source_picture(0.0)).mean(axis=(0, 1))
    assert small.mean(axis=(0, 1)) == pytest.approx(expected, abs=2)


def test_the_best_epoch_is_the_one_with_the_lowest_validation_mse(paths):
    history = training_history(paths.train / "ours")
    assert history.best_epoch == 1
    assert list(history.loss) == ["total", "mse"]
    assert history.validation["psnr"] == [10.0, 11.0, 12.0]


def test_errors_are_averaged_over_frames_with_a_similar_number_of_events(paths, tmp_path):
    frames = "method,sequence,t_us,mse\nours,tree-00,20000,0.4\nours,tree-00,21000,0.2\nours,tree-00,200000,0.1\n"
    (tmp_path / "frames.csv").write_text(frames)
    early, late = event_budget(tmp_path / "frames.csv", EventStore.open(paths.events))
    assert (early.method, early.mse, early.frames) == ("ours", pytest.approx(0.3), 2)
    assert early.events_per_pixel == pytest.approx(500 / (24 * 36) * 0.1025, rel=0.3)
    assert (late.mse, late.events_per_pixel) == (0.1, pytest.approx(500 / (24 * 36)))
