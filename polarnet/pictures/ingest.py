"""From source pictures to data/images: RGB pictures of one size, each with a split, and a manifest."""

import contextlib
import dataclasses
import functools
import hashlib
import logging
import os
import re
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from polarnet.pictures import images, polarimetry
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.pictures.images import UnreadablePicture, extension, picture_extensions, write_png
from polarnet.pictures.manifest import Manifest, ManifestEntry, Skipped, listed, split_by_content, write_manifest
from polarnet.pictures.polarimetry import group_by_measurement, parse_raw_mosaic
from polarnet.runtime.files import claimed, publish, sha256
from polarnet.runtime.machine import generator_for
from polarnet.runtime.sections import one_of, section

logger = logging.getLogger(__name__)

EDGE_BYTES = 1 << 16  # bytes at a file's start and at its end, hashed to choose `limit` files without reading them all

Mapper = Callable[..., Iterable[Any]]


@section
class IngestConfig:
    """Section `ingest` of params.yaml."""

    source: Annotated[str, one_of(("builtin", "folder", "polarization"))]
    root: str
    """Folder that is searched recursively (source=folder and source=polarization)."""
    limit: PositiveInt | None
    """At most this many pictures of the folder, chosen by content hash."""
    dead_leaves: Annotated[int, Field(ge=0, le=1_000_000)]
    """Generated pictures beside the builtin photographs."""
    height: Annotated[int, Field(ge=16, le=16_384)]
    """Pixels of every picture after the centre crop."""
    width: Annotated[int, Field(ge=16, le=16_384)]
    max_upscale: Annotated[float, Field(ge=1)]
    """Largest enlargement; a photograph that needs more is skipped as too small."""
    val_fraction: Annotated[float, Field(ge=0, le=1)]
    test_fraction: Annotated[float, Field(ge=0, le=1)]
    mosaic: str
    """Polarizer angles of the 2x2 pixels of a raw mosaic, even row / odd row (source=polarization). A colour sensor's
    order of colours, such as RGGB, stands before them."""
    white: PositiveFloat | None
    """Level at which a measurement's camera saturates (source=polarization); null: found from the bits in use."""
    residual_max: PositiveFloat
    """Largest accepted median of |I0 + I90 - I45 - I135| / S0 (source=polarization)."""

    def __post_init__(self):
        parse_raw_mosaic(self.mosaic)
        if self.val_fraction + self.test_fraction > 1:
            largest = 1 - self.test_fraction
            raise ValueError(f"val_fraction: expected <= 1 - test_fraction = {largest:g}, got {self.val_fraction}")


@dataclass(frozen=True)
class Source:
    """One picture to read or to generate, with its origin."""

    files: tuple[Path, ...]  # four if each polarizer angle has a file, none for a generated picture, else one
    kind: str  # photograph, dead_leaves, folder or polarization
    stem: str
    origin: str
    licence: str | None = None
    author: str | None = None


def ingest(config: IngestConfig, seed: int, folder: Path, mapper: Mapper) -> Manifest:
    """Fill `folder` with pictures of config.height x config.width and their manifest, replacing its content.

    `mapper` is `polarnet.runtime.cluster.pmap` with its workers bound, or the built-in `map`. Neither the mapper nor
    the order of the files changes the result, and `folder` is never half full. Logs a warning for every file skipped;
    ValueError if no picture is left, or while another process fills `folder`.
    """
    temporary = folder.with_name(folder.name + ".tmp")
    with claimed(folder):
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        manifest = _ingest(config, seed, temporary, mapper)
        for skipped in manifest.skipped:
            logger.warning("skipped %s: %s", skipped.file, skipped.reason)
        _warn_of_empty_splits(config, manifest)
        write_manifest(manifest, temporary)
        publish(temporary, folder)
    return manifest


def _builtin_sources(config: IngestConfig, seed: int) -> tuple[list[Source], int]:
    """The builtin photographs and the pictures to generate; no other files."""
    photographs = [
        Source((photo.path,), "photograph", photo.path.stem, photo.origin, photo.licence, photo.author)
        for photo in BUILTIN_PHOTOS
    ]
    stems, origin = [f"dead-leaves-{number:04d}" for number in range(config.dead_leaves)], f"generated from seed {seed}"
    return photographs + [Source((), "dead_leaves", stem, origin, "CC0-1.0", "polarnet") for stem in stems], 0


def _ingest(config: IngestConfig, seed: int, folder: Path, mapper: Mapper) -> Manifest:
    """Read all pictures, or of a folder with a `limit` that many, in the order of the hashes of their files."""
    builtin = config.source == "builtin"
    sources, ignored = _builtin_sources(config, seed) if builtin else _find_pictures(config)
    limit = None if builtin else config.limit
    if limit is not None:
        sources.sort(key=lambda source: _edge_hash(source.files))
    limit = limit or len(sources)
    convert = functools.partial(_convert, config=config, seed=seed, folder=folder)
    entries: list[ManifestEntry] = []
    skipped: list[Skipped] = []
    outcomes: list[ManifestEntry | Skipped] = []
    while len(outcomes) < len(sources) and len(entries) < limit:
        batch = list(enumerate(sources))[len(outcomes) : len(outcomes) + limit - len(entries)]
        outcomes.extend(mapper(convert, batch))
        entries, skipped = _without_duplicates(outcomes)
    if not entries and builtin:
        raise ValueError("ingest.source=builtin: no picture is left; raise ingest.dead_leaves")
    if not entries:
        raise ValueError(
            f"ingest.root={config.root}: no picture could be used. Looked, in all subfolders, for files that end in "
            f"{', '.join(sorted(_extensions(config.source)))}: found {len(sources)} pictures and {ignored} other files."
            f"{listed(skipped)}"
        )
    skipped.sort(key=lambda skip: skip.file)
    return Manifest(_named(entries, config, folder), tuple(skipped), ignored, len(sources) - len(outcomes))


def _find_pictures(config: IngestConfig) -> tuple[list[Source], int]:
    """Files under `ingest.root` with a picture's extension, by path, and the number of other files."""
    root, kind = Path(config.root), config.source
    if not root.is_dir():
        raise ValueError(f"ingest.root: expected a folder with pictures, got {root}; see ingest.source")
    files = [path for path in files_under(root) if path.is_file() or path.is_symlink()]  # a dead link is skipped later
    pictures = [path for path in files if extension(path) in _extensions(kind)]
    groups = group_by_measurement(pictures) if kind == "polarization" else [(path,) for path in pictures]
    sources = []
    for group in groups:
        stem = group[0].stem if len(group) == 1 else group[0].stem.rpartition("_")[0]
        sources.append(Source(group, kind, stem, ", ".join(_relative(path, root) for path in group)))
    return sources, len(files) - len(pictures)


def files_under(root: Path) -> list[Path]:
    """Files and dead links in a folder, its subfolders and linked folders, sorted; no folder is read twice."""
    files: list[Path] = []
    read: set[str] = set()
    for folder, subfolders, names in os.walk(root, followlinks=True):
        if os.path.realpath(folder) in read:
            subfolders.clear()
            continue
        read.add(os.path.realpath(folder))
        places = sorted((Path(folder, name) for name in subfolders), key=lambda path: (path.is_symlink(), path))
        subfolders[:] = [path.name for path in places]
        files += [Path(folder, name) for name in names]
    return sorted(files)


def _relative(path: Path, root: Path) -> str:
    """Path below `root`, in which bytes that are not UTF-8 are escaped."""
    name = path.relative_to(root).as_posix()
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def _extensions(kind: str) -> frozenset[str]:
    return picture_extensions() | ({"npz"} if kind == "polarization" else set())


def _edge_hash(files: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for path in files:
        with contextlib.suppress(OSError), path.open("rb") as file:  # an error is reported once the file is read
            digest.update(file.read(EDGE_BYTES))
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - EDGE_BYTES))
            digest.update(file.read() + str(size).encode())
    return digest.hexdigest()


def _convert(item: tuple[int, Source], config: IngestConfig, seed: int, folder: Path) -> ManifestEntry | Skipped:
    """Read or generate one picture as `folder`/source-<number>, or return the reason why not."""
    number, source = item
    try:
        about = _READERS[source.kind](source, folder / f"source-{number:08d}", config, seed)
    except UnreadablePicture as error:
        return Skipped(source.files[0].name if source.kind == "photograph" else source.origin, str(error))
    given: dict[str, Any] = {"licence": source.licence, "author": source.author}
    size: dict[str, Any] = {"height": config.height, "width": config.width}
    name = f"{_slug(source.stem)}-{about['sha256'][:8]}"
    return ManifestEntry(name=name, source=source.kind, origin=source.origin, **(given | size | about))


def _read_photograph(source: Source, target: Path, config: IngestConfig, _seed: int) -> dict[str, Any]:
    """Cut and scale a picture. Linear light in floating-point numbers stays as it is, other pictures become sRGB."""
    picture = images.read_picture(source.files[0])
    pixels = images.light_of(picture.pixels) if picture.light else picture.pixels
    fitted = images.fit(pixels, config.height, config.width, config.max_upscale)
    file = target.with_suffix(images.LIGHT if picture.light else ".png")
    if picture.light:
        np.save(file, fitted)
    else:
        write_png(file, images.srgb_of(fitted, picture), picture.bits)
    return {"file": file.name, "sha256": picture.sha256, "licence": source.licence or picture.licence,
            "author": source.author or picture.author}  # fmt: skip


def _read_polarization(source: Source, target: Path, config: IngestConfig, _seed: int) -> dict[str, Any]:
    """Check and shrink a measurement."""
    measured = polarimetry.read_measurement(source.files, *parse_raw_mosaic(config.mosaic), config.white)
    if measured.residual > config.residual_max:
        raise UnreadablePicture(
            f"the angles do not fit: the median of |I0 + I90 - I45 - I135| / S0 is {measured.residual:.4f}, above "
            f"ingest.residual_max={config.residual_max:g}; is an angle, linearity or ingest.mosaic wrong?"
        )
    shrunk = polarimetry.shrink(measured, config.height, config.width)
    file, (height, width) = target.with_suffix(".npz"), shrunk.valid.shape
    polarimetry.write_intensities(file, shrunk)
    return {
        "file": file.name, "sha256": sha256(measured.intensities.tobytes(), measured.valid.tobytes()),
        "height": height, "width": width, "residual": round(measured.residual, 6),
        "saturated_fraction": round(measured.saturated, 6),
        "masked_fraction": round(float(1 - shrunk.valid.mean()), 6),
    }  # fmt: skip


def _generate_dead_leaves(source: Source, target: Path, config: IngestConfig, seed: int) -> dict[str, Any]:
    rgb = dead_leaves(generator_for(seed, source.stem, "picture"), config.height, config.width)
    digest = sha256(np.round(rgb * 255).astype(np.uint8).tobytes())
    write_png(target.with_suffix(".png"), rgb, bits=8)
    return {"file": f"{target.name}.png", "sha256": digest}


_READERS: dict[str, Callable[[Source, Path, IngestConfig, int], dict[str, Any]]] = {
    "photograph": _read_photograph, "dead_leaves": _generate_dead_leaves, "folder": _read_photograph,
    "polarization": _read_polarization,
}  # fmt: skip
"""Readers by kind of source, in the order in which the kinds are split.

Each writes a picture to a path, with a suffix for its kind, and returns fields of its `ManifestEntry`."""


def _without_duplicates(outcomes: list[ManifestEntry | Skipped]) -> tuple[list[ManifestEntry], list[Skipped]]:
    """The first entry of each content, and everything skipped, duplicates included."""
    first: dict[str, ManifestEntry] = {}
    skipped = []
    for outcome in outcomes:
        if isinstance(outcome, Skipped):
            skipped.append(outcome)
        elif outcome.sha256 in first:
            skipped.append(Skipped(outcome.origin, f"the same pixels as {first[outcome.sha256].origin}"))
        else:
            first[outcome.sha256] = outcome
    return list(first.values()), skipped


def _named(entries: Sequence[ManifestEntry], config: IngestConfig, folder: Path) -> tuple[ManifestEntry, ...]:
    """Entries by name, each kind split on its own; files get their final names, and those without an entry leave."""
    named = []
    for kind in _READERS:
        group = [entry for entry in entries if entry.source == kind]
        splits = split_by_content([entry.sha256 for entry in group], config.val_fraction, config.test_fraction)
        for entry, split in zip(group, splits, strict=True):
            file = f"{entry.name}{Path(entry.file).suffix}"
            (folder / entry.file).rename(folder / file)
            named.append(dataclasses.replace(entry, file=file, split=split))
    for path in {*folder.iterdir()} - {folder / entry.file for entry in named}:
        path.unlink()
    return tuple(sorted(named, key=lambda entry: entry.name))


def _warn_of_empty_splits(config: IngestConfig, manifest: Manifest) -> None:
    val, test = config.val_fraction, config.test_fraction
    for split, fraction in (("train", 1 - val - test), ("val", val), ("test", test)):
        if fraction > 0 and not manifest.counts[split]:
            logger.warning("split %s is empty, because %d pictures are too few", split, len(manifest.pictures))


def _slug(stem: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", stem.lower()).strip("-")[:40].strip("-") or "picture"
