"""params.yaml and conf/: what is accepted, what is refused, and with which words."""

import dataclasses
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.errors import ConfigCompositionException

from polarnet.config import Config, check_keys, load
from polarnet.experiments import BASE, experiment_names, experiment_values, write_preset


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


def test_the_committed_values_pass(project_root):
    config = load(project_root)
    assert isinstance(config, Config)
    assert dataclasses.is_dataclass(config.emulate)
    assert config.emulate.model == "exact"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("emulate.contrast_threshold_on=-0.2", r"emulate\.contrast_threshold_on: expected >= 0\.01"),
        ("train.epochs=0", r"train\.epochs: expected"),
        ("baselines.cf.cutoff_hz=-1.0", r"baselines\.cf\.cutoff_hz: expected"),
        ("ingest.source=camera", r"ingest\.source: expected one of"),
        ("network=resnet", r"network: expected one of paper"),
        ("lpips.backbone=resnet", r"lpips\.backbone: expected one of"),
        ("train.crop=[240,90]", r"train\.crop: expected at most the window of section synthesize, \[120, 180\]"),
    ],
)
def test_a_value_out_of_range_is_refused_with_its_key_and_what_is_allowed(project_root, override, message):
    with pytest.raises(ValueError, match=message):
        load(project_root, [override])


def test_a_wrong_type_is_refused_with_its_key(project_root):
    with pytest.raises(ConfigCompositionException) as refusal:
        load(project_root, ["train.epochs=many"])
    assert "could not be converted to Integer" in str(refusal.value.__cause__)
    assert "train.epochs" in str(refusal.value.__cause__)


def test_a_typo_on_the_command_line_is_refused_with_the_keys_there_are(project_root):
    with pytest.raises(ValueError, match=r"loss\.msee is not a setting; loss has lpips, mse, ssim"):
        check_keys(project_root, ["loss.msee=1.0"])
    with pytest.raises(ValueError, match=r"seed\.x is not a setting; seed is a value, not a section"):
        check_keys(project_root, ["seed.x=1"])


def test_a_typo_in_params_yaml_is_refused_with_the_keys_there_are(project):
    edit(project, "  mse: 10.0\n  ssim: 1.0", "  mse: 10.0\n  sim: 1.0")
    with pytest.raises(ValueError, match=r"params.yaml: loss\.sim is not a setting; loss has lpips, mse, ssim"):
        check_keys(project, [])


def test_a_stage_stops_before_it_runs_anything(project_root, tmp_path):
    command = [sys.executable, "-m", "stages.synthesize", "synthesize.duration_s=-1.0", f"paths.data={tmp_path}"]
    done = subprocess.run(command, cwd=project_root, capture_output=True, text=True)
    assert done.returncode == 1
    assert "configuration error: synthesize.duration_s: expected > 0" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_every_experiment_composes(project_root, monkeypatch):
    for name in experiment_names(project_root):
        config = load(project_root, [f"experiment={name}"])
        for key, value in experiment_values(project_root, name).items():
            node = config
            for part in key.split("."):
                node = getattr(node, part)
            assert node == value, f"experiment {name}: {key}"


def test_the_paper_experiment_holds_the_papers_values(project_root):
    config = load(project_root, ["experiment=paper"])
    assert (config.ingest.height, config.ingest.width) == (400, 600)
    assert (config.synthesize.window_height, config.synthesize.window_width) == (120, 180)
    assert (config.synthesize.duration_s, config.synthesize.frame_rate_hz) == (1.0, 30.0)
    assert (config.emulate.contrast_threshold_on, config.emulate.contrast_threshold_off) == (0.2, 0.2)
    assert config.emulate.model == "v2e"  # "we use V2E in our experiments", section 3.1
    assert (config.train.learning_rate, config.train.batch_size, config.train.epochs) == (1e-4, 2, 250)
    assert (config.loss.mse, config.loss.ssim, config.loss.lpips) == (1.0, 1.0, 10.0)
    assert (config.lpips.backbone, config.lpips.required) == ("vgg", True)


def test_the_paper_experiment_refuses_to_start_without_vgg_weights(project_root, tmp_path):
    command = [sys.executable, "-m", "stages.ingest", "experiment=paper", f"paths.data={tmp_path / 'data'}"]
    done = subprocess.run(
        command, cwd=project_root, capture_output=True, text=True, env={"PATH": "", "TORCH_HOME": str(tmp_path)}
    )
    assert done.returncode == 1
    assert "lpips.required is true" in done.stderr
    assert "vgg16-397923af.pth" in done.stderr
    assert not (tmp_path / "data").exists()


def test_the_base_experiment_is_what_params_yaml_holds_and_covers_what_others_change(project_root, project):
    assert write_preset(project, BASE) == []
    base = set(experiment_values(project_root, BASE))
    for name in experiment_names(project_root):
        assert set(experiment_values(project_root, name)) <= base, name


def test_a_preset_keeps_comments_and_unrelated_values_and_the_base_undoes_it(project):
    original = (project / "params.yaml").read_text()
    edit(project, "seed: 1 ", "seed: 7 ")
    changed = write_preset(project, "smoke")
    text = (project / "params.yaml").read_text()
    assert changed
    assert "seed: 7 " in text
    assert text.count("#") == original.count("#")
    assert load(project).seed == 7
    write_preset(project, BASE)
    assert (project / "params.yaml").read_text() == original.replace("seed: 1 ", "seed: 7 ")


def test_an_unknown_preset_lists_the_ones_there_are(project):
    with pytest.raises(ValueError, match="no experiment 'papper'; there are demo, paper, smoke"):
        write_preset(project, "papper")
