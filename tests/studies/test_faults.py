"""The campaign of studies.faults at a size of seconds: a careful reader refuses, a careless one is found out."""

import shutil

import numpy as np
import pytest
import torch

from polarnet.networks.base.checkpoint import save_checkpoint
from polarnet.pictures.images import write_png
from polarnet.pictures.manifest import Manifest, ManifestEntry, write_manifest
from polarnet.runtime.files import seal
from polarnet.training.engine.recorder import write_history
from studies import faults

FAULTS = 45


def picture(name):
    return ManifestEntry(
        name=name, file=f"{name}.png", split="train", source="folder", origin=name, sha256="0" * 64,
        height=8, width=12,
    )  # fmt: skip


@pytest.fixture
def run(project_root, tmp_path):
    """A project with a finished run: one artefact of three kinds."""
    shutil.copytree(project_root / "conf", tmp_path / "conf")
    for name in ("params.yaml", "dvc.yaml"):
        shutil.copy(project_root / name, tmp_path)
    data = tmp_path / "data"
    generator = np.random.default_rng(1)
    images, training = data / "images", data / "train" / "ours"
    for folder in (images, training):
        folder.mkdir(parents=True)
    for name in ("one", "two"):
        write_png(images / f"{name}.png", generator.random((8, 12, 3), dtype=np.float32), bits=8)
    write_manifest(Manifest((picture("one"), picture("two")), (), 0, 0), images)
    save_checkpoint(training / "best.safetensors", {"w": torch.rand(99)}, {"network": "x", "config": {}, "val": 0.25})
    write_history(training, [{"epoch": 0, "train": {"total": 0.5}, "val": {"mse": 0.125}}])
    seal(training)
    faults.write_store(data / "events.zarr", "1", ["a", "b"])
    return tmp_path


@pytest.mark.thorough
def test_no_fault_is_used_silently_and_every_refusal_names_the_file(run):
    counts, bad = faults.inject([run], FAULTS, seed=1)
    bad = [line for line in bad if ": sealed again of" not in line]  # which only the origin of a stage reveals
    assert not bad
    assert {name.rpartition(" ")[2] for name in counts} == {"images", "store", "training"}
    assert sum(sum(of_kind.values()) for of_kind in counts.values()) == FAULTS
    assert sum(of_kind["refused"] for of_kind in counts.values()) > FAULTS / 2


@pytest.mark.thorough
def test_without_checks_silent_uses_are_counted(run, monkeypatch):
    for module in ("polarnet.pictures.manifest", "polarnet.training.engine.recorder"):
        monkeypatch.setattr(f"{module}.check_seal", lambda *_: None)
    counts, bad = faults.inject([run], FAULTS, seed=1)
    silent = sum(of_kind["silent"] for of_kind in counts.values())
    assert silent == sum(line.startswith("silent") for line in bad) > 0


@pytest.mark.thorough
def test_killed_writers_leave_the_old_or_the_new_result():
    assert faults.kills(3) == {"kill of a store": {"whole": 3, "lost": 0, "stuck": 0}}
