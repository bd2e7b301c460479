"""Scenes on disk."""

import math

import pytest
import torch

from polarnet.storage.scenes import SceneStore, verify_scenes

NAMES = ["centre_x", "centre_y", "speed"]


def create(path, **changes) -> SceneStore:
    arguments = {
        "picture_of": {"coffee-0": "coffee", "coffee-1": "coffee", "leaves-0": "leaves"},
        "splits": {"coffee-0": "train", "coffee-1": "train", "leaves-0": "test"},
        "largest_picture": (20, 30),
        "sensor": (8, 12),
        "trajectory_names": NAMES,
        "attributes": {"seed": 1},
    }
    return SceneStore.create(path, **{**arguments, **changes})


def planes(seed: int, height: int, width: int) -> list[torch.Tensor]:
    s0, dolp, aolp = torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))
    return [s0, dolp, 3.14 * aolp]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "scenes.zarr"
    store = create(path)
    for i, name in enumerate(store.sequences):
        store.write(name, torch.tensor([math.pi, i, -1e-300], dtype=torch.float64), 1_000_000 + i)
    store.write_picture("coffee", *planes(1, 20, 30))
    store.write_picture("leaves", *planes(2, 10, 14))
    store.finish()
    return path


def test_a_sequence_comes_back_with_its_picture_and_its_exact_trajectory(finished):
    scene = SceneStore.open(finished).read("leaves-0")
    s0, dolp, aolp = planes(2, 10, 14)
    assert (scene.name, scene.picture, scene.split, scene.duration_us) == ("leaves-0", "leaves", "test", 1_000_002)
    assert scene.trajectory.tolist() == [math.pi, 2.0, -1e-300]
    torch.testing.assert_close(scene.s0, s0, atol=0.51 / 65535, rtol=0)
    torch.testing.assert_close(scene.dolp, dolp, atol=0.51 / 65535, rtol=0)
    torch.testing.assert_close(scene.aolp, aolp, atol=0.51 * math.pi / 65536, rtol=0)


def test_sequences_of_one_picture_share_its_planes(finished):
    store = SceneStore.open(finished)
    first, second = store.read("coffee-0"), store.read("coffee-1")
    assert torch.equal(first.s0, second.s0)
    assert first.trajectory[1] != second.trajectory[1]
    assert len([file for file in (finished / "s0" / "c").rglob("*") if file.is_file()]) == 2


def test_what_is_stored_is_stored_again_without_a_change(finished, tmp_path):
    store, again = SceneStore.open(finished), create(tmp_path / "scenes.zarr")
    for name in store.sequences:
        scene = store.read(name)
        again.write(name, scene.trajectory, scene.duration_us)
        again.write_picture(scene.picture, scene.s0, scene.dolp, scene.aolp)
    again.finish()
    for file in finished.rglob("*"):
        if file.is_file():
            assert (tmp_path / "scenes.zarr" / file.relative_to(finished)).read_bytes() == file.read_bytes()


def test_the_store_says_what_it_holds(finished):
    store = SceneStore.open(finished)
    assert store.sequences == ["coffee-0", "coffee-1", "leaves-0"]
    assert store.pictures == ["coffee", "leaves"]
    assert (store.sensor_height, store.sensor_width) == (8, 12)
    assert store.trajectory_names == NAMES
    assert store.of_split("train") == ["coffee-0", "coffee-1"]
    assert store.attributes == {"seed": 1}


def test_a_store_lacks_pictures_and_sequences_until_both_are_written(tmp_path):
    store = create(tmp_path / "scenes.zarr")
    store.write_picture("coffee", *planes(1, 20, 30))
    store.write("coffee-1", torch.zeros(3, dtype=torch.float64), 1)
    again = create(tmp_path / "scenes.zarr")
    assert again.missing() == ["coffee-0", "leaves-0"]
    assert again.missing_pictures() == ["leaves"]
    with pytest.raises(ValueError, match="3 not written yet: coffee-0, leaves-0, leaves"):
        again.finish()


def test_a_picture_never_is_in_two_splits(tmp_path):
    splits = {"coffee-0": "train", "coffee-1": "test", "leaves-0": "test"}
    with pytest.raises(ValueError, match="picture coffee would be in the splits train and test"):
        create(tmp_path / "scenes.zarr", splits=splits)


def test_what_cannot_be_a_scene_is_refused(tmp_path):
    store = create(tmp_path / "scenes.zarr")
    with pytest.raises(ValueError, match=r"leaves: expected a picture between .* 8x12 px and 20x30 px, got 20x11"):
        store.write_picture("leaves", *planes(1, 20, 11))
    with pytest.raises(ValueError, match=r"s0: expected values in \[0, 1\]"):
        store.write_picture("leaves", *(10 * plane for plane in planes(1, 20, 30)))
    with pytest.raises(ValueError, match=r"expected 3 finite numbers \(centre_x, centre_y, speed\)"):
        store.write("leaves-0", torch.tensor([0.0, math.nan, 0.0], dtype=torch.float64), 1000)
    with pytest.raises(ValueError, match="duration above 0"):
        store.write("leaves-0", torch.zeros(3, dtype=torch.float64), 0)
    with pytest.raises(ValueError, match="there is no 'tea'"):
        store.write_picture("tea", *planes(1, 20, 30))


def test_a_flipped_byte_is_found_and_named(finished):
    assert verify_scenes(finished) == []
    chunk = finished / "dolp" / "c" / "1" / "0" / "0"
    content = chunk.read_bytes()
    try:
        chunk.write_bytes(content[:50] + bytes([content[50] ^ 1]) + content[51:])
        (problem,) = verify_scenes(finished)
        assert "leaves, column dolp is unreadable" in problem
    finally:
        chunk.write_bytes(content)


def test_a_mask_comes_back_with_its_picture_and_one_that_has_none_is_valid_everywhere(tmp_path):
    store = create(tmp_path / "scenes.zarr", masked=True)
    for name in store.sequences:
        store.write(name, torch.zeros(3, dtype=torch.float64), 1)
    valid = torch.rand(10, 14, generator=torch.Generator().manual_seed(1)) < 0.5
    store.write_picture("coffee", *planes(1, 20, 30))
    store.write_picture("leaves", *planes(2, 10, 14), valid)
    store.finish()
    read = SceneStore.open(tmp_path / "scenes.zarr")
    assert torch.equal(read.read("leaves-0").valid, valid)
    assert read.read("coffee-0").valid.all()
    assert verify_scenes(tmp_path / "scenes.zarr") == []


def test_without_masks_nothing_is_stored_about_them(finished, tmp_path):
    assert SceneStore.open(finished).read("leaves-0").valid is None
    assert not (finished / "valid").exists()
    with pytest.raises(ValueError, match=r"a store created with masked=True, got one of .*masked=False"):
        create(tmp_path / "scenes.zarr").write_picture("leaves", *planes(2, 10, 14), torch.ones(10, 14).bool())
