from dataclasses import replace

import numpy as np
import pytest

from polarnet.config.tree import load
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.pictures.images import write_png
from polarnet.runtime.files import SUMS
from polarnet.runtime.machine import generator_for
from polarnet.simulation.sets import MADE, Recipe, kind_of, make_folder_set
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore

SMALL = [
    "ingest.height=100", "ingest.width=150", "synthesize.duration_s=0.1", "synthesize.sensor_height=60",
    "synthesize.sensor_width=90", "synthesize.speed_min_px_s=10.0", "synthesize.speed_max_px_s=20.0",
]  # fmt: skip


@pytest.fixture
def recipe(project_root):
    config = load(project_root, SMALL)
    return Recipe(config.ingest, config.synthesize, config.camera, config.seed, threads=1, sequences_per_part=2)


@pytest.fixture
def photographs(tmp_path):
    deeper = tmp_path / "photographs" / "deeper"
    deeper.mkdir(parents=True)
    for name in ("a", "b"):
        write_png(deeper / f"{name}.png", dead_leaves(generator_for(1, name, "picture"), 100, 150), bits=8)
    return deeper.parent


def plain(label):
    return map


def test_a_set_has_every_picture_for_testing_and_is_made_again_only_when_its_recipe_or_pictures_change(
    photographs, tmp_path, recipe
):
    def make(recipe: Recipe) -> bool:
        return make_folder_set(photographs, "auto", tmp_path / "set", recipe, plain)

    assert make(recipe)
    folder = tmp_path / "set"
    frames, events = FrameStore.open(folder / "frames.zarr"), EventStore.open(folder / "events.zarr")
    assert len(frames.of_split("test")) == 2
    assert frames.of_split("test") == events.sequences
    assert all(sum(events.count(name)) > 100 for name in events.sequences)
    assert not make(recipe)
    turning = replace(recipe, motion=replace(recipe.motion, rotation_max_deg=10.0))
    assert make(turning)
    write_png(photographs / "deeper" / "a.png", np.full((100, 150, 3), 0.5, dtype=np.float32), bits=8)
    assert make(turning)


def test_a_set_that_was_interrupted_goes_on(photographs, tmp_path, recipe):
    folder = tmp_path / "set"
    make_folder_set(photographs, "auto", folder, recipe, plain)
    (folder / SUMS).unlink()
    before = (folder / "frames.zarr" / "zarr.json").stat().st_mtime_ns
    assert make_folder_set(photographs, "auto", folder, recipe, plain)
    assert (folder / "frames.zarr" / "zarr.json").stat().st_mtime_ns == before


@pytest.mark.thorough
@pytest.mark.parametrize("pattern", ["images/*.png", "frames.zarr/part-00000/dolp/c/0/0/0", MADE])
def test_a_set_with_a_damaged_file_is_made_again(photographs, tmp_path, recipe, caplog, pattern):
    folder = tmp_path / "set"
    make_folder_set(photographs, "auto", folder, recipe, plain)
    file = next(folder.glob(pattern))
    whole = file.read_bytes()
    file.write_bytes(whole[:20] + bytes([whole[20] ^ 1]) + whole[21:])
    assert make_folder_set(photographs, "auto", folder, recipe, plain)
    assert file.read_bytes() == whole
    assert f"{file} is not the file that" in caplog.text


@pytest.mark.parametrize(
    ("names", "kind"),
    [
        ([f"frame_{k:04d}" for k in range(140)], "photographs"),
        ([f"frame_{k}" for k in range(0, 140, 5)], "photographs"),
        (["cup_0", "vase_0", "lamp_45"], "photographs"),
        (["cup_0", "cup_45", "cup_90", "cup_135", "view"], "photographs"),
        (["cup.npz"], "polarization"),
        (["cup_000", "cup_045", "cup_090", "cup_135"], "polarization"),
        (["cup_0", "cup_45", "cup_90"], "polarization"),  # ingest names the missing file
    ],
)
def test_numbers_in_names_are_angles_only_if_all_files_are_measurements(tmp_path, names, kind):
    for name in names:
        (tmp_path / (name if "." in name else f"{name}.png")).touch()
    assert kind_of(tmp_path) == kind
