"""Events of all sequences of a scene store, made part by part so that a run can resume, and whole sets of a folder.

A set is a folder with images, scenes.zarr, frames.zarr and events.zarr, made by the same code as the pipeline's own: a
test set of measured polarization or of a user's photographs.
"""

import functools
import json
import logging
import shutil
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from polarnet.events.stream import Events
from polarnet.pictures.images import extension, picture_extensions
from polarnet.pictures.ingest import IngestConfig, files_under, ingest
from polarnet.pictures.polarimetry import are_measurements, group_by_measurement
from polarnet.runtime.files import SUMS, changed_files, code_digest, seal, sha256
from polarnet.runtime.sections import section
from polarnet.simulation.camera import Camera, grid, pixel_analyzers
from polarnet.simulation.emulator import draws
from polarnet.simulation.motion import SynthesizeConfig, Trajectory
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.rotating import RotatingConfig, emulate_rotating
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization, stretched
from polarnet.simulation.truth import Synthesis, synthesize
from polarnet.stokes import NUM_CHANNELS
from polarnet.storage.events import EventStore
from polarnet.storage.scenes import SceneStore
from polarnet.terminal.progress import steps

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


def emulate_scenes(
    scenes: str | Path,
    events: str | Path,
    camera: Camera,
    seed: int,
    mapper: Callable[..., Iterable[Any]],
    threads: int,
    rotating: RotatingConfig | None = None,
) -> int:
    """Emulate all sequences of a scene store into an event store, and return their number; both may be at a URL.

    With `rotating`, only the test sequences are emulated, behind the rotating polarizer alone: events are in the
    store's first channel, the other three are empty.

    `mapper` is `polarnet.runtime.cluster.pmap` with its workers bound, or the built-in `map`; each of its tasks
    emulates one part on `threads` threads. The event store has the parts of the scene store. After an interruption, a
    run of the same scenes, camera and seed makes the missing parts. The noise of a sequence, and with `randomise` its
    camera, depend only on the seed and the sequence's name.
    """
    source = SceneStore.open(scenes)
    height, width, _ = grid(camera.polarizers.layout, source.sensor_height, source.sensor_width)
    # all settings and data that determine the events; the checksum stands for the pixels of the scenes
    inputs = {"seed": seed, "scenes": source.attributes, "scenes_sha256": source.header["checksum"]}
    origin = {**camera.sections, **inputs, **({"rotating": asdict(rotating)} if rotating else {})}
    sequences = source.of_split("test") if rotating else source.sequences
    store = EventStore.create(events, sequences, height, width, origin, source.sequences_per_part)
    emulate_part = functools.partial(_emulate_part, source, store, camera, seed, threads, rotating)
    for _ in mapper(emulate_part, store.missing_parts()):
        pass
    store.finish()
    return len(sequences)


def _emulate_part(
    scenes: SceneStore,
    store: EventStore,
    camera: Camera,
    seed: int,
    threads: int,
    rotating: RotatingConfig | None,
    part: str,
) -> None:
    size = scenes.sensor_height, scenes.sensor_width
    for sequence in steps(store.parts[part]):
        drawn, analyzer = camera.drawn(seed, sequence, "rotating" if rotating else "emulate"), None
        scene, trajectory, duration_us = motion_over(scenes, sequence)
        if rotating:
            pixels = grid(camera.polarizers.layout, *size)
            first = emulate_rotating(rotating, drawn, scene, trajectory, duration_us, pixels)
            channels = [first, *[Events.empty(pixels.height, pixels.width)] * (NUM_CHANNELS - 1)]
        else:
            channels = emulate_motion(drawn, scene, trajectory, duration_us, size, threads)
            analyzer = pixel_analyzers(drawn, *size)
        values = draws(camera.sensor, seed, sequence)
        store.write(sequence, channels, duration_us, {"emulate": values} if values else {}, analyzer)


def motion_over(scenes: SceneStore, sequence: str) -> tuple[PolarizationScene, Trajectory, int]:
    """The scene of a stored sequence, the motion over it, and its duration in microseconds."""
    stored, record = scenes.read(sequence), scenes.record(sequence)
    scene = scene_from_polarization(stored.s0, stored.dolp, stored.aolp)
    scene = stretched(scene, record.get("dynamic_range"))
    return scene, Trajectory.from_record(record["trajectory"]), record["duration_us"]


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
    kind = "polarization" if (kind if kind != "auto" else kind_of(root)) == "polarization" else "folder"
    chosen = replace(recipe.ingest, source=kind, root=str(root), limit=limit, val_fraction=0.0, test_fraction=1.0)
    sections = {"ingest": asdict(chosen), "motion": asdict(recipe.motion), **recipe.camera.sections}
    files = [path for path in files_under(root) if path.is_file()]
    source = sha256(*(f"{path.relative_to(root)} {sha256(path)}\n".encode() for path in files))
    settings = sections | {"seed": recipe.seed, "source": source, "code": code_digest()}
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
