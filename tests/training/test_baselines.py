import dataclasses
from pathlib import Path

from polarnet.config.tree import load
from polarnet.training.baselines import BASELINES
from stages import train

ROOT = Path(__file__).resolve().parents[2]


def test_a_record_names_the_lpips_weights_among_its_settings():
    for baseline in BASELINES.values():
        assert set(baseline.lpips) <= set(baseline.config.__dataclass_fields__)


def test_a_baseline_whose_loss_has_no_lpips_is_trained_without_lpips_weights(monkeypatch):
    loads_nothing = dataclasses.replace(BASELINES["e2v"], lpips=(), task=lambda settings, lpips, seed: lpips)
    monkeypatch.setattr("polarnet.training.e2v.BASELINE", loads_nothing)
    _, lpips = train._task(load(ROOT, ["baseline=e2v"]))
    assert lpips is None
