import math

import numpy as np
import pytest
import torch
import zarr

from polarnet.cli import main
from polarnet.recordings.source import RecordingError
from polarnet.recordings.writers import write_hdf5
from polarnet.recovery.inputs import rotation_of
from polarnet.simulation import SENSORS, scene_from_polarization
from polarnet.simulation.camera import Camera, Grid
from polarnet.simulation.motion import resting_trajectory
from polarnet.simulation.rotating import RotatingConfig, emulate_rotating

HEIGHT, WIDTH, RATE_HZ, START_DEG = 8, 10, 5.0, 20.0


@pytest.fixture
def recording(tmp_path):
    """DoLP 0.5 at 60 degrees; the polarizer starts at 20 degrees."""
    maps = (torch.full((HEIGHT, WIDTH), value) for value in (0.9, 0.5, math.pi / 3))
    rotating = RotatingConfig(rate_hz=RATE_HZ, start_angle_deg=START_DEG, extinction_ratio=None, frames_per_turn=720)
    scene = scene_from_polarization(*maps)
    camera, size = Camera(SENSORS["default"], key=1), (HEIGHT, WIDTH)
    events = emulate_rotating(rotating, camera, scene, resting_trajectory(*size), 900_000, Grid(*size))
    write_hdf5(tmp_path / "e.h5", events)
    return tmp_path / "e.h5"


def recovered(arguments, out):
    assert main(["recover-rotating", *map(str, arguments), "--out", str(out)]) == 0
    group = zarr.open_group(out / "recovered.zarr", mode="r")
    return {name: group[name][:] for name in ("t_us", "dolp", "aolp", "log_variance")}


def test_a_recording_gives_dolp_and_aolp_every_half_turn(recording, tmp_path, at_root):
    frames = recovered([recording, "--rate", RATE_HZ, "--start-angle", START_DEG], tmp_path / "a")
    assert frames["t_us"][:2].tolist() == [100_000, 200_000]
    assert frames["dolp"][-1].mean() / 65535 == pytest.approx(0.5, abs=0.05)
    assert frames["aolp"][-1].mean() * 180 / 65536 == pytest.approx(60, abs=3)
    assert (tmp_path / "a" / "index.html").exists()
    (tmp_path / "triggers.txt").write_text("0\n200000\n400000\n600000\n")
    triggers = [recording, "--triggers", tmp_path / "triggers.txt", "--start-angle", START_DEG, "--step", "50ms"]
    by_trigger = recovered(triggers, tmp_path / "b")
    assert by_trigger["t_us"][:3].tolist() == [50_000, 100_000, 150_000]
    assert (by_trigger["dolp"][1::2] == frames["dolp"]).all()
    assert (by_trigger["aolp"][1::2] == frames["aolp"]).all()


def test_without_a_rate_or_triggers_there_is_no_rotation_and_recover_has_no_such_method(recording, capsys, at_root):
    assert main(["recover-rotating", str(recording)]) == 1
    assert "expected the rate of the polarizer (--rate HZ) or its triggers" in capsys.readouterr().err
    assert main(["recover", str(recording), "--method", "rotating_polarizer"]) == 1
    assert "--method: expected a method of cf," in capsys.readouterr().err


def test_a_rate_beside_triggers_gives_the_sense_of_rotation(tmp_path):
    (tmp_path / "t.txt").write_text("100 200100")
    rotation = rotation_of(-3.0, tmp_path / "t.txt", 90.0)
    assert np.degrees(rotation.at(np.array([100, 50_100]))) == pytest.approx([90, 0])
    (tmp_path / "t.txt").write_text("soon")
    with pytest.raises(RecordingError, match="a time in whole microseconds on each line"):
        rotation_of(None, tmp_path / "t.txt", 0.0)
