"""Manifest of data/images: the origin and split of each picture, and the skipped files with reasons."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter

from polarnet.runtime.files import check_seal, seal
from polarnet.runtime.splits import SPLITS

MANIFEST = "manifest.json"
REASONS_SHOWN = 5


@dataclass(frozen=True, kw_only=True)
class ManifestEntry:
    """One picture of data/images."""

    name: str  # name of the source and the first 8 digits of `sha256`; sequence names begin with it
    file: str  # name of the picture's file in the folder of the manifest
    split: str = ""  # train, val or test, once it is drawn; every sequence made of this picture belongs to it
    source: str  # photograph, dead_leaves, folder or polarization
    origin: str
    """Where the picture comes from: an address, a file relative to ingest.root, or the seed it was made from."""
    licence: str | None = None
    author: str | None = None
    sha256: str  # hash of the source's upright pixels, before cropping, scaling and conversion
    height: int
    width: int
    residual: float | None = None  # median of |I0 + I90 - I45 - I135| / S0 (measured polarization)
    saturated_fraction: float | None = None  # share of source pixels with a saturated angle (measured polarization)
    masked_fraction: float | None = None
    """Share of pixels with unknown light (measured polarization); `valid` in the file marks the others."""


@dataclass(frozen=True)
class Skipped:
    """A file that gave no picture."""

    file: str  # relative to ingest.root
    reason: str


@dataclass(frozen=True)
class Manifest:
    """The pictures of a folder and the files left out; equal for equal pictures and settings."""

    pictures: tuple[ManifestEntry, ...]
    skipped: tuple[Skipped, ...]
    ignored_files: int  # files without the extension of a picture
    unread_files: int  # pictures beyond ingest.limit

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of pictures, in all and per split, and of files left out."""
        of_split = {split: sum(entry.split == split for entry in self.pictures) for split in SPLITS}
        return {
            "pictures": len(self.pictures),
            **of_split,
            "skipped": len(self.skipped),
            "ignored_files": self.ignored_files,
            "unread_files": self.unread_files,
        }


def listed(skipped: Sequence[Skipped]) -> str:
    """Lines for an error: the first files, each with its reason, and the number of the others."""
    reasons = "".join(f"\n  {skip.file}: {skip.reason}" for skip in skipped[:REASONS_SHOWN])
    return reasons + (f"\n  and {len(skipped) - REASONS_SHOWN} more" if len(skipped) > REASONS_SHOWN else "")


def split_by_content(hashes: Sequence[str], val_fraction: float, test_fraction: float) -> list[str]:
    """The split of each picture of one group, by the rank of its content hash, so that names and order do not matter.

    The first ceil(test_fraction n) are test, the next ceil(val_fraction n) val, the rest train.
    """
    n = len(hashes)
    # the tolerance: 0.1 * 30 is 3.0000000000000004, and nobody who writes 0.1 means 4 of 30
    n_test = min(n, math.ceil(test_fraction * n - 1e-9))
    n_val = min(n - n_test, math.ceil(val_fraction * n - 1e-9))
    splits = [""] * n
    for rank, i in enumerate(sorted(range(n), key=lambda i: hashes[i])):
        splits[i] = "test" if rank < n_test else "val" if rank < n_test + n_val else "train"
    return splits


def write_manifest(manifest: Manifest, folder: Path) -> None:
    """Write `folder`/manifest.json, the same bytes for the same manifest, and seal the folder."""
    text = json.dumps(asdict(manifest), indent=1, ensure_ascii=False)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")
    seal(folder)


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a folder that `ingest` wrote; FileNotFoundError without one, ValueError for changed files."""
    path = folder / MANIFEST
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no manifest; run the stage ingest first (dvc repro ingest)")
    check_seal(folder)
    try:
        return TypeAdapter(Manifest).validate_json(path.read_bytes())
    except ValueError as error:
        raise ValueError(f"{path}: not a manifest of this version; run the stage ingest again") from error
