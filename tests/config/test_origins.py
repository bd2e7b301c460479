"""Values that an artefact was made with, compared with those of the run that reads it."""

import shutil
from pathlib import Path

import pytest

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


def test_a_row_refuses_a_network_that_was_trained_with_other_values(run):
    make_all(run, *SIMULATION, "train")
    run("row", "row=ours", "methods.ours.binning=2").check_inputs()
    run("row", "row=cf", "loss.mse=3.0").check_inputs()  # does not read the network
    with pytest.raises(ValueError, match=r"^loss.mse: .*ours was made with 10.0, this run has 3.0; .*dvc repro train"):
        run("row", "row=ours", "loss.mse=3.0").check_inputs()


def test_files_of_a_user_have_no_origin_and_are_accepted(run, tmp_path):
    make_all(run, *SIMULATION)
    row = run("row", "row=e2v", f"rows.e2v.needs={tmp_path / 'mine.pth'}")
    row.check_inputs()
    assert row.made_inputs(row.stages[0]) == ["data/events.zarr", "data/frames.zarr"]


def test_an_artefact_is_stale_if_it_is_missing_or_of_other_values(run):
    emulate = run("emulate").pipeline["emulate"]
    assert run("emulate").is_stale(emulate)
    make_all(run, *SIMULATION)
    assert not run("train", "loss.mse=2.0").is_stale(emulate)
    assert run("train", "emulate.cutoff_hz=30.0").is_stale(emulate)


def test_the_origin_of_an_artefact_holds_its_own_values_and_those_of_its_inputs(run, tmp_path):
    make_all(run, *SIMULATION)
    origin = read_origin(tmp_path / "data" / "events.zarr")
    assert {"ingest", "synthesize", "emulate", "polarizers", "readout", "seed"} <= set(origin.values)
    assert not {"loss", "train", "runtime", "paths"} & set(origin.values)
    assert origin.inputs == {"data/scenes.zarr": digest([tmp_path / "data" / "scenes.zarr"])}


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
    first = digest([tmp_path])
    assert first == digest([tmp_path])
    (tmp_path / "a").write_text("2")
    second = digest([tmp_path])
    (tmp_path / "b").touch()
    assert len({first, second, digest([tmp_path])}) == 3
