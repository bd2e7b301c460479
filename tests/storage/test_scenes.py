"""Scenes on disk."""

import math

import pytest
import torch

from polarnet.storage.frames import Contents, Polarization
from polarnet.storage.scenes import SceneStore, as_stored

SCENE_OF = {"coffee-0": "coffee", "coffee-1": "coffee", "leaves-0": "leaves"}
SPLITS = {"coffee-0": "train", "coffee-1": "train", "leaves-0": "test"}


def create(path, splits=SPLITS, sequences_per_part=2, **changes) -> SceneStore:
    contents = Contents(splits, {"seed": 1}, sequences_per_part=sequences_per_part, **changes)
    return SceneStore.create(path, contents, SCENE_OF, (8, 12))


def scene(seed: int, height: int, width: int) -> Polarization:
    s0, dolp, aolp = torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))
    return Polarization(s0, dolp, 3.14 * aolp)


SCENES = {"coffee": scene(1, 20, 30), "leaves": scene(2, 10, 14)}
STILL = {"x": 5.5}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "scenes.zarr"
    store = create(path)
    for i, name in enumerate(store.sequences):
        store.write(name, SCENES[store.scene_of[name]], {"x": math.pi, "y": [i, -1e-300]}, 1_000_000 + i)
    store.finish()
    return path


def test_a_sequence_comes_back_with_its_picture_and_its_exact_trajectory(finished):
    store, (s0, dolp, aolp, _) = SceneStore.open(finished), SCENES["leaves"]
    read = store.read("leaves-0")
    record = store.record("leaves-0")
    assert (store.scene_of["leaves-0"], record["duration_us"]) == ("leaves", 1_000_002)
    assert (store.sensor_height, store.sensor_width) == (8, 12)
    assert (store.of_split("train"), store.attributes) == (["coffee-0", "coffee-1"], {"seed": 1})
    assert all(torch.equal(a, b) for a, b in zip(read[:3], as_stored(SCENES["leaves"])[:3], strict=True))
    assert record["trajectory"] == {"x": math.pi, "y": [2, -1e-300]}
    torch.testing.assert_close(read.s0, s0, atol=0.51 / 65535, rtol=0)
    torch.testing.assert_close(read.dolp, dolp, atol=0.51 / 65535, rtol=0)
    torch.testing.assert_close(read.aolp, aolp, atol=0.51 * math.pi / 65536, rtol=0)


def test_a_picture_and_its_variants_are_never_in_two_splits(tmp_path):
    splits = {"coffee-0": "train", "coffee-1": "test", "leaves-0": "test"}
    with pytest.raises(ValueError, match="picture coffee would be in the splits train and test"):
        create(tmp_path / "scenes.zarr", splits=splits)
    with pytest.raises(ValueError, match="picture coffee would be in the splits train and test"):
        create(tmp_path / "scenes.zarr", variant_of={"leaves-0": "coffee"})


def test_what_cannot_be_a_scene_is_refused(tmp_path):
    store = create(tmp_path / "scenes.zarr")
    with pytest.raises(ValueError, match="leaves-0: expected a picture of at least the sensor's 8x12 px, got 20x11"):
        store.write("leaves-0", scene(1, 20, 11), STILL, 1)
    with pytest.raises(ValueError, match=r"s0: expected values in \[0, 1\]"):
        store.write("leaves-0", Polarization(*(10 * plane for plane in scene(1, 20, 30)[:3])), STILL, 1)
    with pytest.raises(ValueError, match="duration above 0"):
        store.write("leaves-0", SCENES["leaves"], STILL, 0)
    with pytest.raises(ValueError, match="expected a sequence of coffee-0, coffee-1, leaves-0; got 'tea'"):
        store.write("tea", SCENES["leaves"], STILL, 1)


def test_a_mask_comes_back_with_its_picture_and_one_that_has_none_is_valid_everywhere(tmp_path, finished):
    store = create(tmp_path / "scenes.zarr", masked=True)
    valid = torch.rand(10, 14, generator=torch.Generator().manual_seed(1)) < 0.5
    masks = {"coffee": None, "leaves": valid}
    for name, shown in store.scene_of.items():
        store.write(name, SCENES[shown]._replace(valid=masks[shown]), STILL, 1)
    store.finish()
    read = SceneStore.open(tmp_path / "scenes.zarr")
    assert torch.equal(read.read("leaves-0").valid, valid)
    assert read.read("coffee-0").valid.all()
    assert SceneStore.verify(tmp_path / "scenes.zarr") == []
    assert SceneStore.open(finished).read("leaves-0").valid is None
    with pytest.raises(ValueError, match="got a mask for a store without one"):
        create(tmp_path / "others.zarr").write("leaves-0", SCENES["leaves"]._replace(valid=valid), STILL, 1)
