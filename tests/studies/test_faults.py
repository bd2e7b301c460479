"""The campaign of studies.faults at a size of seconds: a careful reader refuses, a careless one is found out."""

import multiprocessing
import os

import numpy as np
import pytest
import torch

from polarnet.events.stream import Events
from polarnet.networks.base.checkpoint import save_checkpoint
from polarnet.pictures.images import write_png
from polarnet.pictures.manifest import Manifest, ManifestEntry, write_manifest
from polarnet.runtime.files import SUMS, seal
from polarnet.storage.events import EventStore
from polarnet.training.engine.recorder import write_history
from studies import faults

FAULTS = 90


def picture(name):
    return ManifestEntry(
        name=name, file=f"{name}.png", split="train", source="folder", origin=name, sha256="0" * 64, bits=8,
        height=8, width=12, source_height=8, source_width=12,
    )  # fmt: skip


@pytest.fixture
def data(tmp_path):
    """A folder like the `paths.data` of a run, with one artefact of three kinds."""
    generator = np.random.default_rng(1)
    images, training = tmp_path / "images", tmp_path / "train" / "ours"
    for folder in (images, training):
        folder.mkdir(parents=True)
    for name in ("one", "two"):
        write_png(images / f"{name}.png", generator.random((8, 12, 3), dtype=np.float32), bits=8)
    write_manifest(Manifest((picture("one"), picture("two")), (), 0, 0), images)
    save_checkpoint(training / "best.safetensors", {"w": torch.rand(99)}, {"network": "x", "config": {}, "val": 0.25})
    write_history(training, [{"epoch": 0, "train": {"total": 0.5}, "val": {"mse": 0.125}}])
    seal(training)
    store = EventStore.create(tmp_path / "events.zarr", ["a", "b"], 8, 12, {"seed": 1})
    for name in ("a", "b"):
        t = torch.from_numpy(np.sort(generator.integers(0, 5000, 50)))
        x, y = (torch.from_numpy(generator.integers(0, side, 50)).short() for side in (12, 8))
        store.write(name, [Events(t, x, y, torch.ones(50, dtype=torch.int8), 8, 12)] * 4, 5000)
    store.finish()
    return tmp_path


def test_no_fault_is_used_silently_and_every_refusal_names_the_file(data):
    counts, bad = faults.inject(data, FAULTS, seed=1)
    assert not bad
    assert set(counts) == {"images", "store", "training"}
    assert sum(sum(of_kind.values()) for of_kind in counts.values()) == FAULTS
    assert sum(of_kind["refused"] for of_kind in counts.values()) > FAULTS / 2


def test_without_checksums_silent_uses_are_counted(data):
    (data / "images" / SUMS).unlink()
    (data / "train" / "ours" / SUMS).unlink()
    counts, bad = faults.inject(data, FAULTS, seed=1)
    silent = sum(of_kind["silent"] for of_kind in counts.values())
    assert silent == sum(line.startswith("silent") for line in bad) > 0


def test_damaged_inputs_are_counted_by_how_they_end():
    endings = faults.endings_of("checkpoints", 40)
    assert endings["read"] + endings["refused"] == 40
    assert min(endings["read"], endings["refused"]) > 0


def end_process(folder):
    def case(generator):
        if generator.integers(5) == 0:
            os._exit(1)

    return case


def test_a_process_that_ends_is_a_crash_and_the_next_case_runs(monkeypatch):
    monkeypatch.setitem(faults.KINDS, "ended", end_process)
    fork = multiprocessing.get_context("fork")  # whose process knows this function
    monkeypatch.setattr(faults.multiprocessing, "get_context", lambda _: fork)
    endings = faults.endings_of("ended", 30)
    assert endings["crash"] > 0
    assert endings["crash"] + endings["read"] == 30
