"""Test sets beside the pipeline's own, of measured polarization or a user's photographs.

A set is a folder with images, scenes.zarr, frames.zarr and events.zarr, made by the same code as the pipeline's own.
"""

import json
import logging
import shutil
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from polarnet.pictures.images import extension, picture_extensions
from polarnet.pictures.ingest import IngestConfig, files_under, ingest
from polarnet.pictures.polarimetry import are_measurements, group_by_measurement
from polarnet.runtime.files import SUMS, changed_files, code_digest, seal, sha256
from polarnet.runtime.sections import section
from polarnet.simulation.camera import Camera
from polarnet.simulation.event_sets import emulate_scenes
from polarnet.simulation.motion import SynthesizeConfig
from polarnet.simulation.truth import Synthesis, synthesize

MADE = "made.json"  # everything that determines a set; the set is complete once it is sealed

logger = logging.getLogger(__name__)

MakeMapper = Callable[[str], Callable[..., Iterable[Any]]]
"""Label of a progress bar -> mapper: `polarnet.runtime.cluster.pmap` with its workers bound, or the built-in `map`."""


@section
class SetsConfig:
    """Section `sets` of params.yaml."""

    measured_root: str
    """Folder of the measurements for the test set `measured`, searched recursively."""


@dataclass(frozen=True)
class Recipe:
    """Sections of params.yaml that determine how pictures become sequences."""

    ingest: IngestConfig
    motion: SynthesizeConfig
    camera: Camera
    seed: int
    threads: int  # threads of each task; changes no result
    sequences_per_part: int  # sequences in a part of a store; changes no result


def make_folder_set(
    root: Path, kind: str, folder: Path, recipe: Recipe, mapper: MakeMapper, limit: int | None = None
) -> bool:
    """Make a test set of all photographs or measured scenes under `root`; False if it is complete already.

    At most `limit` pictures are chosen by content hash. `kind` is photographs, polarization, or auto, which looks at
    the files. A stopped run with the same settings, seed and pictures is resumed. A folder made with others, or by
    other code, is emptied first, as is one whose files have changed since, with a warning. ValueError if no picture can
    be used.
    """
    if not root.is_dir():
        actual = "a file" if root.exists() else "no such folder"
        raise ValueError(f"{root}: expected a folder of photographs or of measured polarization, got {actual}")
    source = "polarization" if (kind if kind != "auto" else kind_of(root)) == "polarization" else "folder"
    chosen = replace(recipe.ingest, source=source, root=str(root), limit=limit, val_fraction=0.0, test_fraction=1.0)
    sections = {"ingest": asdict(chosen), "motion": asdict(recipe.motion), **recipe.camera.sections}
    settings = sections | {"seed": recipe.seed, "source": _content(root), "code": code_digest()}
    note, made = folder / MADE, json.dumps(settings, sort_keys=True)
    if note.exists():
        complete, same = (folder / SUMS).exists(), note.read_bytes() == made.encode()
        changed = changed_files(folder) if complete else []
        for problem in changed:
            logger.warning("%s; making the set again", problem.partition(";")[0])
        if complete and same and not changed:
            return False
        if changed or not same:
            shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    note.write_text(made)
    images, scenes, frames, events = (folder / name for name in ("images", "scenes.zarr", "frames.zarr", "events.zarr"))
    if not (images / "manifest.json").exists():
        ingest(chosen, recipe.seed, images, mapper("ingest"))
    if not (scenes.exists() and frames.exists()):
        size, polarizers = recipe.sequences_per_part, recipe.camera.polarizers
        synthesis = Synthesis(images, recipe.motion, recipe.seed, size, polarizers=polarizers)
        synthesize(synthesis, scenes, frames, mapper("synthesize"))
    if not events.exists():
        emulate_scenes(scenes, events, recipe.camera, recipe.seed, mapper("emulate"), recipe.threads)
    seal(folder)
    return True


def kind_of(root: Path) -> str:
    """`polarization` if a folder holds only .npz files or NAME_0, NAME_45, NAME_90, NAME_135, else `photographs`.

    Raw mosaics look like photographs: name their kind.
    """
    kinds = picture_extensions() | {"npz"}
    files = [path for path in files_under(root) if path.is_file() and extension(path) in kinds]
    return "polarization" if are_measurements(group_by_measurement(files)) else "photographs"


def _content(folder: Path) -> str:
    """Hash of the names and bytes of all files in a folder."""
    files = [path for path in files_under(folder) if path.is_file()]
    return sha256(*(f"{path.relative_to(folder)} {sha256(path)}\n".encode() for path in files))
