import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import pytest
import torch
from part_fixtures import files_of
from test_loop import CPU, LOOP, SEED, killed, run

from polarnet.config.tree import load
from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.networks.polarnet.expected_error import UNFITTED
from polarnet.networks.registry import load_network
from polarnet.storage import Contents, EventStore, FrameStore
from polarnet.training.dolp import dolp_task
from polarnet.training.engine.calibration import RIDGES, Scene, fitted, weights_for
from polarnet.training.engine.loop import TrainConfig, calibrate, sequences_to_fit
from polarnet.training.engine.losses import LossConfig
from polarnet.training.engine.sequences import WindowDataset
from polarnet.training.engine.task import open_split

TRAIN = TrainConfig(**LOOP, representation=None, optimizer=None, start=None, scene_dolp=None)
LOSS = LossConfig(mse=1.0, ssim=0.0, lpips=0.0, stokes=1.0, half_weight=None)


@pytest.fixture(scope="module")
def task_of(project_root):
    """A new task of a small polarnet, from a checkpoint if one is given."""
    parameters = load(project_root).networks.polarnet
    left_out = ["shot_noise"]  # tested by itself
    config = dataclasses.replace(parameters, channels=[4, 4, 4], reach=3, scales=[1, 0], without=left_out)
    return lambda start=None: dolp_task("polarnet", config, dataclasses.replace(TRAIN, start=start), LOSS, None, SEED)


def scenes_of(in_all: float, in_each: float) -> list[Scene]:
    """Scenes whose errors depend on one feature by `in_all` and on another by `in_each`.

    In two fifths of the scenes, the second dependence is reversed. A third feature is noise, a fourth constant.
    """
    generator, scenes = torch.Generator().manual_seed(0), []
    for k in range(20):
        features = torch.randn(5000, 4, generator=generator, dtype=torch.float64) * torch.tensor([0.01, 5, 1, 0])
        noise = torch.randn(5000, generator=generator, dtype=torch.float64)
        expected = 100 * in_all * features[:, 0] + (-1) ** (k % 5) * in_each * features[:, 2] - 4
        squared = expected.exp() * noise.square()
        scenes.append(Scene(features, squared, torch.ones_like(squared)))
    return scenes


def test_what_tells_how_large_errors_are_is_found_however_small_it_is():
    fit = fitted(scenes_of(in_all=1.0, in_each=0.0))
    assert fit.ridge == min(RIDGES)
    assert fit.weight[0].item() == pytest.approx(100, rel=0.05)
    assert fit.weight[1:].abs().max() < 2e-2
    assert fit.bias == pytest.approx(-4, abs=0.05)


@pytest.mark.parametrize("scenes", [scenes_of(in_all=0.0, in_each=0.5), scenes_of(in_all=1.0, in_each=0.0)[:1]])
def test_what_tells_it_of_each_scene_alone_or_of_a_single_scene_is_not_believed(scenes):
    fit = fitted(scenes)
    assert fit.ridge == max(RIDGES)
    for scene in scenes:
        expected = (scene.features @ fit.weight + fit.bias).exp()
        assert expected.std() < 0.02 * expected.mean()
    if len(scenes) == 1:
        assert expected.mean().item() == pytest.approx(scene.squared.mean().item(), rel=0.01)


def test_without_any_error_there_is_nothing_to_expect_and_the_errors_of_heavy_scenes_decide():
    scenes = [scene._replace(squared=0 * scene.squared) for scene in scenes_of(in_all=1.0, in_each=0.0)]
    with pytest.raises(ValueError, match="got 100000 pixels without any"):
        fitted(scenes)
    first, large = (s._replace(features=0 * s.features) for s in scenes_of(in_all=0.0, in_each=0.0)[:2])
    small = first._replace(squared=0.01 * first.squared)
    light = large._replace(weights=1e-6 * large.weights)
    for scenes, expected in (((small, large), large.squared.mean() / 2), ((small, light), small.squared.mean())):
        fit = fitted(scenes)
        errors = torch.cat([(scene.features @ fit.weight + fit.bias).exp() for scene in scenes])
        assert errors.mean().item() == pytest.approx(expected.item(), rel=0.05)


def test_weighted_sequences_are_polarized_like_the_scenes_that_errors_are_expected_for():
    degree = torch.rand(2000, generator=torch.Generator().manual_seed(0)).tolist()
    weights = weights_for(degree, 0.045, 0.13)
    assert sum(weights) == pytest.approx(len(degree))

    def share_below(limit: float) -> float:
        return sum(weight for weight, one in zip(weights, degree, strict=True) if one < limit) / len(degree)

    assert share_below(0.045) == pytest.approx(0.5, abs=0.02)
    assert share_below(0.13) == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize("precision", ["fp32", pytest.param("bf16", marks=pytest.mark.thorough)])
def test_errors_are_expected_where_they_are_and_dolp_is_what_it_was(stores, task_of, precision):
    task, config = task_of(), dataclasses.replace(TRAIN, precision=precision)
    torch.nn.init.normal_(task.network.add.weight, std=0.1, generator=torch.Generator().manual_seed(1))
    split = open_split(EventStore.open(stores[0]), str(stores[1]), task.encode)

    def recovered():
        with torch.no_grad():
            return [task.network.unroll(sequence.inputs[:, None], None)[0] for sequence in split.train]

    before = recovered()
    mean_squared = calibrate(task, split.train, config, CPU, 0)["mse"]
    after = recovered()
    for name in ("dolp", "aolp", "stokes"):
        for new, old in zip(after, before, strict=True):
            torch.testing.assert_close(getattr(new, name), getattr(old, name))
    truth = torch.stack([sequence.dolp for sequence in split.train])
    errors = (torch.stack([one.dolp[:, 0] for one in after]).clamp(0, 1) - truth).square()
    fitted = torch.stack([one.log_variance[:, 0] for one in after])
    alike, untrained = torch.full_like(errors, mean_squared).log(), torch.stack([b.log_variance[:, 0] for b in before])
    likelihood = [(errors * torch.exp(-v) + v).mean() for v in (untrained, alike, fitted)]
    assert likelihood[2] < likelihood[1] < likelihood[0]
    assert fitted.exp().mean().item() == pytest.approx(errors.mean().item(), rel=0.3)


def rewritten(frames: Path, path: Path, dolp_factors: Mapping[str, float], variant_of: Mapping[str, str]) -> FrameStore:
    """A copy of a frame store, with DoLP multiplied by the factor of its sequence, and with variants."""
    source = FrameStore.open(frames)
    copy = FrameStore.create(path, Contents(source.splits, variant_of=variant_of), source.height, source.width)
    for name in source.sequences:
        t_us, intensity, dolp, aolp, *valid = source.frames(name)
        copy.write(name, t_us, intensity, dolp_factors.get(name, 1.0) * dolp, aolp, *valid)
    copy.finish()
    return FrameStore.open(path)


@pytest.mark.parametrize(("scene_dolp", "sequences"), [(None, 2), ([0.045, 0.13], 3)])
def test_it_rests_on_variants_only_if_the_scenes_it_is_for_are_named(stores, tmp_path, task_of, scene_dolp, sequences):
    frames = rewritten(stores[1], tmp_path / "frames.zarr", {}, {"b": "a"})
    task = dataclasses.replace(task_of(), scene_dolp=scene_dolp)
    train = WindowDataset(EventStore.open(stores[0]), frames, frames.of_split("train"), task.encode)
    assert calibrate(task, sequences_to_fit(task, train), TRAIN, CPU, 0)["sequences"] == sequences


def test_a_training_shows_its_progress_and_another_starts_from_its_weights_but_not_from_its_expected_errors(
    stores, tmp_path, task_of, progress_log
):
    run(task_of(), stores, tmp_path / "run", TRAIN)
    lines = progress_log()
    for start in ("epoch 1/2", "epoch 2/2", "validation", "expected errors"):
        shown = [line for line in lines if line.startswith(f"{start}: 100%")]
        assert shown, lines
        assert all(("loss=" in line) == start.startswith("epoch") for line in shown)
    start = tmp_path / "run" / "out" / "best.safetensors"
    tensors, _ = load_checkpoint(start)
    begun = task_of(str(start)).network.state_dict()
    assert tensors["expected.weight"].any()
    assert not begun["expected.weight"].any()
    assert begun["expected.bias"] == UNFITTED
    others = [name for name in begun if not name.startswith("expected.")]
    assert all(torch.equal(begun[name], tensors[name]) for name in others)


@pytest.mark.thorough
def test_a_training_ends_with_it_even_if_killed_before(stores, tmp_path, task_of):
    whole = files_of(run(task_of(), stores, tmp_path / "whole", TRAIN))
    killed(task_of(), 16, stores, tmp_path / "killed", TRAIN)
    assert files_of(run(task_of(), stores, tmp_path / "killed", TRAIN)) == whole
    said = json.loads(whole["best.json"])["expected_errors"]
    assert said["sequences"] == 3
    assert said["mse"] > 0
    _, metadata = load_network(tmp_path / "whole" / "out" / "best.safetensors")
    assert metadata["expected_errors"] == said
    assert "expected_errors" not in json.loads(whole["last.json"])
