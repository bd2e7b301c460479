import math

import numpy as np
import pytest
import torch
import zarr

from polarnet.cli import main
from polarnet.recordings.source import RecordingError
from polarnet.recovery.rotating import half_turn_rule, rotation_of
from polarnet.simulation.camera import Camera
from polarnet.simulation.motion import resting_trajectory
from polarnet.simulation.polarizers import Grid
from polarnet.simulation.presets import SENSORS
from polarnet.simulation.rotating import RotatingConfig, emulate_rotating
from polarnet.simulation.scene import scene_from_polarization
from polarnet.storage.exchange import write_hdf5

HEIGHT, WIDTH, RATE_HZ, START_DEG = 8, 10, 5.0, 20.0


@pytest.fixture
def recording(tmp_path):
    """DoLP 0.5 at 60 degrees; the polarizer starts at 20 degrees."""
    maps = (torch.full((HEIGHT, WIDTH), value) for value in (0.9, 0.5, math.pi / 3))
    rotating = RotatingConfig(rate_hz=RATE_HZ, start_angle_deg=START_DEG, extinction_ratio=None, frames_per_turn=720)
    scene = scene_from_polarization(*maps)
    camera, size = Camera(SENSORS["default"], key=1), (HEIGHT, WIDTH)
    events = emulate_rotating(rotating, camera, scene, resting_trajectory(*size), 900_000, Grid(*size))
    write_hdf5(tmp_path / "e.h5", events, 900_000)
    return tmp_path / "e.h5"


def recovered(arguments, out):
    assert main(["recover", *map(str, arguments), "--out", str(out), "--write", "zarr"]) == 0
    group = zarr.open_group(out / "recovered.zarr", mode="r")
    return {name: group[name][:] for name in ("t_us", "dolp", "aolp", "log_variance")}


def test_a_recording_gives_dolp_and_aolp_every_half_turn(recording, tmp_path, monkeypatch, project_root):
    monkeypatch.chdir(project_root)
    frames = recovered([recording, "--rotating", RATE_HZ, "--start-angle", START_DEG], tmp_path / "out")
    assert np.diff(frames["t_us"]).tolist() == [100_000] * (len(frames["t_us"]) - 1)
    assert frames["dolp"][-1].mean() / 65535 == pytest.approx(0.5, abs=0.01)
    assert frames["aolp"][-1].mean() * 180 / 65536 == pytest.approx(60, abs=0.5)
    assert (tmp_path / "out" / "index.html").exists()


def test_the_fit_for_moving_scenes_gives_a_frame_each_half_turn_from_that_half_turn(
    recording, tmp_path, monkeypatch, project_root, capsys
):
    monkeypatch.chdir(project_root)
    options = [recording, "--rotating", RATE_HZ, "--start-angle", START_DEG, "--method", "rotating_polarizer"]
    frames = recovered(options, tmp_path / "out")
    assert frames["t_us"][:2].tolist() == [100_000, 200_000]
    assert frames["dolp"][-1].mean() / 65535 == pytest.approx(0.5, abs=0.05)
    assert frames["aolp"][-1].mean() * 180 / 65536 == pytest.approx(60, abs=3)
    assert main(["recover", str(recording), "--method", "rotating_polarizer"]) == 1
    assert "expected the rotation of the polarizer too: --rotating HZ" in capsys.readouterr().err


def test_triggers_replace_the_rate(recording, tmp_path, monkeypatch, project_root):
    monkeypatch.chdir(project_root)
    (tmp_path / "triggers.txt").write_text("0\n200000\n400000\n600000\n")
    options = [recording, "--start-angle", START_DEG, "--window", "200ms"]
    by_rate = recovered([*options, "--rotating", RATE_HZ], tmp_path / "a")
    by_trigger = recovered([*options, "--triggers", tmp_path / "triggers.txt"], tmp_path / "b")
    assert (by_rate["dolp"] == by_trigger["dolp"]).all()
    assert (by_rate["aolp"] == by_trigger["aolp"]).all()


def test_options_of_other_inputs_are_refused(recording, capsys, monkeypatch, project_root):
    monkeypatch.chdir(project_root)
    assert main(["recover", str(recording), "--rotating", "5", "--mosaic", "90 45 / 135 0"]) == 1
    assert "one file with --rotating or --triggers: expected no --mosaic" in capsys.readouterr().err
    assert main(["recover", str(recording), "--rotating", "5", "--method", "cf"]) == 1
    assert "--rotating: expected no --method" in capsys.readouterr().err
    assert main(["recover", str(recording), "--rotating", "5", "--window", "20000ev"]) == 1
    assert "--window: expected a time such as 500ms" in capsys.readouterr().err


def test_a_rate_beside_triggers_gives_the_sense_of_rotation(tmp_path):
    (tmp_path / "t.txt").write_text("100 200100")
    rotation = rotation_of(-3.0, tmp_path / "t.txt", 90.0)
    assert np.degrees(rotation.at(np.array([100, 50_100]))) == pytest.approx([90, 0])
    (tmp_path / "t.txt").write_text("soon")
    with pytest.raises(RecordingError, match="a time in whole microseconds on each line"):
        rotation_of(None, tmp_path / "t.txt", 0.0)


def test_windows_end_every_half_turn():
    rule = half_turn_rule(rotation_of(5.0, None, 0.0), 2.0)
    assert (rule.length_us, rule.step_us) == (400_000, 100_000)
