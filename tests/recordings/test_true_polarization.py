"""True polarization from files in published layouts, written with known polarization."""

import math

import numpy as np
import pytest
import torch

from polarnet.recordings.formats.aedat import aedat2_frames
from polarnet.recordings.source import RecordingError
from polarnet.recordings.truth import read_truth
from polarnet.stokes import aolp, dolp, parse_mosaic, stokes_from_intensities

pytest.importorskip("h5py")

from studies.recording_files import NO_FRAMES, NO_TIMES, mosaicked, write_aedat2, write_e2p

MOSAIC = parse_mosaic("90 45 / 135 0")
T_US = np.array([1000, 34_000, 67_000])
SLOPES = {0: (60, 2, 1), 45: (90, 1, 2), 90: (100, 1, 0), 135: (70, 2, -1)}
"""Level at the sensor's pixel (0, 0), and its change per column and per row, of the light behind each polarizer."""


def planes(height, width, offset):
    """Light behind each polarizer at pixels shifted by `offset`: linear, so that bilinear weights are exact."""
    y, x = np.mgrid[:height, :width] + offset
    return np.stack([level + across * x + down * y for level, across, down in SLOPES.values()])


def known(height, width):
    """Raw mosaic of integer levels, and DoLP and AoLP at the centres of its cells."""
    at_pixels = planes(height, width, 0)
    raw = np.zeros((height, width), np.uint8)
    for row in (0, 1):
        for column in (0, 1):
            plane = at_pixels[MOSAIC[row][column] // 45]
            raw[row::2, column::2] = plane[row::2, column::2]
    stokes = stokes_from_intensities(planes(height, width, 0.5)[:, ::2, ::2])
    return raw, dolp(stokes), aolp(stokes)


def test_demosaicked_frames_of_e2p_give_the_known_polarization_but_for_saturated_cells(tmp_path, make_events):
    raw, true_dolp, true_aolp = known(20, 24)
    write_e2p(tmp_path / "e.h5", make_events([(0, 0, 0, 1)], 20, 24), T_US, np.stack([raw] * 3), None)
    truth = read_truth(tmp_path / "e.h5", MOSAIC)
    assert truth.t_us.tolist() == T_US.tolist()
    assert truth.valid[:, 1:-1, 1:-1].all()
    assert truth.valid.sum() == 3 * 8 * 10  # the rim of one cell is unknown
    inside = np.s_[:, 1:-1, 1:-1]
    assert (truth.dolp[inside] - true_dolp[None][inside]).abs().max() < 1e-7
    assert (truth.aolp[inside] - true_aolp[None][inside]).abs().max() < 1e-6
    assert true_dolp.min() > 0.05
    raw, _, _ = known(20, 24)
    raw[8, 8] = raw[9, 8] = 255
    maps = tuple(np.zeros((3, 10, 12)) for _ in range(3))
    write_e2p(tmp_path / "e.h5", make_events([(0, 0, 0, 1)], 20, 24), T_US, np.stack([raw] * 3), maps)
    valid = read_truth(tmp_path / "e.h5", MOSAIC).valid
    assert not valid[:, 4, 4].any()
    assert valid.sum() == 3 * (10 * 12 - 1)


def test_maps_of_e2p_are_the_truth_where_the_file_has_them(tmp_path, make_events):
    true_dolp = np.arange(0, 255, 5)[:30].reshape(1, 5, 6) / 255 * np.ones((3, 1, 1))
    true_aolp = np.remainder(np.pi * (np.arange(90).reshape(3, 5, 6) / 255 - 0.5), np.pi)
    s0 = np.full((3, 5, 6), 200 / 255)
    write_e2p(tmp_path / "e.h5", make_events([(0, 0, 0, 1)], 10, 12), T_US, None, (s0, true_dolp, true_aolp))
    truth = read_truth(tmp_path / "e.h5", MOSAIC)
    assert (truth.dolp - torch.from_numpy(true_dolp)).abs().max() < 1e-7
    assert torch.sin(truth.aolp - torch.from_numpy(true_aolp)).abs().max() < 1e-6
    assert ((truth.aolp >= 0) & (truth.aolp < math.pi) & truth.valid).all()
    stokes = stokes_from_intensities(truth.intensity)
    assert (dolp(stokes) - truth.dolp).abs().max() < 1e-6
    np.testing.assert_allclose(truth.light, mosaicked(2 * truth.intensity.numpy()))


def test_frames_of_a_davis_are_differences_of_two_samples_and_need_all_of_them(tmp_path, make_events):
    raw, true_dolp, _ = known(260, 346)  # levels beyond 255 wrap, which changes nothing here
    path, events = tmp_path / "e.aedat", make_events([(5000, 3, 4, 1)], 260, 346)
    write_aedat2(path, events, np.array([5000, 35_000]), np.stack([raw, raw // 2]))
    frames = aedat2_frames(path)
    assert frames.t_us.tolist() == [5000, 35_000]
    assert np.array_equal(frames.levels, [raw, raw // 2])
    truth = read_truth(path, MOSAIC)
    near = np.s_[1:20, 1:20]  # where no level wraps
    assert (truth.dolp[0][near] - true_dolp[near]).abs().max() < 1e-6
    path.write_bytes(path.read_bytes()[:-8])
    assert aedat2_frames(path).t_us.tolist() == [5000]
    write_aedat2(path, events, NO_TIMES, NO_FRAMES)
    with pytest.raises(RecordingError, match="expected frames of the DAVIS as true polarization, got no whole one"):
        aedat2_frames(path)


def test_frames_of_aedat4_have_the_middle_of_their_exposure_and_the_known_polarization(tmp_path, make_events):
    pytest.importorskip("dv_processing", reason="the extra live is not installed")
    from studies.pdavis import write_aedat4

    raw, true_dolp, true_aolp = known(20, 24)
    t_us = np.array([5000, 38_000, 68_000])
    write_aedat4(tmp_path / "e.aedat4", make_events([(5000, 3, 4, 1)], 20, 24), t_us, np.stack([raw] * 3))
    truth = read_truth(tmp_path / "e.aedat4", MOSAIC)
    assert truth.t_us.tolist() == t_us.tolist()
    inside = np.s_[:, 1:-1, 1:-1]
    assert (truth.dolp[inside] - true_dolp[None][inside]).abs().max() < 1e-7
    assert torch.sin(truth.aolp[inside] - true_aolp[None][inside]).abs().max() < 1e-6
    faery = pytest.importorskip("faery")
    faery.events_stream_from_file(tmp_path / "e.aedat4").to_file(tmp_path / "events.aedat4")
    with pytest.raises(RecordingError, match="expected raw frames of one size and one channel"):
        read_truth(tmp_path / "events.aedat4", MOSAIC)


def test_files_without_frames_say_what_they_lack(tmp_path, make_events):
    write_e2p(tmp_path / "e.h5", make_events([(0, 0, 0, 1)], 20, 24), T_US, None, None)
    with pytest.raises(RecordingError, match="expected /frame_ts, and /frame or /intensity, /dolp, /aolp"):
        read_truth(tmp_path / "e.h5", MOSAIC)
    (tmp_path / "e.txt").write_text("4 4\n1 2 3 1\n")
    with pytest.raises(RecordingError, match="expected a format with frames, e2p, aedat4, aedat2; got text"):
        read_truth(tmp_path / "e.txt", MOSAIC)
