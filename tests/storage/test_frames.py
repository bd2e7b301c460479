"""Ground-truth frames on disk."""

import math

import numpy as np
import pytest
import torch

from polarnet.storage.frames import Contents, FrameStore, dequantise, quantise

STEPS = np.arange(2**16, dtype=np.uint16)
HEIGHT, WIDTH, FRAMES = 4, 6, 40


def frames_of(seed: int, n: int = FRAMES) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)
    shapes = [(n, 4, HEIGHT, WIDTH), (n, HEIGHT, WIDTH), (n, HEIGHT, WIDTH)]
    intensity, dolp, aolp = (torch.rand(shape, generator=generator) for shape in shapes)
    return 33_333 * torch.arange(n), intensity, dolp, aolp * 3.14


def store_at(path, names=("a", "b"), **changes) -> FrameStore:
    splits = {"a": "train", "b": "test"}
    contents = Contents({name: splits[name] for name in names}, {"seed": 1}, sequences_per_part=2, **changes)
    return FrameStore.create(path, contents, HEIGHT, WIDTH)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    path = tmp_path_factory.mktemp("frames") / "frames.zarr"
    store = store_at(path)
    store.write("a", *frames_of(1))
    store.write("b", *frames_of(2, n=33))
    store.finish()
    return path


@pytest.mark.parametrize("name", ["dolp", "aolp"])
def test_every_stored_value_comes_back_as_itself(name):
    assert np.array_equal(quantise(name, dequantise(name, STEPS)), STEPS)


def test_the_ends_of_the_range_are_exact_and_a_degree_is_no_radian():
    assert dequantise("s0", quantise("s0", torch.tensor([0.0, 1.0]))).tolist() == [0.0, 1.0]
    angles = torch.tensor([0.0, math.pi / 2, math.pi - 1e-6])  # the last one rounds up to pi
    assert dequantise("aolp", quantise("aolp", angles)).tolist() == pytest.approx([0, math.pi / 2, 0])
    assert float(dequantise("aolp", STEPS).max()) < math.pi
    with pytest.raises(ValueError, match=r"radians in \[0, 3\.14159\], got values up to 90; .* torch\.deg2rad"):
        quantise("aolp", torch.tensor([90.0]))


@pytest.mark.parametrize("bad", [-0.01, 1.01, math.nan, math.inf])
def test_a_fraction_out_of_range_is_refused(bad):
    with pytest.raises(ValueError, match=r"dolp: expected (values in \[0, 1\]|finite numbers), got"):
        quantise("dolp", torch.tensor([0.5, bad]))


def test_frames_come_back_to_half_a_step_with_their_splits_and_pictures(finished, tmp_path):
    store = FrameStore.open(finished)
    for name, (t_us, intensity, dolp, aolp) in (("a", frames_of(1)), ("b", frames_of(2, n=33))):
        frames = store.frames(name)
        assert torch.equal(frames.t_us, t_us)
        torch.testing.assert_close(frames.intensity, intensity, atol=0.51 / 65535, rtol=0)
        torch.testing.assert_close(frames.dolp, dolp, atol=0.51 / 65535, rtol=0)
        torch.testing.assert_close(frames.aolp, aolp, atol=0.51 * math.pi / 65536, rtol=0)
        assert torch.equal(store.quantity("dolp", name), frames.dolp)
        some = store.frames(name, 5, 9)
        assert all(torch.equal(part, whole[5:9]) for part, whole in zip(some[:4], frames[:4], strict=True))
    assert store.splits == {"a": "train", "b": "test"}
    assert [store.of_split(split) for split in ("train", "val", "test")] == [["a"], [], ["b"]]
    with pytest.raises(ValueError, match="train, val, test, got 'validation'"):
        store.of_split("validation")
    with pytest.raises(ValueError, match=r"splits\.b: expected one of train, val, test, got 'none'"):
        FrameStore.create("frames.zarr", Contents({"a": "train", "b": "none"}), height=4, width=4)
    attributes = {"scenes": {"lake-00": "lake", "lake-variant01-00": "lake-variant01"}}
    names = ["lake-00", "lake-variant01-00", "other"]
    contents = Contents(dict.fromkeys(names, "train"), attributes, variant_of={"lake-variant01-00": "lake"})
    store = FrameStore.create(tmp_path / "frames.zarr", contents, height=4, width=4)
    assert [store.original_of(name) for name in names] == ["lake", "lake", "other"]


def test_black_frames_are_there_and_numpy_frames_and_a_path_of_text_make_the_same_store(tmp_path, finished):
    store = store_at(tmp_path / "f.zarr", names=["a"])
    t_us, intensity, dolp, aolp = frames_of(1)
    store.write("a", t_us, 0 * intensity, 0 * dolp, 0 * aolp)
    store.finish()
    assert FrameStore.verify(tmp_path / "f.zarr") == []
    assert FrameStore.open(tmp_path / "f.zarr").frames("a").intensity.abs().max() == 0
    store = FrameStore.create(str(tmp_path / "n.zarr"), Contents({"a": "train"}), 4, 6)
    store.write("a", *(values.numpy() for values in frames_of(1)))
    store.finish()
    written, expected = (FrameStore.open(str(path)).frames("a") for path in (tmp_path / "n.zarr", finished))
    assert all(torch.equal(a, b) for a, b in zip(written[:4], expected[:4], strict=True))


def test_frames_of_a_wrong_shape_range_type_or_order_are_refused(tmp_path, unchecked_annotations):
    store = store_at(tmp_path / "f.zarr")
    t_us, intensity, dolp, aolp = frames_of(1)
    masks = torch.ones(FRAMES, HEIGHT, WIDTH).bool()
    for words, frames in {
        "frame times that increase": (t_us.flip(0), intensity, dolp, aolp),
        r"intensity: expected \(40, 4, 4, 6\), got \(40, 4, 3, 6\)": (
            t_us, intensity[..., 1:, :], dolp[..., 1:, :], aolp[..., 1:, :],
        ),
        r"dolp: expected values in \[0, 1\]": (t_us, intensity, 2 * dolp, aolp),
        "got a mask for a store without one": (t_us, intensity, dolp, aolp, masks),
        r"intensity: expected values in \[0, 1\], got values up to .*; divide by 255": (
            t_us, (255 * intensity).byte(), dolp, aolp,
        ),
        r"t_us: expected whole numbers, got torch\.float32": (t_us.float(), intensity, dolp, aolp),
    }.items():  # fmt: skip
        with pytest.raises(ValueError, match=words):
            store.write("a", *frames)
    assert store.missing() == ["a", "b"]


def test_a_mask_comes_back_as_it_was(tmp_path, finished):
    store = store_at(tmp_path / "frames.zarr", masked=True)
    mask = torch.rand(FRAMES, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1)) < 0.5
    store.write("a", *frames_of(1), mask)
    store.write("b", *frames_of(2, n=33))  # nothing masked
    store.finish()
    read = FrameStore.open(tmp_path / "frames.zarr")
    assert torch.equal(read.frames("a").valid, mask)
    assert read.frames("b").valid.shape == (33, HEIGHT, WIDTH)
    assert read.quantity("valid", "b").all()
    assert FrameStore.verify(tmp_path / "frames.zarr") == []
    assert FrameStore.open(finished).frames("a").valid is None
    assert not (finished / "part-00000" / "valid").exists()
