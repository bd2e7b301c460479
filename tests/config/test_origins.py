"""Values that an artefact was made with, the rows of the benchmark, and the files that they read."""

import re
import shutil
from pathlib import Path

import pytest

from polarnet.benchmark.run import Benchmark
from polarnet.benchmark.score import Cost
from polarnet.config import benchmark_tables, pipeline
from polarnet.config.origins import ORIGIN, Run, digest, read_origin
from polarnet.config.tree import Config, load


@pytest.fixture
def run(project_root: Path, tmp_path: Path):
    """Builds the run of a script with overrides, on artefacts in a folder of the test's own."""

    def build(script: str, *overrides: str) -> Run:
        return Run(project_root, config(*overrides), script)

    def config(*overrides: str) -> Config:
        return load(project_root, [f"paths.data={tmp_path / 'data'}", *overrides])

    return build


def make(run: Run) -> None:
    """Stand-in for the stages of a run: the folders of their outputs, with origins."""
    for stage in run.stages:
        for out in stage.outs:
            run.config.place(out).mkdir(parents=True, exist_ok=True)
    run.check_inputs()
    run.write_origins()


def make_all(run, *scripts: str) -> None:
    for script in scripts:
        make(run(script))


SIMULATION = ("ingest", "synthesize", "emulate")


def test_equal_values_are_accepted_and_a_changed_one_names_key_both_values_and_the_command(run, tmp_path):
    make_all(run, *SIMULATION)
    run("train").check_inputs()
    run("train", "loss.mse=3.0", "train.epochs=4").check_inputs()  # its own values
    with pytest.raises(ValueError) as refusal:
        run("train", "emulate.contrast_threshold_on=0.4").check_inputs()
    text = str(refusal.value)
    assert text.startswith(f"emulate.contrast_threshold_on: {tmp_path / 'data' / 'events.zarr'} was made with 0.2")
    assert "this run has 0.4" in text
    assert "`dvc repro emulate`" in text
    assert "`python -m stages.emulate emulate.contrast_threshold_on=0.4`" in text


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("emulate.model=v2e", "emulate.model"),
        ("polarizers.extinction_ratio=[5,5,5,5]", "polarizers.extinction_ratio"),
        ("emulate.randomise={cutoff_hz:[30,300]}", "emulate.randomise"),
        ("ingest.dead_leaves=3", "ingest.dead_leaves"),  # two stages before
        ("seed=2", "seed"),
        ("synthesize.duration_s=2.0", "synthesize.duration_s"),
    ],
)
def test_no_value_of_the_simulation_is_ignored_by_a_training(run, override, key):
    make_all(run, *SIMULATION)
    with pytest.raises(ValueError, match=f"^{key}: "):
        run("train", override).check_inputs()


def test_a_row_refuses_a_network_of_other_values_and_files_of_a_user_have_no_origin(run, tmp_path):
    make_all(run, *SIMULATION, "train")
    run("row", "row=ours", "methods.ours.binning=2").check_inputs()
    run("row", "row=cf", "loss.mse=3.0").check_inputs()  # does not read the network
    with pytest.raises(ValueError, match=r"^loss.mse: .*ours was made with 10.0, this run has 3.0; .*dvc repro train"):
        run("row", "row=ours", "loss.mse=3.0").check_inputs()
    make_all(run, *SIMULATION)
    row = run("row", "row=e2v", f"rows.e2v.needs={tmp_path / 'mine.pth'}")
    row.check_inputs()
    assert row.made_inputs(row.stages[0]) == ["data/events.zarr", "data/frames.zarr"]


def test_an_origin_holds_the_values_of_an_artefact_and_its_inputs_and_others_are_stale(run, tmp_path):
    emulate = run("emulate").pipeline["emulate"]
    assert run("emulate").is_stale(emulate)
    make_all(run, *SIMULATION)
    assert not run("train", "loss.mse=2.0").is_stale(emulate)
    assert run("train", "emulate.cutoff_hz=30.0").is_stale(emulate)
    make_all(run, *SIMULATION)
    origin = read_origin(tmp_path / "data" / "events.zarr")
    assert {"ingest", "synthesize", "emulate", "polarizers", "readout", "seed"} <= set(origin.values)
    assert not {"loss", "train", "runtime", "paths"} & set(origin.values)
    assert origin.inputs == {"data/scenes.zarr": digest(tmp_path / "data" / "scenes.zarr")}


@pytest.mark.thorough
def test_an_artefact_in_anothers_place_or_of_another_run_is_refused(run, tmp_path):
    make_all(run, *SIMULATION, "train", "row")
    data = tmp_path / "data"
    run("report").check_inputs()
    rows = data / "benchmark" / "rows"
    shutil.rmtree(rows / "cf")
    shutil.copytree(rows / "highpass", rows / "cf")
    with pytest.raises(ValueError, match=r"rows/cf: expected data/benchmark/rows/cf, got a copy of .*highpass; make"):
        run("report").check_inputs()
    (data / "frames.zarr" / "zarr.json").write_text("of another run")
    with pytest.raises(ValueError, match=r"frames.zarr: its files are not those that `python -m stages.synthesize`"):
        run("train").check_inputs()
    make_all(run, "emulate")
    (data / "scenes.zarr" / "zarr.json").write_text("of another run")
    run("synthesize").write_origins()
    with pytest.raises(ValueError, match=r"events.zarr was made from another \S+scenes.zarr than the one there now"):
        run("train").check_inputs()


def test_an_origin_with_one_other_digit_is_refused(run, tmp_path):
    make_all(run, *SIMULATION)
    file = tmp_path / "data" / "frames.zarr" / ORIGIN
    for content in (file.read_text().replace("0.2", "0.3"), "{", "[]", "[" * 100_000):
        file.write_text(content)
        with pytest.raises(ValueError, match=r"origin.json is not as it was written"):
            run("train").check_inputs()


def test_a_digest_changes_with_a_header_a_name_and_a_size(tmp_path):
    (tmp_path / "a").write_text("1")
    first = digest(tmp_path)
    assert first == digest(tmp_path)
    (tmp_path / "a").write_text("2")
    second = digest(tmp_path)
    (tmp_path / "b").touch()
    assert len({first, second, digest(tmp_path)}) == 3


def scored_rows(rows):
    return Benchmark([], dict.fromkeys(rows, Cost(0.0, None, 0)), [])


@pytest.mark.parametrize(("enabled", "scored"), [("false", ["simulated"]), ("true", ["simulated", "recordings"])])
def test_real_targets_are_a_set_while_they_are_switched_on(project_root, tmp_path, monkeypatch, enabled, scored):
    opened, written = [], {}
    monkeypatch.setattr(pipeline, "pipeline_set", lambda config, name, rows: opened.append(name))
    monkeypatch.setattr(
        pipeline, "run_benchmark", lambda test_set, context, settings, *_: scored_rows(settings.methods)
    )
    monkeypatch.setattr(pipeline, "lpips_of", lambda config: None)
    monkeypatch.setattr(pipeline, "write_row", lambda folder, row, record, sets: written.update({row: list(sets)}))
    config = load(project_root, [f"paths.data={tmp_path}", f"recordings.enabled={enabled}"])
    pipeline.run_rows(config, ["zeros", "cf", "rotating_polarizer"])
    assert opened == scored
    assert written == {"zeros": scored, "cf": scored, "rotating_polarizer": ["simulated"]}  # targets: four channels
    assert pipeline.set_folder(config, "simulated") == tmp_path / "benchmark" / "sets" / "simulated"
    assert pipeline.set_folder(config, "recordings") == tmp_path / "benchmark" / "sets" / "recordings"


def test_a_row_without_weights_is_recorded_without_opening_a_test_set(project_root, tmp_path):
    config = load(project_root, [f"paths.data={tmp_path}"])
    pipeline.run_rows(config, ["e2p"])
    row = tmp_path / "benchmark" / "rows" / "e2p"
    assert {file.name for file in row.iterdir()} == {"row.json", "SHA256SUMS"}
    assert "no weights are given: add the row to section `rows`" in (row / "row.json").read_text()
    with pytest.raises(ValueError, match="expected at least one row that can run, got none"):
        benchmark_tables.collect_rows(load(project_root, [f"paths.data={tmp_path}", "benchmark.methods=[e2p]"]))


def test_a_baseline_is_trained_for_a_row_that_needs_it_and_a_row_takes_the_weights_of_its_entry(project_root, tmp_path):
    assert load(project_root).used_baselines == ["e2v"]
    assert load(project_root, ["rows.e2v.needs=data/external/mine.safetensors"]).used_baselines == []
    assert load(project_root, ["benchmark.methods=[cf,ours]"]).used_baselines == []
    unused = r"no row of benchmark.methods uses the weights of baselines.e2p.*data/train/e2p"
    with pytest.raises(ValueError, match=unused):
        load(project_root, ["baseline=e2p"])
    config = load(project_root, [f"paths.train={tmp_path}", "rows.e2v.needs=data/external/mine.safetensors"])
    assert config.weights_of("ours") == tmp_path / "ours" / "best.safetensors"
    assert config.weights_of("e2v") == Path("data/external/mine.safetensors")
    assert config.weights_of("e2p") is None


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("rows.highpass.settings=methods.cf", "rows.highpass.settings: expected methods.highpass, which the row reads"),
        ("~rows.cf.needs", "rows.cf.needs: expected a value, got none; add the key"),
        ("baselines.trained=[]", "rows.e2v.needs: no stage makes data/train/e2v; add e2v to baselines.trained"),
        ("train.start=outputs/a.safetensors", "train.start: expected a file below data/external/start, whose content"),
    ],
)
def test_a_value_whose_file_or_section_dvc_would_not_follow_is_refused(project_root, change, expected):
    with pytest.raises(ValueError, match=re.escape(expected)):
        load(project_root, [change])
