import numpy as np
import pytest
import torch

from polarnet.benchmark.score import FrameScore
from polarnet.benchmark.sequences import TestSequence
from polarnet.events.stream import Events
from polarnet.stokes import StokesFrames
from studies.robustness import SENSORS, Scores, filtered_with, headlines, table_of
from studies.scored_pictures import settings, sources_of

ERRORS = {"pale": 0.001, "middle": 0.01, "strong": 0.1}
DOLP = {"pale": 0.03, "middle": 0.1, "strong": 0.5}


def scores(factor: float = 2.0) -> Scores:
    """Three scenes; the error of `ours` is `factor` times the oracle mean's, that of zeros ten times."""
    unscored = FrameScore._make([None] * len(FrameScore._fields))
    rows = [
        unscored._replace(method=method, scene=scene, mse=times * error, psnr=20.0, oracle_mse=error)
        for method, times in (("oracle_mean", 1.0), ("zeros", 10.0), ("ours", factor))
        for scene, error in ERRORS.items()
    ]
    return Scores(rows, DOLP, {})


def test_headlines_compare_mean_errors_over_scenes_with_the_oracle_mean_and_the_best_baseline():
    rows = table_of(scores())
    assert rows["rows"]["ours"]["mse"] == pytest.approx(2 * sum(ERRORS.values()) / 3)
    assert rows["rows"]["ours"]["mse_over_oracle_mean"] == rows["rows"]["ours"]["median_over_oracle_mean"]
    assert rows["rows"]["ours"]["median_over_oracle_mean"] == pytest.approx(2)
    rows["rows"]["ours"]["error_factor"] = 1.2
    tables = {"sensors.default": rows, "sensors.noisy": table_of(scores(factor=3.0)), "measured": rows}
    lines = headlines(tables, "ours")
    assert lines["sensors"]["worst_over_default"] == pytest.approx(1.5)
    assert lines["measured"]["mse_over_best_baseline"] == pytest.approx(0.2)


def test_a_folder_with_a_manifest_has_a_source_for_each_repo(tmp_path):
    folder = tmp_path / "scenes"
    folder.mkdir()
    (folder / "manifest.csv").write_text("file,repo\na.npz,one/first\nb.npz,two/second\nc.npz,one/first\n")
    sources = sources_of(folder, tmp_path)
    assert {name: sorted(file.name for file in of.iterdir()) for name, of in sources.items()} == {
        "first": ["a.npz", "c.npz"],
        "second": ["b.npz"],
    }
    assert sources_of(tmp_path, tmp_path) == {tmp_path.name: tmp_path}


@pytest.mark.thorough
def test_every_sensor_but_the_default_changes_the_configuration():
    default = settings()
    assert [name for name, overrides in SENSORS.items() if settings(*overrides) == default] == ["default"]


def test_the_filter_with_frames_shows_the_frame_where_no_event_came_and_nowhere_more_than_full_polarization():
    stokes = torch.tensor([0.3, 0.4])[None, :, None, None].expand(1, 2, 2, 2)
    frames = StokesFrames(np.array([0]), stokes, torch.ones(1, 2, 2, dtype=torch.bool))
    count, first = 200, np.zeros(200, np.int64)
    burst = Events.from_columns(100 * np.arange(count), first, first, first + 1, height=2, width=2)
    none = Events.from_columns(first[:0], first[:0], first[:0], first[:0], height=2, width=2)
    maps = torch.zeros(1, 2, 2)
    test = TestSequence("name", "scene", [none, burst, none, none], torch.tensor([0, 33_333]), maps, maps, maps)
    dolp = filtered_with(frames, test, settings()).dolp[0]
    assert dolp[1].tolist() == pytest.approx([0.5, 0.5], abs=1e-6)
    assert dolp[0, 0] == 1
