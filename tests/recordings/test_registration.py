"""Cameras laid on each other by their event images."""

import json

import cv2
import numpy as np
import pytest
import torch

from polarnet.cli import main
from polarnet.events.stream import Events
from polarnet.recordings.registration import event_image, register, warp_events, warped
from polarnet.recordings.source import RecordingError
from polarnet.reports.recordings import draw_hot_pixels, draw_registration

HEIGHT, WIDTH = 120, 160
TRUE = np.array([[1.01, 0.015, 3.2], [-0.012, 0.99, -2.4], [2e-5, -3e-5, 1.0]])


@pytest.fixture(scope="module")
def images():
    """Edges of rectangles as one camera sees them, and as another whose pixels TRUE takes to the first's."""
    generator = np.random.default_rng(5)
    reference = np.zeros((HEIGHT, WIDTH), np.float32)
    for _ in range(40):
        x, y = generator.integers(0, [WIDTH, HEIGHT])
        w, h = generator.integers(8, 40, 2)
        cv2.rectangle(reference, (int(x), int(y)), (int(x + w), int(y + h)), float(generator.uniform(0.3, 1)), 1)
    reference = cv2.GaussianBlur(reference, (0, 0), 1)
    return reference, cv2.warpPerspective(reference, np.linalg.inv(TRUE), (WIDTH, HEIGHT))


def corners_apart(homography):
    corners = np.array([[[10, 10], [WIDTH - 10, 10], [10, HEIGHT - 10], [WIDTH - 10, HEIGHT - 10]]], np.float64)
    return np.abs(cv2.perspectiveTransform(corners, homography) - cv2.perspectiveTransform(corners, TRUE)).max()


def test_the_homography_between_two_cameras_is_found_to_a_fraction_of_a_pixel(images, tmp_path):
    reference, moving = images
    registration = register(reference, 0.6 * moving)  # another polarizer: not as bright
    assert corners_apart(np.eye(3)) > 2
    assert corners_apart(registration.homography) < 0.2
    assert registration.correlation > 0.95
    after = warped(moving, registration.homography)
    draw_registration(reference, moving, after, tmp_path / "registration.png")
    draw_hot_pixels(np.ones((5, 5)), np.eye(5, dtype=bool), tmp_path / "hot.png")
    assert all((tmp_path / name).stat().st_size > 5000 for name in ("registration.png", "hot.png"))


def test_register_prints_the_homography_of_two_recordings_and_draws_both(images, tmp_path, capsys):
    for name, image in zip(("a.txt", "b.txt"), images, strict=True):
        write_recording(tmp_path / name, image)
    command = ["register", str(tmp_path / "a.txt"), str(tmp_path / "b.txt"), "--picture", str(tmp_path / "both.png")]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert corners_apart(np.array(json.loads(printed)["homography"])) < 0.5
    assert (tmp_path / "both.png").stat().st_size > 5000
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_text((tmp_path / name).read_text().split("\n", 1)[1])
    assert main(command) == 1
    assert "height" in capsys.readouterr().err
    assert main([*command, "--height", str(HEIGHT), "--width", str(WIDTH)]) == 0
    assert capsys.readouterr().out == printed


def write_recording(path, image):
    y, x = (np.repeat(axis.ravel(), np.rint(60 * image).astype(int).ravel()) for axis in np.indices(image.shape))
    lines = "".join(f"{t} {column} {row} 1\n" for t, (row, column) in enumerate(zip(y, x, strict=True)))
    path.write_text(f"{WIDTH} {HEIGHT}\n{lines}")


def test_recordings_of_other_scenes_are_named(images, tmp_path, capsys):
    reference, moving = images
    generator = np.random.default_rng(6)
    other = np.zeros((HEIGHT, WIDTH), np.float32)
    for _ in range(60):
        x, y = generator.integers(0, [WIDTH, HEIGHT])
        cv2.circle(other, (int(x), int(y)), int(generator.integers(4, 20)), float(generator.uniform(0.3, 1)), 1)
    assert register(reference, moving).edge_correlation > 0.9
    for name, image in (("a", reference), ("b", moving), ("c", cv2.GaussianBlur(other, (0, 0), 1))):
        write_recording(tmp_path / f"{name}.txt", image)
    assert main(["register", str(tmp_path / "a.txt"), str(tmp_path / "b.txt")]) == 0
    assert capsys.readouterr().err == ""
    assert main(["register", str(tmp_path / "a.txt"), str(tmp_path / "c.txt")]) == 0
    assert "the edges of the two recordings do not match" in capsys.readouterr().err


def test_events_are_moved_to_the_reference_camera_and_those_it_does_not_see_left_out():
    x, y = (torch.tensor(values, dtype=torch.int16) for values in ([0, 5, 159], [0, 6, 119]))
    events = Events(torch.arange(3), x, y, torch.tensor([1, -1, 1], dtype=torch.int8), HEIGHT, WIDTH)
    shift = np.array([[1.0, 0, 3], [0, 1, -2], [0, 0, 1]])
    moved = warp_events(events, shift)
    assert (moved.t.tolist(), moved.x.tolist(), moved.y.tolist(), moved.p.tolist()) == ([1], [8], [4], [-1])


def test_event_images_hold_all_pixels_between_0_and_1():
    x = torch.tensor([2, 2, 3], dtype=torch.int16)
    image = event_image(Events(torch.arange(3), x, x, torch.ones(3, dtype=torch.int8), 5, 6))
    assert image[2, 2] == 1
    assert image[3, 3] == pytest.approx(np.log(2) / np.log(3))
    assert np.count_nonzero(image) == 2
    assert not event_image(Events.empty(5, 6)).any()


def test_images_that_have_nothing_in_common_are_refused(images):
    with pytest.raises(RecordingError, match="too little in common"):
        register(images[0], np.zeros_like(images[0]))
    with pytest.raises(RecordingError, match="of one size"):
        register(images[0], images[0][:-1])
