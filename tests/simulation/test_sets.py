import numpy as np
import pytest

from polarnet.config.tree import load
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.pictures.images import write_png
from polarnet.pictures.manifest import Manifest, ManifestEntry, write_manifest
from polarnet.runtime.files import SUMS, seal
from polarnet.runtime.machine import generator_for
from polarnet.simulation.motion import Trajectory
from polarnet.simulation.sets import MADE, Recipe, SetsConfig, kind_of, make_complex_motion, make_folder_set
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.scenes import SceneStore

SMALL = [
    "ingest.height=100", "ingest.width=150", "synthesize.duration_s=0.1", "synthesize.sensor_height=60",
    "synthesize.sensor_width=90", "synthesize.speed_min_px_s=10.0", "synthesize.speed_max_px_s=20.0",
]  # fmt: skip


@pytest.fixture
def recipe(project_root):
    config = load(project_root, SMALL)
    return Recipe(config.ingest, config.synthesize, config.camera, config.seed, threads=1, sequences_per_part=2)


@pytest.fixture
def images(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    entries = []
    for name, split in (("seen", "train"), ("held-out", "test")):
        write_png(folder / f"{name}.png", dead_leaves(generator_for(1, name, "picture"), 100, 150), bits=8)
        size = {"height": 100, "width": 150, "source_height": 100, "source_width": 150}
        origin = {"source": "folder", "origin": name, "sha256": "0" * 64}
        entries.append(ManifestEntry(name=name, file=f"{name}.png", split=split, bits=8, **origin, **size))
    write_manifest(Manifest(tuple(entries), (), 0, 0), folder)
    return folder


def plain(label):
    return map


def harder(**changes):
    values = {"rotation_max_deg": 30.0, "zoom_max": 1.2, "speed_min_px_s": 40.0, "speed_max_px_s": 60.0}
    return SetsConfig(**{"measured_root": "nowhere", **values, "acceleration_max_px_s2": 2000.0, **changes})


def test_complex_motion_shows_held_out_pictures_alone_turning_and_zooming(images, tmp_path, recipe):
    folder = tmp_path / "complex_motion"
    assert make_complex_motion(images, folder, harder(), recipe, plain)
    frames, events = FrameStore.open(folder / "frames.zarr"), EventStore.open(folder / "events.zarr")
    assert frames.of_split("test") == events.sequences == ["held-out-00"]
    scenes = SceneStore.open(folder / "scenes.zarr")
    trajectory = Trajectory.from_vector(scenes.trajectory("held-out-00"))
    assert trajectory.roll.amplitude > 0
    assert trajectory.zoom.amplitude > 0
    assert 40 <= trajectory.speed_px_s <= 60
    assert sum(events.count("held-out-00")) > 100


def test_a_set_is_made_once_and_again_only_when_its_recipe_changes(images, tmp_path, recipe):
    folder = tmp_path / "complex_motion"
    assert make_complex_motion(images, folder, harder(), recipe, plain)
    assert not make_complex_motion(images, folder, harder(), recipe, plain)
    assert make_complex_motion(images, folder, harder(zoom_max=1.1), recipe, plain)
    write_png(images / "held-out.png", np.full((100, 150, 3), 0.5, dtype=np.float32), bits=8)
    seal(images)
    assert make_complex_motion(images, folder, harder(zoom_max=1.1), recipe, plain)


def test_a_set_that_was_interrupted_goes_on(images, tmp_path, recipe):
    folder = tmp_path / "complex_motion"
    make_complex_motion(images, folder, harder(), recipe, plain)
    (folder / SUMS).unlink()
    before = (folder / "frames.zarr" / "zarr.json").stat().st_mtime_ns
    assert make_complex_motion(images, folder, harder(), recipe, plain)
    assert (folder / "frames.zarr" / "zarr.json").stat().st_mtime_ns == before


@pytest.mark.parametrize("file", ["images/held-out.png", "frames.zarr/part-00000/dolp/c/0/0/0", MADE])
def test_a_set_with_a_damaged_file_is_made_again(images, tmp_path, recipe, caplog, file):
    folder = tmp_path / "complex_motion"
    make_complex_motion(images, folder, harder(), recipe, plain)
    whole = (folder / file).read_bytes()
    (folder / file).write_bytes(whole[:20] + bytes([whole[20] ^ 1]) + whole[21:])
    assert make_complex_motion(images, folder, harder(), recipe, plain)
    assert (folder / file).read_bytes() == whole
    assert file == MADE or f"{folder / file} is not the file that" in caplog.text


def test_every_picture_of_a_folder_is_for_testing(tmp_path, recipe):
    photographs = tmp_path / "photographs" / "deeper"
    photographs.mkdir(parents=True)
    for name in ("a", "b", "c"):
        write_png(photographs / f"{name}.png", dead_leaves(generator_for(1, name, "picture"), 100, 150), bits=8)
    assert make_folder_set(tmp_path / "photographs", "auto", tmp_path / "set", recipe, plain)
    assert len(FrameStore.open(tmp_path / "set" / "frames.zarr").of_split("test")) == 3


@pytest.mark.parametrize(
    ("names", "kind"),
    [
        ([f"frame_{k:04d}" for k in range(140)], "photographs"),
        ([f"frame_{k:03d}" for k in range(140)], "photographs"),
        ([f"frame_{k}" for k in range(0, 140, 5)], "photographs"),
        (["cup_0", "vase_0", "lamp_45"], "photographs"),
        (["cup_0", "cup_45", "cup_90", "cup_135", "view"], "photographs"),
        (["view"], "photographs"),
        (["cup.npz"], "polarization"),
        (["cup_000", "cup_045", "cup_090", "cup_135"], "polarization"),
        (["cup_0", "cup_45", "cup_90"], "polarization"),  # ingest names the missing file
    ],
)
def test_numbers_in_names_are_angles_only_if_all_files_are_measurements(tmp_path, names, kind):
    for name in names:
        (tmp_path / (name if "." in name else f"{name}.png")).touch()
    assert kind_of(tmp_path) == kind
