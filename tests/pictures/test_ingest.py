"""From source pictures to data/images: what comes in, what is left out and why, and who is in which split."""

import dataclasses
import json
import logging
from collections.abc import Callable, Iterable, Sequence
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from polarnet.pictures.ingest import IngestConfig, ingest
from polarnet.pictures.manifest import read_manifest, split_by_content

CONFIG = IngestConfig(
    source="folder", root="", limit=None, dead_leaves=3, height=100, width=150, max_upscale=2.0, val_fraction=0.1,
    test_fraction=0.2, mosaic="90 45 / 135 0", white=None, residual_max=0.1,
)  # fmt: skip


def photograph(seed: int, height: int = 110, width: int = 160) -> np.ndarray:
    """Smooth colours, as a JPEG keeps them."""
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8))
    return np.asarray(coarse.resize((width, height), Image.Resampling.BICUBIC))


def folder_of(path: Path, count: int) -> str:
    """A folder with so many photographs."""
    path.mkdir()
    for i in range(count):
        Image.fromarray(photograph(i)).save(path / f"{i}.png")
    return str(path)


@pytest.fixture
def mixed_folder(tmp_path) -> Path:
    """Good files in several formats among bad ones."""
    root = tmp_path / "pictures"
    (root / "deeper").mkdir(parents=True)
    Image.fromarray(photograph(0)).save(root / "good.jpg", quality=95)
    whole = (root / "good.jpg").read_bytes()
    (root / "truncated.jpg").write_bytes(whole[: len(whole) // 2])
    (root / "text.png").write_text("this is text")
    tifffile.imwrite(root / "grey.tif", photograph(1)[..., 0])
    tifffile.imwrite(root / "deeper" / "deep.TIFF", photograph(2).astype(np.uint16) * 257)
    alpha = np.full((110, 160), 77, np.uint8)
    Image.fromarray(np.dstack([photograph(3), alpha])).save(root / "rgba.png")
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned right by 90 degrees
    stored = np.ascontiguousarray(np.rot90(photograph(4)))
    Image.fromarray(stored).save(root / "rotated.jpg", exif=exif, quality=95, subsampling=0)
    Image.fromarray(photograph(5, 50, 50)).save(root / "small.png")
    Image.fromarray(photograph(3)).save(root / "same_as_rgba.bmp")
    (root / "notes.txt").write_text("not a picture, and not meant as one")
    return root


def test_good_files_come_in_and_bad_ones_are_named(mixed_folder, tmp_path, caplog):
    config = dataclasses.replace(CONFIG, root=str(mixed_folder))
    with caplog.at_level(logging.WARNING):
        manifest = ingest(config, 1, tmp_path / "images", map)
    origins = ["deeper/deep.TIFF", "good.jpg", "rgba.png", "rotated.jpg"]
    assert sorted(entry.origin for entry in manifest.pictures) == origins
    assert {skipped.file: skipped.reason for skipped in manifest.skipped} == {
        "truncated.jpg": 'cannot be read: JPEG error: Premature end of JPEG file ("truncated.jpg")',
        "text.png": "cannot be read: Not a PNG file",
        "grey.tif": "one channel, no RGB: saturation and hue, and so polarization, would be 0 everywhere",
        "small.png": "too small: 50x50 pixels would be enlarged 3.03 times to fill 150x100, "
        "more than ingest.max_upscale=2",
        "same_as_rgba.bmp": "the same pixels as rgba.png",
    }
    for skipped in manifest.skipped:
        assert f"skipped {skipped.file}: {skipped.reason}" in caplog.messages
    split = {"pictures": 4, "train": 2, "val": 1, "test": 1}
    assert manifest.counts == split | {"skipped": 5, "ignored_files": 1, "unread_files": 0}
    assert read_manifest(tmp_path / "images") == manifest
    text = (tmp_path / "images" / "manifest.json").read_text()
    assert str(tmp_path) not in text  # no place of this machine
    content = json.loads(text)
    assert set(content) == {"pictures", "skipped", "ignored_files", "unread_files"}
    entry = content["pictures"][0]
    assert (entry["name"], entry["file"]) == (f"deep-{entry['sha256'][:8]}", f"{entry['name']}.png")
    assert (entry["height"], entry["width"]) == (100, 150)
    files = [*(entry["file"] for entry in content["pictures"]), "manifest.json", "SHA256SUMS"]
    assert sorted(path.name for path in (tmp_path / "images").iterdir()) == sorted(files)


def test_a_folder_without_any_usable_picture_is_an_error_that_says_what_was_looked_for(tmp_path):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "text.png").write_text("text")
    (tmp_path / "pictures" / "notes.txt").write_text("text")
    config = dataclasses.replace(CONFIG, root=str(tmp_path / "pictures"))
    words = r"(?s)no picture could be used.*jpg.*found 1 pictures and 1 other files.*text.png: cannot be read"
    with pytest.raises(ValueError, match=words):
        ingest(config, 1, tmp_path / "images", map)
    assert not (tmp_path / "images").exists()
    with pytest.raises(ValueError, match="expected a folder with pictures"):
        ingest(dataclasses.replace(CONFIG, root=str(tmp_path / "nowhere")), 1, tmp_path / "images", map)


def test_a_limit_takes_the_same_pictures_whatever_they_are_called(tmp_path):
    for order in (0, 1):
        folder = tmp_path / f"folder{order}"
        folder.mkdir()
        for i in range(6):
            Image.fromarray(photograph(i)).save(folder / f"{i if order else 5 - i}.png")
        (folder / "text.png").write_text("this is text")
    chosen = []
    for order in (0, 1):
        config = dataclasses.replace(CONFIG, root=str(tmp_path / f"folder{order}"), limit=4)
        manifest = ingest(config, 1, tmp_path / "images", map)
        chosen.append({entry.sha256 for entry in manifest.pictures})
        assert len(manifest.pictures) == 4
        assert len(manifest.pictures) + len(manifest.skipped) + manifest.unread_files == 7
    assert chosen[0] == chosen[1]


@pytest.mark.parametrize(("fractions", "empty"), [((0.1, 0.2), ["train"]), ((0.0, 1.0), []), ((1.0, 0.0), [])])
def test_an_empty_split_is_named_where_pictures_were_asked_for(fractions, empty, tmp_path, caplog):
    (val, test), root = fractions, folder_of(tmp_path / "pictures", 2)
    config = dataclasses.replace(CONFIG, root=root, val_fraction=val, test_fraction=test)
    ingest(config, 1, tmp_path / "images", map)
    assert caplog.messages == [f"split {split} is empty, because 2 pictures are too few" for split in empty]


def on_two_threads_backwards(function: Callable[[Any], Any], items: Sequence[Any]) -> Iterable[Any]:
    with ThreadPool(2) as pool:
        return pool.map(function, items[::-1], chunksize=1)[::-1]


def test_the_builtin_pictures_are_the_same_bytes_in_whatever_order_they_are_made(tmp_path):
    config = dataclasses.replace(CONFIG, source="builtin")
    manifest = ingest(config, 1, tmp_path / "one", map)
    ingest(config, 1, tmp_path / "two", on_two_threads_backwards)
    files = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert files == sorted(path.name for path in (tmp_path / "two").iterdir())
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
    assert manifest.counts["pictures"] == 8 + 3
    photographs = [entry for entry in manifest.pictures if entry.source == "photograph"]
    assert all(entry.licence and entry.origin and entry.author for entry in photographs)
    assert sum(entry.split == "test" for entry in photographs) == 2  # of each kind its share
    assert sum(entry.split == "test" for entry in manifest.pictures if entry.source == "dead_leaves") == 1


# -- splits ------------------------------------------------------------------------------------------------------------


def hashes(n: int) -> list[str]:
    return [f"{value:064x}" for value in np.random.default_rng(0).permutation(n * 1000)[:n].tolist()]


@pytest.mark.parametrize(
    ("n", "test", "val"), [(1, 1, 0), (2, 1, 1), (5, 1, 1), (8, 2, 1), (10, 2, 1), (11, 3, 2), (30, 6, 3), (40, 8, 4)]
)
def test_splits_are_a_fifth_test_and_a_tenth_val_rounded_up(n, test, val):
    splits = split_by_content(hashes(n), val_fraction=0.1, test_fraction=0.2)
    assert [splits.count(split) for split in ("test", "val", "train")] == [test, val, n - test - val]


def test_one_more_picture_moves_at_most_two_others_to_another_split():
    names = hashes(41)
    before = dict(zip(names[:40], split_by_content(names[:40], 0.1, 0.2), strict=True))
    after = dict(zip(names, split_by_content(names, 0.1, 0.2), strict=True))
    assert sum(before[name] != after[name] for name in before) <= 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": "web"}, "source: expected one of builtin, folder, polarization"),
        ({"mosaic": "90 45 / 135 135"}, 'mosaic: expected the angles 0, 45, 90 and 135 like "90 45 / 135 0"'),
        ({"limit": 0}, "limit: expected > 0"),
        ({"max_upscale": 0.5}, "max_upscale: expected >= 1"),
        ({"val_fraction": 0.9}, "val_fraction: expected <= 1 - test_fraction = 0.8, got 0.9"),
    ],
)
def test_a_bad_setting_is_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(CONFIG, **changes)


def test_links_to_folders_are_followed_and_dead_links_are_named(tmp_path):
    root, elsewhere = tmp_path / "pictures", tmp_path / "elsewhere"
    for folder, number in ((root / "own", 0), (elsewhere / "deeper", 1)):
        folder.mkdir(parents=True)
        Image.fromarray(photograph(number)).save(folder / f"{number}.png")
    (root / "linked").symlink_to(elsewhere)
    (elsewhere / "deeper" / "cycle").symlink_to(root)
    (root / "again").symlink_to(root / "own")  # read already
    (root / "lost.png").symlink_to("nowhere.png")
    manifest = ingest(dataclasses.replace(CONFIG, root=str(root)), 1, tmp_path / "images", map)
    assert sorted(entry.origin for entry in manifest.pictures) == ["linked/deeper/1.png", "own/0.png"]
    assert [(one.file, one.reason.partition(":")[0]) for one in manifest.skipped] == [("lost.png", "cannot be read")]
