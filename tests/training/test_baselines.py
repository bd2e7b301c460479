import dataclasses
from pathlib import Path

from polarnet.config.tree import load
from polarnet.methods import METHODS
from polarnet.training.baselines import BASELINES
from stages import train

ROOT = Path(__file__).resolve().parents[2]


def test_every_baseline_is_trained_for_a_method_and_every_trained_method_has_a_baseline():
    trainings = {method.weights.trained_by for method in METHODS.values() if method.weights is not None}
    assert trainings - {None, "ours"} == set(BASELINES)


def test_a_record_names_the_lpips_weights_among_its_settings():
    for baseline in BASELINES.values():
        assert set(baseline.lpips) <= set(baseline.config.__dataclass_fields__)


def test_a_baseline_whose_loss_has_no_lpips_is_trained_without_lpips_weights(monkeypatch):
    loads_nothing = dataclasses.replace(BASELINES["e2v"], lpips=(), task=lambda settings, lpips, seed: lpips)
    monkeypatch.setitem(BASELINES, "e2v", loads_nothing)
    _, lpips = train._task(load(ROOT, ["baseline=e2v", "paths.weights=nowhere"]))
    assert lpips is None
