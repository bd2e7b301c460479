import json
import subprocess

import pytest

from polarnet.reports.provenance import git
from studies import measure
from studies.blocks import BLOCKS
from studies.measure import (
    BENCHMARK_KEYS,
    _timed,
    ablation_about,
    arguments_of,
    command_line,
    machine_record,
    measure_ablation,
    measure_benchmark,
    measure_pipeline,
    measure_sweep,
    measure_tests,
    uncommitted,
    write_section,
)


def test_the_minutes_of_a_target_are_those_of_its_stages(tmp_path):
    (tmp_path / "Makefile").write_text(
        "two:\n\t@echo \"Running stage 'ingest':\"\n\t@sleep 0.7\n\t@echo \"Running stage 'train':\"\n\t@sleep 0.7\n"
        "none:\n\t@echo nothing to do\n"
        "broken:\n\t@exit 3\n"
    )
    minutes, stages = _timed("two", tmp_path)
    assert list(stages) == ["ingest", "train"]
    assert all(value == 0.01 for value in stages.values())  # 0.7 s, to a hundredth of a minute
    assert minutes == pytest.approx(sum(stages.values()), abs=0.011)
    assert _timed("none", tmp_path)[1] == {}
    with pytest.raises(RuntimeError, match="make broken failed in a fresh clone"):
        _timed("broken", tmp_path)


def test_figures_name_their_machine_and_commit(project_root):
    record = machine_record(project_root)
    assert set(record) == {"machine", "bf16_units", "cores", "load", "versions", "commit"}
    assert record["commit"] == git(project_root, "rev-parse", "HEAD")


def test_a_section_of_the_results_is_replaced_and_the_others_stay(tmp_path):
    write_section(tmp_path, "recordings", "rig", {"captures": 8, "old": 1}, {"commit": "a"})
    write_section(tmp_path, "recordings", "fuzz", {"cases_per_reader": 10}, {"commit": "b"})
    path = write_section(tmp_path, "recordings", "rig", {"captures": 32}, {"commit": "c"})
    assert path == tmp_path / "docs" / "results" / "recordings.json"
    assert json.loads(path.read_text()) == {
        "fuzz": {"cases_per_reader": 10},
        "records": {"fuzz": {"commit": "b"}, "rig": {"commit": "c"}},
        "rig": {"captures": 32},
    }


def test_headlines_stand_above_the_sections_and_join_what_is_there(tmp_path):
    write_section(tmp_path, "network", "speed", {"a": 1}, {}, {"speedup": 2.0, "ours": {"per_s": 10}})
    path = write_section(tmp_path, "network", "study", {"b": 1}, {}, {"ours": {"mse": 0.1}})
    results = json.loads(path.read_text())
    assert results["speedup"] == 2.0
    assert results["ours"] == {"mse": 0.1, "per_s": 10}


def test_a_tree_with_changes_is_not_measured(tmp_path):
    git(tmp_path, "init", "--quiet")
    (tmp_path / "file").write_text("one")
    git(tmp_path, "add", "file")
    with pytest.raises(RuntimeError, match="uncommitted changes"):
        measure_pipeline(tmp_path)


def test_what_is_measured_is_no_change_of_what_it_names(tmp_path):
    git(tmp_path, "init", "--quiet")
    files = [tmp_path / name for name in ("docs/results/a.json", "docs/pictures/a.png", "params.yaml", "code.py")]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("one")
    git(tmp_path, "add", ".")
    git(tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "--quiet", "-m", "one")
    for file in files[:3]:
        file.write_text("two")
    assert uncommitted(tmp_path, "params.yaml") == ""
    assert "params.yaml" in uncommitted(tmp_path)
    files[3].write_text("two")
    assert "code.py" in uncommitted(tmp_path, "params.yaml")


def swept(root, write_trial, **mse):
    (root / "conf" / "ablation").mkdir(parents=True)
    for number, (name, value) in enumerate(mse.items()):
        overrides = [f"ablation={name}", "train.epochs=1", "paths.data=x"]
        write_trial(root / "sweep" / str(number), overrides, test={"mse": value, "psnr": 15.0})
        (root / "conf" / "ablation" / f"{name}.yaml").write_text(f"# @package _global_\n# Without {name}.\n")
    (root / "conf" / "file").write_text("")
    git(root, "init", "--quiet")
    git(root, "add", "conf")
    git(root, "-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "--quiet", "-m", "one")
    return root / "sweep"


def test_an_ablation_has_the_scores_of_each_job_and_a_description_in_conf(tmp_path, write_trial):
    sweep = swept(tmp_path, write_trial, nothing=0.03, sums=0.05)
    results = json.loads(measure_ablation(tmp_path, sweep).read_text())
    assert results["ablation"]["overrides"] == ["train.epochs=1"]
    assert ablation_about(tmp_path, "sums") == "Without sums."
    assert {name: row["mse"] for name, row in results["ablation"]["rows"].items()} == {"nothing": 0.03, "sums": 0.05}
    assert results["records"]["ablation"]["commit"] == git(tmp_path, "rev-parse", "HEAD")


def test_an_ablation_needs_the_whole_to_compare_with(tmp_path, write_trial):
    with pytest.raises(RuntimeError, match="expected a finished job with ablation=nothing, got sums"):
        measure_ablation(tmp_path, swept(tmp_path, write_trial, sums=0.05))


def loss_sweep(root, write_trial):
    """Two sweeps, of the weights (10, 0, 0) and (10, 1, 0), the first with two seeds; the folder of each."""
    git(root, "init", "--quiet")
    git(root, "-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "--quiet", "--allow-empty", "-m", "one")
    for number, mse in enumerate((0.03, 0.05)):
        overrides = ["network=paper", f"loss.ssim={0.0}", f"seed={number + 1}", "runtime.threads=1"]
        scores = {"mse": mse, "psnr": 15.0, "ssim": 0.5, "lpips": 0.4}
        validation = {"mse": 2 * mse, "psnr": 14.0}
        write_trial(root / "one" / str(number), overrides, (10.0, 0.0, 0.0), number + 1, validation, scores)
    scores = {"mse": 0.02, "psnr": 17.0, "ssim": 0.6, "lpips": 0.3}
    validation = {"mse": 0.09, "psnr": 12.0}
    write_trial(root / "two" / "0", ["network=paper", "loss.ssim=1.0"], (10.0, 1.0, 0.0), 1, validation, scores)
    return [root / "one", root / "two"]


def test_a_loss_sweep_becomes_means_over_seeds_a_table_and_a_heat_map(tmp_path, write_trial):
    path, picture = measure_sweep(tmp_path, loss_sweep(tmp_path, write_trial))
    results = json.loads(path.read_text())
    assert [point["weights"] for point in results["points"]] == [
        {"mse": 10.0, "ssim": 0.0, "lpips": 0.0},  # the smaller validation MSE, though the larger test MSE
        {"mse": 10.0, "ssim": 1.0, "lpips": 0.0},
    ]
    assert results["points"][0]["seeds"] == [1, 2]
    assert results["points"][0]["test"]["mse"] == {"mean": pytest.approx(0.04), "std": pytest.approx(0.01 * 2**0.5)}
    assert results["points"][1]["test"]["mse"] == {"mean": 0.02, "std": None}
    assert results["loss_weights"] == {"overrides": ["network=paper"], "lpips_backbone": "alex"}
    assert results["records"]["loss_weights"]["commit"] == git(tmp_path, "rev-parse", "HEAD")
    assert picture.read_bytes().startswith(b"\x89PNG")
    lines = BLOCKS["sweep"].text(results).splitlines()
    assert lines[2].startswith("| 10 | 0 | 0 | 2 | 0.0800 ± 0.0283 | 14.00 ± 0.00 | 0.0400 ± 0.0141 |")
    assert lines[3].startswith("| 10 | 1 | 0 | 1 | 0.0900 | 12.00 | 0.0200 | 17.00 | 0.6000 | 0.3000 | - |")


def test_a_loss_sweep_is_complete_and_of_one_setting(tmp_path, write_trial):
    sweeps = loss_sweep(tmp_path, write_trial)
    with pytest.raises(RuntimeError, match="expected new weights or a new seed, got a second such job"):
        measure_sweep(tmp_path, [*sweeps, sweeps[0]])
    write_trial(tmp_path / "other" / "0", ["network=polarnet"], (1.0, 0.0, 0.0), test={"mse": 0.1})
    with pytest.raises(RuntimeError, match="got as other overrides: network=paper; network=polarnet"):
        measure_sweep(tmp_path, [*sweeps, tmp_path / "other"])
    write_trial(tmp_path / "other" / "0", ["network=paper"], failure="train: it broke")
    with pytest.raises(RuntimeError, match="other/0 failed: train: it broke; run this point again"):
        measure_sweep(tmp_path, [tmp_path / "other"])


def write_results(folder):
    folder.mkdir(parents=True)
    costs = {"ms_per_window": 0.5, "gflop": 0.5, "params": 7, "peak_mib": 0.5}
    scores = {key: 0.5 for key in BENCHMARK_KEYS if key not in costs}
    ours = scores | {"lpips": None, "lpips_backbone": None, "mse_ci": [0.4, 0.6]}
    (folder / "metrics.json").write_text(json.dumps({"zeros": {"mse": 1.0}, "ours": ours}))
    (folder / "cost.json").write_text(json.dumps({"zeros": costs | {"gflop": None}, "ours": costs}))
    pairs = {"zeros": {"mse": {"scenes": 6, "better": 6, "effect": 1.0, "p": 0.03125, "p_holm": 0.03125}}}
    about = {"frames": 12, "warmup_windows": 5, "precision": "fp32", "scenes": ["a"] * 6, "paired": pairs}
    (folder / "details.json").write_text(json.dumps(about | {"lpips": {"backbone": None}}))


@pytest.fixture
def measured_project(tmp_path):
    """A repository with one commit and both sets' results in data/."""
    (tmp_path / "file").write_text("one")
    identity = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    for command in (["init", "--quiet"], ["add", "file"], [*identity, "commit", "--quiet", "-m", "one"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    write_results(tmp_path / "data" / "benchmark")
    write_results(tmp_path / "data" / "benchmark" / "sets" / "measured")
    return tmp_path


def test_benchmark_results_are_sets_then_methods_then_figures(measured_project):
    path = measure_benchmark(measured_project, measured_project / "data" / "benchmark")
    results = json.loads(path.read_text())
    assert {"simulated", "measured", "machine", "commit"} <= set(results)
    for name in ("simulated", "measured"):
        assert set(results[name]) == {"zeros", "ours"}
        assert set(results[name]["ours"]) == set(BENCHMARK_KEYS)
        assert results[name]["ours"]["params"] == 7
        assert results[name]["zeros"]["gflop"] is None
    block = BLOCKS["benchmark-measured"].text(results)
    assert "6 scenes, 12 frames. On " in block
    assert "zeros: ours is better in 6 of 6 scenes (effect +1.00, p = 0.031)." in block


def test_a_set_that_was_not_run_is_asked_for(tmp_path, measured_project):
    (measured_project / "data" / "benchmark" / "sets" / "measured" / "metrics.json").unlink()
    with pytest.raises(RuntimeError, match=r"no results of measured; run `dvc repro` with benchmark.sets"):
        measure_benchmark(measured_project, measured_project / "data" / "benchmark")


def test_figures_are_kept_where_the_tests_fail(tmp_path):
    """A project of which `make repro` leaves what the record takes, and whose tests fail."""
    root = tmp_path / "project"
    for folder in ("data/benchmark", "data/report", "docs/results", "docs/pictures"):
        (root / folder).mkdir(parents=True)
        (root / folder / ".keep").write_text("")
    (root / "data" / "benchmark" / "metrics.json").write_text('{"ours": {"mse": 0.1}}')
    (root / "data" / "benchmark" / "cost.json").write_text('{"ours": {"params": 7}}')
    (root / "data" / "benchmark" / "details.json").write_text('{"lpips": {"backbone": "alex"}, "weights": {}}')
    (root / "data" / "report" / "overview.png").write_bytes(b"picture")
    (root / "Makefile").write_text("setup:\n\t@true\nrepro:\n\t@echo stages > dvc.lock\ntest:\n\t@false\n")
    git(root, "init", "--quiet")
    git(root, "add", ".")
    git(root, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "--quiet", "-m", "all")
    with pytest.raises(RuntimeError, match="make test failed"):
        measure_pipeline(root)
    record = json.loads((root / "docs" / "results" / "pipeline.json").read_text())
    assert record["metrics"] == {"ours": {"mse": 0.1, "params": 7}}
    assert record["lpips"] == {"backbone": "alex"}
    assert "test_minutes" not in record
    speed = json.loads((root / "docs" / "results" / "speed.json").read_text())
    assert speed["repro_minutes"] == record["repro_minutes"]
    assert (root / "dvc.lock").read_text() == "stages\n"
    (root / "Makefile").write_text("setup:\n\t@true\ntest:\n\t@true\n")
    with pytest.raises(RuntimeError, match="uncommitted changes"):
        measure_tests(root)
    git(root, "add", ".")
    git(root, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "--quiet", "-m", "tests that pass")
    later = json.loads(measure_tests(root).read_text())
    assert later == record | {"test_minutes": later["test_minutes"], "test_commit": git(root, "rev-parse", "HEAD")}
    assert (root / "docs" / "pictures" / "overview.png").read_bytes() == b"picture"


def test_figures_of_a_changed_tree_may_be_measured_but_not_written(monkeypatch, capsys):
    monkeypatch.setattr(measure, "uncommitted", lambda root: "M code.py")
    monkeypatch.setattr("sys.argv", ["study"])
    assert not arguments_of(command_line("A study.", "docs/results/a.json")).write
    monkeypatch.setattr("sys.argv", ["study", "--write"])
    with pytest.raises(SystemExit):
        arguments_of(command_line("A study.", "docs/results/a.json"))
    assert "commit first, because the figures name a commit; changed:\nM code.py" in capsys.readouterr().err
