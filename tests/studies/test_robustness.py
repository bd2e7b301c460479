import dataclasses
import itertools
from collections import Counter

import pytest

from polarnet.benchmark.score import FrameScore
from polarnet.config.pipeline import context_of
from polarnet.networks.weights import shipped_weights
from polarnet.storage.scenes import SceneStore
from studies.conditions import SENSORS
from studies.network_speed import EVENTS_PER_PIXEL, random_channels, windows_of
from studies.rate import rated_scores
from studies.robustness import Scores, headlines, table_of
from studies.robustness_blocks import mean_over_kinds
from studies.scored_pictures import settings, sources_of

ERRORS = {"pale": 0.001, "middle": 0.01, "strong": 0.1}
DOLP = {"pale": 0.03, "middle": 0.1, "strong": 0.5}


def scores(factor: float = 2.0) -> Scores:
    """Three scenes; the error of `ours` is `factor` times the oracle mean's, that of zeros ten times."""
    rows = [
        FrameScore(method, scene, scene, 5, 200_000, times * error, 20.0, 0.5, None, 0.1, 0.1, 0.0, error, None, error)
        for method, times in (("oracle_mean", 1.0), ("zeros", 10.0), ("ours", factor))
        for scene, error in ERRORS.items()
    ]
    return Scores(rows, DOLP, {})


def test_errors_are_given_as_means_as_medians_and_by_the_mean_dolp_of_a_scene():
    row = table_of(scores())["rows"]["ours"]
    assert row["mse"] == pytest.approx(2 * sum(ERRORS.values()) / 3)
    assert row["median_mse"] == pytest.approx(0.02)
    assert row["mse_over_oracle_mean"] == row["median_over_oracle_mean"] == pytest.approx(2)
    assert row["mse_by_dolp"] == pytest.approx({"below_0.06": 0.002, "0.06_to_0.2": 0.02, "above_0.2": 0.2})


def test_sensors_are_compared_with_the_default_one_and_the_worst_is_named():
    tables = {"sensors.default": table_of(scores()), "sensors.noisy": table_of(scores(factor=3.0))}
    sensors = headlines(tables, "ours")["sensors"]
    assert sensors["noisy"]["mse_over_default"] == pytest.approx(1.5)
    assert sensors["noisy"]["mse_over_oracle_mean"] == pytest.approx(3)
    assert sensors["worst_over_default"] == pytest.approx(1.5)


def test_measured_scenes_are_compared_with_the_best_row_that_needs_no_truth():
    rows = table_of(scores())
    rows["rows"]["ours"]["error_factor"] = 1.2
    assert headlines({"measured": rows}, "ours")["measured"]["mse_over_best_baseline"] == pytest.approx(0.2)


def test_each_kind_of_scenes_counts_equally_in_a_choice_between_networks():
    ratios = {"photographs_large": 1.0, "measured.one": 2.0, "measured.two": 8.0, "sensors.noisy": 2.0}
    rows = {name: {"ours": {"mse_over_oracle_mean": ratio}} for name, ratio in ratios.items()}
    assert mean_over_kinds(rows, "ours") == pytest.approx(2.0)  # of 1, 4 and 2


def test_the_loss_between_windows_is_the_larger_of_photographs_and_measured_scenes():
    def rated(ends: float, between: float) -> dict:
        return {"rows": {"ours": {"psnr": between}, "ours, window ends": {"psnr": ends}}}

    tables = {"time.2000hz.photographs": rated(20.0, 19.9), "time.2000hz.measured": rated(23.0, 22.7)}
    assert headlines(tables, "ours")["time"] == {"db_lost_2000hz": pytest.approx(0.3)}


def test_frames_between_windows_are_scored_sixteen_times_a_window(simulated):
    config, scenes = settings(), SceneStore.open(simulated.scenes)
    motion = dataclasses.replace(config.synthesize, duration_s=0.2)  # 6 windows, 2 of them warm-up
    contexts = {"ours": context_of(config, 0.3, shipped_weights())}
    rows, degree = rated_scores("a-0", scenes, motion, config.camera, 3, 2, contexts, config.between)
    numbers = Counter(row.method for row in rows)
    assert numbers == {"oracle_mean": 48, "ours": 48, "ours, held": 48, "ours, window ends": 4}
    carried, held = ([row.mse for row in rows if row.method == name] for name in ("ours", "ours, held"))
    assert carried != held
    assert 0 < degree < 1


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


@pytest.mark.parametrize("name", SENSORS)
def test_every_sensor_but_the_default_changes_the_configuration(name):
    assert (settings(*SENSORS[name]) == settings()) == (name == "default")


def test_random_windows_follow_each_other_and_hold_as_many_events_as_a_camera_fires():
    windows = windows_of(random_channels(24, 36, 5), 5)
    assert all(one.stop_us == after.start_us for one, after in itertools.pairwise(windows))
    for window in windows:
        assert all(((events.t >= window.start_us) & (events.t < window.stop_us)).all() for events in window.channels)
    per_pixel = sum(len(events) for window in windows for events in window.channels) / (5 * 4 * 24 * 36)
    assert per_pixel == pytest.approx(EVENTS_PER_PIXEL, rel=0.01)
