"""The paper's rule for start times, what files a target needs, and lags between events and pictures."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from polarnet.captures.alignment import agreement, changes, logarithms, spread, steps, thresholds
from polarnet.captures.dot import (
    EVENT_CAPTURES,
    INTENSITY_CAPTURES,
    IntensityCapture,
    Target,
    event_start_us,
    find_captures,
    given_starts,
    intensity_start_us,
    landmark_starts,
    read_intensity_capture,
    reduced,
)
from polarnet.config.tree import load
from polarnet.recordings.source import RecordingError

HEIGHT, WIDTH = 80, 60


@pytest.fixture(scope="module")
def config(project_root):
    return replace(load(project_root).recordings, sensor=[HEIGHT, WIDTH], crop=[8, 12], size=[2, 3])


def pictures(region):
    t_us = 10_000 * np.arange(len(region))
    return IntensityCapture(t_us, np.zeros((len(region), 8, 12), np.uint16), np.array(region, float))


def test_the_papers_values_are_the_default(project_root):
    config = load(project_root).recordings
    assert (config.sensor, config.region, config.crop, config.size) == ([800, 1280], [45, 2], [480, 720], [120, 180])
    assert (config.dark_level, config.negative_events) == (30.0, 45)
    assert not config.enabled


def write_frames(folder, pictures):
    folder.mkdir()
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"frame_{k}.png"), picture)
    return folder


def test_frames_of_a_folder_are_an_intensity_capture_with_the_times_of_its_text(config, tmp_path):
    grey_pictures = np.random.default_rng(0).integers(0, 256, (12, HEIGHT, WIDTH), np.uint8)
    folder = write_frames(tmp_path / "intensity_0", grey_pictures)
    with pytest.raises(RecordingError, match=r"intensity_0: its pictures have no times .*timestamps\.txt"):
        read_intensity_capture(folder, config)
    times = [1000 + 700 * k * k for k in range(len(grey_pictures))]
    (folder / "timestamps.txt").write_text("".join(f"{t}\n" for t in times))
    capture = read_intensity_capture(folder, config)
    assert capture.t_us.tolist() == times  # of no regular clock
    (top, left), (height, width) = config.crop_corner, config.crop
    cropped = grey_pictures[:, top : top + height, left : left + width]
    assert np.array_equal(capture.pictures, 16 * cropped.astype(np.uint16))
    assert capture.region[0] == pytest.approx(grey_pictures[0, :45, -2:].mean())
    (folder / "timestamps.txt").write_text("0\n10\n")
    with pytest.raises(RecordingError, match=r"expected a time for each of 12 pictures, timestamps\.txt has 2"):
        read_intensity_capture(folder, config)
    folder = write_frames(tmp_path / "intensity_45", np.zeros((2, HEIGHT - 1, WIDTH), np.uint8))
    with pytest.raises(RecordingError, match=r"recordings\.sensor is \[80, 60\], its pictures are 79x60"):
        read_intensity_capture(folder, config)


def test_a_video_is_an_intensity_capture_with_its_own_times_or_those_beside_it(config, tmp_path):
    frames = np.linspace(60, 200, 12).astype(np.uint8)
    video = cv2.VideoWriter(str(tmp_path / "intensity_0.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 50.0, (WIDTH, HEIGHT))
    for level in frames:
        video.write(np.full((HEIGHT, WIDTH, 3), level, np.uint8))
    video.release()
    capture = read_intensity_capture(tmp_path / "intensity_0.mp4", config)
    assert np.diff(capture.t_us).tolist() == [20_000] * 11
    np.testing.assert_allclose(capture.pictures.mean(axis=(1, 2)) / 16, frames, atol=4)  # MPEG-4 is lossy
    (tmp_path / "intensity_0.txt").write_text("".join(f"{5000 * k}\n" for k in range(12)))
    assert read_intensity_capture(tmp_path / "intensity_0.mp4", config).t_us[-1] == 55_000


def test_captures_start_with_the_first_dark_picture_and_the_45th_negative_event(config, make_events):
    assert intensity_start_us("a", pictures([100.0, 30.0, 29.99, 100.0, 5.0]), config) == 20_000
    for region, message in (
        ([100.0, 31.0], r"a: no picture is darker than 30 .* darkest has mean 31\.0; set the start"),
        ([3.0, 4.0], r"a: the first picture is dark .* already \(mean 3\.0\)"),
    ):
        with pytest.raises(RecordingError, match=message):
            intensity_start_us("a", pictures(region), config)

    def start_us(x, y, p):
        return event_start_us("a", make_events([(10 * k, x, y, p) for k in range(100)], HEIGHT, WIDTH), config)

    assert start_us(WIDTH - 2, 44, -1) == 440
    for elsewhere in ((WIDTH - 3, 44, -1), (WIDTH - 2, 45, -1), (WIDTH - 2, 44, 1)):
        with pytest.raises(RecordingError, match="expected 45 negative events in the landmark's region, got 0"):
            start_us(*elsewhere)


def test_starts_given_by_hand_take_the_place_of_the_rule(config, make_events):
    events, intensities = {"events_0": make_events([], HEIGHT, WIDTH)}, {"intensity_0": pictures([100.0, 1.0])}
    starts = landmark_starts(Target("a", events, {}, intensities, {"events_0": 123}), config)
    assert starts == {"events_0": 123, "intensity_0": 10_000}


def test_a_picture_is_reduced_by_averaging(config):
    picture = np.zeros((8, 12), np.uint16)
    picture[4:, :4] = 1600  # of 4095
    assert reduced(picture, config).tolist() == [[0, 0, 0], [100, 0, 0]]


def test_a_target_needs_one_file_for_each_of_its_eight_captures(tmp_path):
    for name in (*EVENT_CAPTURES, *INTENSITY_CAPTURES):
        (tmp_path / f"{name}.bin").touch()
    (tmp_path / "intensity_0.txt").touch()  # times of a video
    assert find_captures(tmp_path).keys() == {*EVENT_CAPTURES, *INTENSITY_CAPTURES}
    (tmp_path / "events_45.csv").touch()
    with pytest.raises(RecordingError, match=r"expected one file events_45\.bin .* got events_45\.bin, events_45\.csv"):
        find_captures(tmp_path)
    (tmp_path / "events_45.csv").unlink()
    (tmp_path / "intensity_135.bin").unlink()
    with pytest.raises(RecordingError, match=r"expected one file intensity_135\.bin .* got none"):
        find_captures(tmp_path)


@pytest.mark.parametrize("text", ['{"events_1": 5}', '{"events_45": 5.5}', "[1]", "{", '{"events_45": true}'])
def test_starts_by_hand_that_make_no_sense_are_refused(tmp_path, text):
    assert given_starts(tmp_path) == {}
    (tmp_path / "starts.json").write_text(text)
    with pytest.raises(RecordingError, match=r"starts\.json"):
        given_starts(tmp_path)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"crop": [90, 12]}, "crop: expected at most the sensor's"), ({"size": [2]}, r"size: expected \[height, width\]")],
)
def test_sizes_that_do_not_fit_into_each_other_are_refused(config, wrong, message):
    with pytest.raises(ValueError, match=message):
        replace(config, **wrong)


def test_each_step_lies_between_two_events_of_one_pixel(make_events):
    rows = [(1, 0, 0, 1), (2, 1, 0, -1), (5, 0, 0, 1), (9, 1, 0, 1), (9, 0, 0, -1)]
    pairs = steps(make_events(rows, 1, 2), (0, 0), (1, 2), 0, 9)
    assert pairs.start_us.tolist() == [1]  # those that end at 9 us are not before the stop
    assert (pairs.stop_us.tolist(), pairs.pixel.tolist(), pairs.polarity.tolist()) == ([5], [0], [1])


def test_without_change_there_is_no_agreement_and_dark_pixels_do_not_count(make_random_events):
    pairs = steps(make_random_events(1, 500, 10**6, 4, 5), (0, 0), (4, 5), 0, 10**6)
    t_us, light = np.arange(0, 1_000_000, 16_667), np.full((60, 4, 5), 2000, np.uint16)
    change = changes(pairs, 0, t_us, logarithms(light))
    assert agreement(pairs.polarity, change) == spread(pairs.polarity, change) == 0
    assert np.isnan(thresholds(pairs.polarity[:0], change[:0]).on)
    assert np.isnan(changes(pairs, 0, t_us, logarithms(np.full_like(light, 63)))).all()
    assert np.isnan(changes(pairs, 2_000_000, t_us, logarithms(light))).all()
