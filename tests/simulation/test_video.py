"""Simulation in pieces, of moving sensors and of videos, and interpolated frames."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from event_fixtures import equal
from simulation_fixtures import picture

from polarnet.clips import simulate_video
from polarnet.clips import video as video_module
from polarnet.clips.video import moving_pieces, video_pieces
from polarnet.events.stream import concatenate
from polarnet.runtime.machine import seed_for
from polarnet.simulation import (
    MOTIONS,
    POLARIZERS,
    SENSORS,
    Camera,
    PolarizationScene,
    emulate,
    pixel_analyzers,
    simulate,
)
from polarnet.simulation.scene import check_scene, scene_from_polarization, scene_from_rgb
from polarnet.simulation.upsampling import StokesFrame, upsampled
from polarnet.stokes import intensities_from_stokes

H, W = 24, 36
MOTION = replace(MOTIONS["default"], sensor_height=20, sensor_width=30, duration_s=0.5, acceleration_max_px_s2=4000.0)


def moving_frames(count: int, step: int) -> list[torch.Tensor]:
    """RGB frames of a picture that moves to the left by `step` pixels a frame."""
    large = picture(H, W + step * count)
    return [large[:, :, step * k : step * k + W] for k in range(count)]


@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize("polarizers", ["ideal", "micropolarizers"])
def test_a_moving_sensor_in_pieces_gives_the_events_and_the_truth_of_simulate(turning, polarizers, monkeypatch):
    monkeypatch.setattr(video_module, "MOTION_STEPS", 23)
    motion = replace(MOTION, rotation_max_deg=10.0, zoom_max=1.2) if turning else MOTION
    camera = Camera(SENSORS["noisy"], POLARIZERS[polarizers])
    result = simulate(picture(), motion, camera, seed=3)
    pieces = list(moving_pieces(scene_from_rgb(picture()), motion, camera, seed=3))
    assert len(pieces) > 3
    joined = [concatenate(channel) for channel in zip(*(piece.events for piece in pieces), strict=True)]
    assert all(map(equal, joined, result.events))
    assert sum(map(len, joined)) > 100
    assert torch.cat([piece.t_us for piece in pieces]).tolist() == result.t_us.tolist()
    truth = torch.cat([piece.stokes for piece in pieces])
    torch.testing.assert_close(intensities_from_stokes(truth).clamp(0, 1), result.intensities)


@pytest.mark.parametrize("model", ["exact", "v2e", "esim"])
def test_a_video_gives_what_emulate_gives_for_the_light_behind_ideal_polarizers(model, monkeypatch):
    monkeypatch.setattr(video_module, "PIECE_PIXELS", 3 * H * W)
    frames, t_us = moving_frames(8, 1), [0, 9_000, 20_000, 30_000, 41_000, 50_000, 60_000, 75_000]
    sensor = replace(SENSORS["default"], model=model)
    stokes = torch.stack([scene_from_rgb(frame).stokes for frame in frames])
    light = 255 * intensities_from_stokes(stokes)
    light = (light + 0.5).to(torch.uint8) if model == "v2e" else light
    expected, _ = emulate(light, np.array(t_us), sensor, seed_for(5, "video", "emulate"))
    got = simulate_video(frames, t_us, sensor, seed=5).events
    counts = [len(events) for events in got]
    assert counts == pytest.approx([len(events) for events in expected], rel=0.002, abs=2)
    assert all(map(equal, simulate_video(frames, t_us, sensor, seed=5, threads=2).events, got))
    assert sum(counts) > 100


@pytest.mark.parametrize("polarizers", ["film", "micropolarizers"])
def test_a_video_comes_with_its_camera_and_the_analyzer_of_each_pixel(polarizers):
    camera = Camera(SENSORS["random"], POLARIZERS[polarizers])
    result = simulate_video(moving_frames(2, 1), [0, 1000], camera, seed=7)
    assert result.camera == camera.drawn(7, "video")
    assert torch.equal(result.analyzer, pixel_analyzers(result.camera, H, W))
    assert result.analyzer.shape == ((4, 3) if polarizers == "film" else (4, 3, H // 2, W // 2))


def test_the_truth_of_a_dofp_sensor_is_the_mean_of_each_cell():
    stokes = scene_from_rgb(picture(H, W)).stokes
    camera = Camera(SENSORS["clean"], replace(POLARIZERS["ideal"], layout="dofp"))
    (piece,) = video_pieces([StokesFrame(0, stokes), StokesFrame(1000, stokes)], camera, seed=1)
    cells = stokes.reshape(3, H // 2, 2, W // 2, 2).mean(dim=(2, 4))
    torch.testing.assert_close(piece.stokes, torch.stack([cells, cells]))


def test_upsampling_moves_by_at_most_a_pixel_a_step_keeps_the_frames_and_at_least_a_microsecond():
    frames = [StokesFrame(10_000 * k, scene_from_rgb(rgb).stokes) for k, rgb in enumerate(moving_frames(4, 4))]
    dense = list(upsampled(frames))
    assert [frame.t_us for frame in dense][:: (len(dense) - 1) // 3] == [0, 10_000, 20_000, 30_000]
    assert 4 <= (len(dense) - 1) / 3 <= 6  # four pixels a frame
    by_time = {frame.t_us: frame.stokes for frame in dense}
    assert all(torch.equal(by_time[frame.t_us], frame.stokes) for frame in frames)
    for frame in dense:
        check_scene(PolarizationScene(frame.stokes))
    frames = [StokesFrame(3 * k, scene_from_rgb(rgb).stokes) for k, rgb in enumerate(moving_frames(3, 6))]
    assert [frame.t_us for frame in upsampled(frames)] == list(range(7))
    still = [StokesFrame(1000 * k, frames[0].stokes) for k in range(3)]
    assert len(list(upsampled(still))) == 3


@pytest.mark.parametrize(("degree", "angle"), [(0.8, None), (None, 0.3), (None, 0.3 + math.pi / 4)])
def test_texture_of_polarization_alone_moves_too(degree, angle):
    """AoLP or DoLP moves by 8 pixels; S0 is the same everywhere."""
    whole, large = torch.ones(H, W), picture(H, W + 9)[0]
    stokes = []
    for k in (0, 4, 8):
        texture = large[:, k : k + W]
        dolp, aolp = (texture if one is None else one * whole for one in (degree, angle))
        stokes.append(scene_from_polarization(0.8 * whole, dolp, aolp).stokes)
    dense = list(upsampled([StokesFrame(0, stokes[0]), StokesFrame(16_000, stokes[2])]))
    assert 8 <= len(dense) - 1 <= 12
    middle = min(dense, key=lambda frame: abs(frame.t_us - 8000)).stokes
    inner, blend = np.s_[:, 6:-6, 9:-9], (stokes[0] + stokes[2]) / 2
    assert (middle - stokes[1])[inner].abs().mean() < 0.5 * (blend - stokes[1])[inner].abs().mean()


def test_times_and_sizes_that_do_not_fit_and_unphysical_scenes_are_refused():
    frames = moving_frames(3, 1)
    for t_us, message in (
        ([0, 1000], "more frames than 2"),
        ([0, 1000, 2000, 3000], "more times than 3"),
        ([0, 1000, 1000], "times of frames that increase"),
        ([5, 1000, 2000], "starting at 0"),
        ([], "starting at 0"),
    ):
        with pytest.raises(ValueError, match=message):
            simulate_video(frames, t_us, SENSORS["clean"], seed=1)
    frames = moving_frames(3, 1)
    with pytest.raises(ValueError, match=r"expected frames of 24x36 px, got \(24, 35\)"):
        simulate_video([*frames[:2], frames[2][..., 1:]], [0, 1, 2], SENSORS["clean"], seed=1)
    bright = PolarizationScene(scene_from_polarization(*torch.ones(3, H, W)).stokes * 2)
    with pytest.raises(ValueError, match="scene"):
        simulate_video([frames[0], bright], [0, 1], SENSORS["clean"], seed=1)
