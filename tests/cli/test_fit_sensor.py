"""polarnet fit-sensor: table, sensor and picture."""

import shutil

import cv2
import numpy as np
import pytest
from ruamel.yaml import YAML
from test_simulate import SMALL

from polarnet.cli import main
from polarnet.config.tree import load
from polarnet.storage.events import EventStore
from polarnet.terminal.installation import shipped_settings

SIDE = 10


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Events of 100 pixels under light that swings between 40 and 160 DN in a second: thresholds of ln 4 / 8."""
    folder = tmp_path_factory.mktemp("recorded")
    frames = folder / "frames"
    frames.mkdir()
    for k in range(61):
        for part in range(20):  # the light bends at the corners of the swing, up to the first frame after them
            portion = part / 20 if k % 2 == 0 else 1 - part / 20
            np.save(frames / f"{20 * k + part:04d}.npy", np.full((SIDE, SIDE), 40.0 * 4**portion))
    (frames / "timestamps.txt").write_text("\n".join(str(50_000 * k) for k in range(1220)))
    rows = []
    for k in range(1, 60):
        for event in range(8):
            t = 1_000_000 * k + 125_000 * event + 62_500
            rows += [f"{t} {x} {y} {0 if k % 2 else 1}" for y in range(SIDE) for x in range(SIDE)]
    (folder / "moving.txt").write_text("\n".join(rows))
    return folder


@pytest.fixture
def ramps(recorded, tmp_path, monkeypatch):
    """A folder of its own with these recordings, as the working directory."""
    monkeypatch.chdir(tmp_path)
    for name in ("frames", "moving.txt"):
        (tmp_path / name).symlink_to(recorded / name)
    return tmp_path


FIT = ["fit-sensor", "--format", "text", "--height", str(SIDE), "--width", str(SIDE)]


def test_the_yaml_written_loads_as_a_sensor(ramps, capsys, monkeypatch):
    assert main([*FIT, "--name", "mine", "--moving", "moving.txt", "--frames", "frames"]) == 0
    printed = capsys.readouterr().out
    assert "leak_rate_hz" in printed
    assert "not estimated" in printed
    written = (ramps / "conf" / "sensor" / "mine.yaml").read_text()
    assert "contrast_threshold_on: 0.1733" in written  # ln 4 / 8
    assert "contrast_threshold_off: 0.1733" in written
    assert "leak_rate_hz" not in written
    assert "Kolmogorov-Smirnov" in printed
    assert cv2.imread("outputs/fit-sensor/mine.png").shape[1] > 500
    project = ramps / "project"
    shutil.copytree(shipped_settings() / "conf", project / "conf")
    shutil.copy(shipped_settings() / "params.yaml", project)
    (project / "conf" / "sensor" / "mine.yaml").write_text(written)
    assert load(project, ["sensor=mine"]).emulate.contrast_threshold_on == pytest.approx(0.1733)


def test_a_recording_without_frames_has_no_twin(ramps):
    assert main([*FIT, "--name", "mine", "--moving", "moving.txt"]) == 0
    assert not (ramps / "outputs").exists()


@pytest.mark.parametrize(
    ("arguments", "remedy"),
    [
        ([], "give --static"),
        (["--frames", "frames"], "give --static"),
        (["--static", "moving.txt", "--frames", "frames"], "give --moving"),
        (["--flicker", "moving.txt"], "--frequency"),
        (["--flicker", "moving.txt", "--frequency", "2"], "--contrast"),
        (["--static", "moving.txt", "--static-light", "300"], "white is 255"),
        (["--moving", "moving.txt", "--frames", "nowhere"], "name the folder"),
    ],
)
def test_options_that_do_not_fit_are_refused_with_a_remedy(ramps, capsys, arguments, remedy):
    assert main([*FIT, "--name", "mine", *arguments]) == 1
    assert remedy in capsys.readouterr().err
    assert not (ramps / "conf").exists()


def test_outside_a_clone_the_sensor_works_in_the_folder_where_it_was_fitted(ramps, capsys):
    assert main([*FIT, "--name", "mine", "--moving", "moving.txt", "--frames", "frames"]) == 0
    cv2.imwrite("photo.png", np.random.default_rng(1).integers(0, 256, (60, 80, 3), np.uint8))
    clip = ["simulate", "photo.png", *SMALL, "--no-preview"]
    assert main([*clip, "--out", "fitted", "sensor=mine"]) == 0
    written = YAML(typ="safe").load(ramps / "conf" / "sensor" / "mine.yaml")["emulate"]
    assert main([*clip, "--out", "same", *(f"emulate.{name}={value}" for name, value in written.items())]) == 0
    assert main([*clip, "--out", "default"]) == 0
    stores = [EventStore.open(f"{name}/events.zarr") for name in ("fitted", "same", "default")]
    fitted, same, default = ([events.t.tolist() for events in store.read(store.sequences[0])] for store in stores)
    assert fitted == same != default
    capsys.readouterr()
    assert main([*clip, "sensor=other"]) == 1
    assert "celex5, clean, davis346, default, gen41, mine, noisy, random" in capsys.readouterr().err


def test_a_sensor_of_polarnet_or_of_the_user_is_not_replaced(ramps, capsys):
    (ramps / "conf" / "sensor").mkdir(parents=True)
    (ramps / "conf" / "sensor" / "mine.yaml").write_text("emulate: {}\n")
    for name in ("noisy", "mine"):
        assert main([*FIT, "--name", name, "--moving", "moving.txt"]) == 1
        assert "choose another name" in capsys.readouterr().err
