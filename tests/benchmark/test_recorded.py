"""`polarnet benchmark --recordings` on files in E2P's layout."""

import json

import numpy as np
import pytest
import torch
import zarr

from polarnet.cli import main
from polarnet.cli.recorded import clock_notes, frame_lag, make_recorded_set, read_recorded
from polarnet.config.tree import load
from polarnet.events.stream import Events, join_mosaic, merge, shifted
from polarnet.networks.e2p.network import MOSAIC
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.pictures.images import write_png
from polarnet.recordings.noise import Cleaning
from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError
from polarnet.recordings.truth import read_truth
from polarnet.runtime.machine import generator_for
from polarnet.simulation.sets import make_folder_set
from polarnet.storage import EventStore, FrameStore
from studies.recording_files import WHITE, mosaicked, write_e2p

pytestmark = pytest.mark.usefixtures("brief_costs")

pytest.importorskip("h5py")

NOTHING = Cleaning(None, None)
TINY = [
    "ingest.height=100", "ingest.width=150", "synthesize.duration_s=0.2", "synthesize.sensor_height=32",
    "synthesize.sensor_width=44", "benchmark.warmup_windows=1", "benchmark.bootstrap_samples=10",
    "benchmark.panel_scenes=1", "benchmark.lpips=false", "runtime.threads=1",
    "baselines.e2v.crop=null", "baselines.e2p.crop=null",
]  # fmt: skip


@pytest.fixture(scope="module")
def made(project_root, tmp_path_factory):
    """A simulated set, and beside it the folder `recordings` with its sequences as files of E2P."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "pictures").mkdir()
    write_png(folder / "pictures" / "beach.png", dead_leaves(generator_for(1, "beach", "picture"), 100, 150), bits=8)
    config = load(project_root, TINY)
    make_folder_set(folder / "pictures", "photographs", folder / "set", config.recipe, config.mapper)
    events, frames = EventStore.open(folder / "set" / "events.zarr"), FrameStore.open(folder / "set" / "frames.zarr")
    (name,) = events.sequences
    truth = frames.frames(name)
    s0 = (truth.intensity[:, 0] + truth.intensity[:, 2]).numpy()
    levels = np.rint(WHITE * mosaicked(2 * truth.intensity.numpy()).clip(0, 1)).astype(np.uint8)
    maps = s0, truth.dolp.numpy(), truth.aolp.numpy()
    (folder / "recordings").mkdir()
    path = folder / "recordings" / f"{name}.h5"
    write_e2p(path, join_mosaic(events.read(name), MOSAIC), truth.t_us.numpy(), levels, maps)
    return folder


@pytest.fixture
def recording(made):
    (path,) = (made / "recordings").glob("*.h5")
    return path


@pytest.mark.thorough
def test_every_kind_of_method_has_its_row_and_the_truth_is_that_of_the_files(
    made, checkpoints, project_root, tmp_path, monkeypatch, capsys
):
    (made / "recordings" / "notes.txt").write_text("no recording at all")
    monkeypatch.chdir(project_root)
    weights = [f"+rows.{row}={{needs: {checkpoints[row]}, settings: benchmark.precision}}" for row in ("e2p", "paper")]
    weights.append(f"rows.e2v.needs={checkpoints['e2v']}")
    rows = ["cf", "e2v", "e2p", "paper", "ours", "rotating_polarizer", "zeros", "oracle_mean"]
    arguments = ["--methods", ",".join(rows), "--weights", str(checkpoints["ours"]), "--out", str(tmp_path / "out")]
    paths = [f"paths.data={tmp_path / 'nothing'}"]
    assert main(["benchmark", "--recordings", str(made / "recordings"), *arguments, *TINY, *paths, *weights]) == 0
    (made / "recordings" / "notes.txt").unlink()
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert set(metrics) == set(rows) - {"rotating_polarizer"}
    assert all(np.isfinite(scores["mse"]) for scores in metrics.values())
    printed = capsys.readouterr().out
    assert "Skipped, because only files of e2p, aedat4, aedat2 hold frames: notes.txt." in printed
    assert "rotating_polarizer was left out: recordings hold the events of four channels" in printed
    assert "hardly agree" not in printed
    page = (tmp_path / "out" / "index.html").read_text()
    assert "polarnet benchmark --recordings" in page
    stored = FrameStore.open(tmp_path / "out" / "work" / "set" / "frames.zarr")
    known = FrameStore.open(made / "set" / "frames.zarr")
    (name,), (original,) = stored.sequences, known.sequences
    assert (stored.frames(name).dolp - known.frames(original).dolp).abs().max() < 0.5 / 255 + 2e-5
    assert stored.t_us(name).tolist() == known.t_us(original).tolist()


def test_events_and_frames_on_one_clock_agree_and_a_shift_is_found(recording):
    events, truth = read_recording(recording).events, read_truth(recording, MOSAIC)
    lag = frame_lag(events, truth)
    assert lag.agreement > 0.3
    assert abs(lag.lag_us) < 8000  # light does not change evenly between frames
    assert clock_notes(truth.t_us, lag) == []
    late = frame_lag(shifted(events, 30_000), truth)  # the same events, 30 ms earlier
    assert late.lag_us == pytest.approx(30_000 + lag.lag_us, abs=6000)
    (note,) = clock_notes(truth.t_us, late)
    assert "ms late against the events" in note


def test_unrelated_events_are_reported_and_frames_far_from_them_refused(recording, make_random_events, tmp_path):
    truth = read_truth(recording, MOSAIC)
    noise = make_random_events(0, 20_000, int(truth.t_us[-1]), 64, 88)
    (note,) = clock_notes(truth.t_us, frame_lag(noise, truth))
    assert "whether they are on one clock is unknown" in note
    levels = np.rint(WHITE * truth.light.clip(0, 1)).astype(np.uint8)
    path = tmp_path / "far.h5"
    write_e2p(path, read_recording(recording).events, truth.t_us + 10_000_000, levels, None)
    with pytest.raises(RecordingError, match=r"far\.h5: expected events and frames on one clock, got events from"):
        read_recorded(path, "far", MOSAIC, NOTHING)


def test_a_folder_without_recordings_and_options_that_do_not_apply_are_refused(tmp_path, make_events, capsys):
    with pytest.raises(ValueError, match="expected a folder of recordings, got none"):
        make_recorded_set(tmp_path / "none", tmp_path / "work", MOSAIC, NOTHING)
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "e.txt").write_text("4 4\n1 2 3 1\n")
    for k in range(10):
        (tmp_path / "in" / f"{k}.jpg").touch()
    with pytest.raises(ValueError, match=r"no recording with true polarization. Skipped, .* 7\.jpg and 3 more\."):
        make_recorded_set(tmp_path / "in", tmp_path / "work", MOSAIC, NOTHING)
    assert main(["benchmark", "--scenes", str(tmp_path), "--hot-pixels", "found"]) == 1
    assert "--scenes: expected no --hot-pixels" in capsys.readouterr().err
    assert main(["benchmark", "--recordings", str(tmp_path), "--background", "20ev"]) == 1
    assert "--background: expected a time such as 10ms" in capsys.readouterr().err


def test_hot_pixels_of_a_recording_are_removed_before_it_is_scored(recording, tmp_path):
    events, truth = read_recording(recording).events, read_truth(recording, MOSAIC)
    t = torch.arange(int(events.t[0]), int(events.t[-1]), 200)
    places = torch.full_like(t, 20).short()
    hot = Events(t, places, places, torch.ones_like(t).to(torch.int8), 64, 88)
    levels = np.rint(WHITE * truth.light.clip(0, 1)).astype(np.uint8)
    (tmp_path / "in").mkdir()
    write_e2p(tmp_path / "in" / "hot.h5", merge([events, hot]), truth.t_us, levels, None)
    clean = read_recorded(tmp_path / "in" / "hot.h5", "hot", MOSAIC, Cleaning("found", None))
    joined = join_mosaic(clean.channels, MOSAIC)
    assert not ((joined.x == 20) & (joined.y == 20)).any()
    (note,) = clean.notes
    assert "of 1 hot pixels" in note
    assert mosaicked(truth.intensity.numpy()).shape == truth.light.shape


def test_recover_takes_the_frames_of_the_camera_and_says_where_it_cannot(recording, made, tmp_path, capsys):
    def run(*more, out="out"):
        return main(["recover", str(recording), *more, "--out", str(tmp_path / out), "--write", "zarr"])

    mosaic = ["--mosaic", " / ".join(" ".join(map(str, row)) for row in MOSAIC)]
    for out, more in (("frames", ["--frames"]), ("events", [])):
        assert run(*mosaic, *more, out=out) == 0
    known = FrameStore.open(made / "set" / "frames.zarr")
    dolp = known.frames(known.sequences[0]).dolp.numpy()
    errors = {}
    for out in ("frames", "events"):
        found = np.asarray(zarr.open_group(tmp_path / out / "recovered.zarr", mode="r")["dolp"]) / 65535
        errors[out] = np.square(found - dolp[1 : 1 + len(found)]).mean()
    assert errors["frames"] < 0.2 * errors["events"]
    assert f"with {len(dolp)} frames of the camera" in capsys.readouterr().out
    assert run(*mosaic, "--frames", "--step", "1ms", out="steps") == 0
    ends, steps = (zarr.open_group(tmp_path / out / "recovered.zarr", mode="r") for out in ("frames", "steps"))
    assert 990 <= np.diff(steps["t_us"]).min() <= np.diff(steps["t_us"]).max() <= 1020
    same = np.isin(steps["t_us"], ends["t_us"])
    np.testing.assert_array_equal(steps["dolp"][:][same], ends["dolp"][:])
    for more, reason in (
        ([], "--frames: expected --mosaic"),
        ([*mosaic, "--method", "cf"], "--frames is for --method registered, cf does not use them"),
    ):
        assert run("--frames", *more) == 1
        assert reason in capsys.readouterr().err
