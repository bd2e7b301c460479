"""The pictures that `studies.robustness` scores: folders of each split and source, with their scenes."""

import csv
import dataclasses
import functools
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import torch

from polarnet.config.tree import Config, load
from polarnet.pictures.images import read_rgb
from polarnet.pictures.manifest import MANIFEST, ManifestEntry, read_manifest, write_manifest
from polarnet.pictures.polarimetry import read_intensities
from polarnet.runtime.files import sha256
from polarnet.simulation.scene import polarization_from_rgb
from polarnet.simulation.truth import Synthesis, synthesize
from polarnet.stokes import dolp, stokes_from_intensities
from polarnet.storage.scenes import SceneStore
from studies.study import ROOT


@functools.cache
def settings(*overrides: str) -> Config:
    """The configuration of a condition."""
    return load(ROOT, ["experiment=photographs", *overrides])


def ingested(root: Path, folder: Path, *overrides: str) -> Path:
    """Folder of the pictures of `root`, made by stage ingest if missing."""
    if not (folder / "images" / MANIFEST).exists():
        given = ["experiment=photographs", f"ingest.root={root}", f"paths.data={folder}", *overrides]
        subprocess.run([sys.executable, "-m", "stages.ingest", *given], cwd=ROOT, check=True)
    return folder / "images"


def sources_of(folder: Path, work: Path) -> dict[str, Path]:
    """A folder of each source of measured scenes: links by the repo column of manifest.csv, or the folder itself."""
    manifest = folder / "manifest.csv"
    if not manifest.exists():
        return {folder.name: folder}
    sources: dict[str, Path] = {}
    with manifest.open(newline="") as file:
        for row in csv.DictReader(file):
            name = row["repo"].rpartition("/")[2]
            sources[name] = work / "sources" / name
            sources[name].mkdir(parents=True, exist_ok=True)
            if not (link := sources[name] / row["file"]).exists():
                link.symlink_to(folder / row["file"])
    return sources


def link_training(roots: Mapping[str, Path], images: Mapping[str, Path], folder: Path) -> int:
    """Fill a folder with links to the training photographs of all roots, and return their number."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, root in roots.items():
        for entry in read_manifest(images[name]).pictures:
            link = folder / f"{name}_{entry.origin.replace('/', '_')}"
            if entry.split == "train" and not link.is_symlink():
                link.symlink_to(root / entry.origin)
    return len(list(folder.iterdir()))


def part_of(images: Path, folder: Path, split: str, limit: int | None) -> Path:
    """Folder with links to the pictures of a split and their manifest."""
    folder = folder / f"{split}_{limit or 'all'}"
    if not (folder / MANIFEST).exists():
        manifest = read_manifest(images)
        pictures = tuple(entry for entry in manifest.pictures if entry.split == split)[:limit]
        folder.mkdir(parents=True, exist_ok=True)
        for entry in pictures:
            (folder / entry.file).symlink_to(images / entry.file)
        write_manifest(dataclasses.replace(manifest, pictures=pictures, skipped=()), folder)
    return folder


def scenes_of(images: Path, config: Config) -> SceneStore:
    """Scenes and motions of the pictures, made beside them if missing."""
    size, polarizers = config.storage.sequences_per_part, config.polarizers
    sections = dataclasses.asdict(config.synthesize), dataclasses.asdict(polarizers)
    made_with = json.dumps([*sections, config.seed]).encode()
    folder = images.with_name(f"{images.name}_{sha256(made_with)[:12]}")
    if not (folder / "frames.zarr").exists():
        folder.mkdir(exist_ok=True)
        synthesis = Synthesis(images, config.synthesize, config.seed, size, polarizers=polarizers)
        synthesize(synthesis, folder / "scenes.zarr", folder / "frames.zarr", config.mapper("scenes"))
    return SceneStore.open(folder / "scenes.zarr")


def mean_dolp(images: Path, split: str) -> list[float]:
    """Mean DoLP of each picture of a split."""

    def of_picture(entry: ManifestEntry) -> float:
        path = images / entry.file
        if entry.source == "polarization":
            intensities, valid = read_intensities(path)
            degree = dolp(stokes_from_intensities(torch.as_tensor(intensities))).clamp(0, 1)
            return float(degree[torch.as_tensor(valid)].mean())
        return float(polarization_from_rgb(read_rgb(path))[1].mean())

    return [of_picture(entry) for entry in read_manifest(images).pictures if entry.split == split]
