"""polarnet fit-sensor: table and sensor."""

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

SIDE, EVENTS = 10, 8


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Events of 100 pixels under a flicker of 1 Hz between 40 and 160 DN: thresholds of ln 4 / 8."""
    folder = tmp_path_factory.mktemp("recorded")
    light = np.exp(np.log(40) + np.log(4) * (np.arange(EVENTS) + 0.5) / EVENTS)
    rising = np.arcsin((light - 100) / 60) / (2 * np.pi)  # turns, from the darkest to the brightest
    turns = np.concatenate([rising, 0.5 - rising[::-1]])
    rows = [
        f"{round(1e6 * (cycle + turn))} {x} {y} {int(k < EVENTS)}"
        for cycle in range(1, 60)
        for k, turn in enumerate(turns)
        for y in range(SIDE)
        for x in range(SIDE)
    ]
    (folder / "flicker.txt").write_text("\n".join(rows))
    return folder / "flicker.txt"


@pytest.fixture
def folder(recorded, tmp_path, monkeypatch):
    """A folder of its own with the recording, as the working directory."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flicker.txt").symlink_to(recorded)
    return tmp_path


FIT = ["fit-sensor", "--format", "text", "--height", str(SIDE), "--width", str(SIDE)]
FLICKER = ["--flicker", "flicker.txt", "--frequency", "1", "--contrast", "0.6", "--flicker-light", "100"]


def test_the_yaml_written_loads_as_a_sensor_and_a_log_shows_the_progress_of_each_part(folder, capfd, monkeypatch):
    monkeypatch.setattr("polarnet.terminal.progress.LINE_S", 0.0)
    assert main([*FIT, "--name", "mine", *FLICKER]) == 0
    printed, log = capfd.readouterr()
    assert {line.split(":")[0] for line in log.splitlines() if "100%" in line} == {"read", "sort", "fit"}
    assert "leak_rate_hz" in printed
    assert "not estimated" in printed
    written = (folder / "conf" / "sensor" / "mine.yaml").read_text()
    assert "contrast_threshold_on: 0.173" in written  # ln 4 / 8
    assert "contrast_threshold_off: 0.173" in written
    assert "leak_rate_hz" not in written
    project = folder / "project"
    shutil.copytree(shipped_settings() / "conf", project / "conf")
    shutil.copy(shipped_settings() / "params.yaml", project)
    (project / "conf" / "sensor" / "mine.yaml").write_text(written)
    assert load(project, ["sensor=mine"]).emulate.contrast_threshold_on == pytest.approx(0.1733, abs=5e-4)


@pytest.mark.parametrize(
    ("arguments", "remedy"),
    [
        ([], "give --static"),
        (["--flicker", "flicker.txt"], "--frequency"),
        (["--flicker", "flicker.txt", "--frequency", "2"], "--contrast"),
        (["--static", "flicker.txt", "--static-light", "300"], "white is 255"),
    ],
)
def test_options_that_do_not_fit_are_refused_with_a_remedy(folder, capsys, arguments, remedy):
    assert main([*FIT, "--name", "mine", *arguments]) == 1
    assert remedy in capsys.readouterr().err
    assert not (folder / "conf").exists()


@pytest.mark.thorough
def test_outside_a_clone_the_sensor_works_in_the_folder_where_it_was_fitted(folder, capsys):
    assert main([*FIT, "--name", "mine", *FLICKER]) == 0
    cv2.imwrite("photo.png", np.random.default_rng(1).integers(0, 256, (60, 80, 3), np.uint8))
    clip = ["simulate", "photo.png", *SMALL, "--no-preview"]
    assert main([*clip, "--out", "fitted", "sensor=mine"]) == 0
    written = YAML(typ="safe").load(folder / "conf" / "sensor" / "mine.yaml")["emulate"]
    assert main([*clip, "--out", "same", *(f"emulate.{name}={value}" for name, value in written.items())]) == 0
    assert main([*clip, "--out", "default"]) == 0
    stores = [EventStore.open(f"{name}/events.zarr") for name in ("fitted", "same", "default")]
    fitted, same, default = ([events.t.tolist() for events in store.read(store.sequences[0])] for store in stores)
    assert fitted == same != default
    capsys.readouterr()
    assert main([*clip, "sensor=other"]) == 1
    assert "celex5, clean, davis346, default, gen41, mine, noisy, random" in capsys.readouterr().err


def test_a_sensor_of_polarnet_or_of_the_user_is_not_replaced(folder, capsys):
    (folder / "conf" / "sensor").mkdir(parents=True)
    (folder / "conf" / "sensor" / "mine.yaml").write_text("emulate: {}\n")
    for name in ("noisy", "mine"):
        assert main([*FIT, "--name", name, *FLICKER]) == 1
        assert "choose another name" in capsys.readouterr().err
