"""Synthesis: from pictures to scenes, trajectories and exact frames of an ideal camera."""

import functools
import itertools
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from polarnet import stokes
from polarnet.pictures.images import LIGHT, read_rgb
from polarnet.pictures.manifest import Manifest, ManifestEntry, Skipped, listed, read_manifest
from polarnet.pictures.polarimetry import read_intensities
from polarnet.runtime.files import sha256
from polarnet.runtime.machine import generator_for, one_thread
from polarnet.simulation import scene as scene_module
from polarnet.simulation.camera import IDEAL, Grid, PolarizersConfig, grid, mixed_with_neighbours
from polarnet.simulation.motion import SynthesizeConfig, Trajectory, frame_times_us, random_trajectory, render
from polarnet.simulation.scene import (
    LIGHT_RANGE,
    PolarizationScene,
    logarithmic,
    scene_from_polarization,
    stretched,
)
from polarnet.simulation.variation import VariationConfig, varied
from polarnet.storage.frames import Contents, FrameStore, Polarization
from polarnet.storage.scenes import SceneStore, as_stored
from polarnet.terminal.progress import steps

logger = logging.getLogger(__name__)


class Motion(NamedTuple):
    """The motion of the sensor in one sequence."""

    sequence: str
    scene: str
    picture: str  # name of the picture that the scene is made from
    split: str
    trajectory: Trajectory


@one_thread()
def frames_of(
    scene: PolarizationScene, trajectory: Trajectory, t_us: Sequence[int], height: int, width: int, pitch: int = 1
) -> tuple[Float[Tensor, "n 4 h w"], Float[Tensor, "n h w"], Float[Tensor, "n h w"]]:
    """(intensity behind the four polarizers, DoLP, AoLP) on a sensor that moves over a scene, at times in microseconds.

    Interpolation applies to Stokes parameters, because angles cannot be averaged. Pixels lie `pitch` pixels of the
    scene apart (`polarizers.grid`).
    """
    s = render(scene, trajectory, np.asarray(t_us) * 1e-6, height, width, pitch)
    return stokes.intensities_from_stokes(s).clamp(0, 1), stokes.dolp(s).clamp(0, 1), stokes.aolp(s)


def valid_frames(
    valid: Bool[Tensor, "h1 w1"], trajectory: Trajectory, t_us: Sequence[int], pixels: Grid, crosstalk: float = 0.0
) -> Bool[Tensor, "n h w"]:
    """Pixels of the channels with known light: those whose events and truth come from valid scene pixels only.

    All four pixels of a DoFP sensor's cell count, and with `crosstalk` their neighbours. Interpolation weights are not
    negative, so the rendered mask of invalid pixels is 0 exactly there.
    """
    scene, t_s = PolarizationScene((~valid).float().expand(3, -1, -1)), np.asarray(t_us) * 1e-6
    unknown = render(scene, trajectory, t_s, *pixels)[:, 0]
    if pixels.pitch > 1:
        sensor = render(scene, trajectory, t_s, pixels.height * pixels.pitch, pixels.width * pixels.pitch)[:, 0]
        mixed = torch.from_numpy(mixed_with_neighbours(sensor.numpy(), crosstalk))
        unknown = unknown + torch.nn.functional.max_pool2d(mixed, pixels.pitch)
    return unknown == 0


@dataclass(frozen=True)
class Synthesis:
    """Everything that determines the sequences made of a folder of pictures, and their number in a part of a store."""

    images: Path
    motion: SynthesizeConfig
    seed: int
    sequences_per_part: int
    variation: VariationConfig | None = None  # variants of training pictures; None: no variants
    polarizers: PolarizersConfig = IDEAL  # the frames are those of the channels of such a camera


def synthesize(
    synthesis: Synthesis, scenes: str | Path, frames: str | Path, mapper: Callable[..., Iterable[Any]]
) -> int:
    """Fill both stores with `sequences_per_picture` sequences of every scene, and return the number of sequences.

    A scene is a picture of `synthesis.images`, or a variant of a training picture. `mapper` is
    `polarnet.runtime.cluster.pmap` with its workers bound, or the built-in `map`; each of its tasks makes one part of
    the stores, and a run after an interruption the missing parts. Pictures too small for the sensor and its motion are
    skipped with a warning; ValueError if none is left.
    """
    manifest = read_manifest(synthesis.images)
    motions, skipped = motions_of(manifest, synthesis.motion, synthesis.seed, synthesis.variation)
    for picture in skipped:
        logger.warning("skipped %s: %s", picture.file, picture.reason)
    if not motions:
        raise ValueError(f"none of {len(skipped)} pictures can be used:{listed(skipped)}")
    used = {motion.picture for motion in motions}
    entries = [entry for entry in manifest.pictures if entry.name in used]
    scene_store, frame_store = _create(scenes, frames, entries, motions, synthesis)
    motion_of = {motion.sequence: motion for motion in motions}
    missing = sorted({*scene_store.missing_parts(), *frame_store.missing_parts()})
    task = functools.partial(_synthesize_part, scene_store, frame_store, synthesis)
    for _ in mapper(task, [[motion_of[sequence] for sequence in scene_store.parts[part]] for part in missing]):
        pass
    scene_store.finish()
    frame_store.finish()
    return len(motions)


def motions_of(
    manifest: Manifest, config: SynthesizeConfig, seed: int, variation: VariationConfig | None = None
) -> tuple[list[Motion], list[Skipped]]:
    """Motions over all scenes, and the pictures that are too small for the sensor and its motion."""
    motions, skipped = [], []
    for entry in manifest.pictures:
        variants = variation.scenes_per_picture if variation and entry.split == "train" else 0
        scenes = [entry.name, *(f"{entry.name}-variant{k:02d}" for k in range(1, variants + 1))]
        names = [(f"{scene}-{number:02d}", scene) for scene in scenes for number in range(config.sequences_per_picture)]
        size = entry.height, entry.width
        try:
            paths = [random_trajectory(config, *size, generator_for(seed, name, "motion")) for name, _ in names]
        except ValueError as error:
            skipped.append(Skipped(entry.origin, str(error)))
            continue
        motions += [Motion(*name, entry.name, entry.split, path) for name, path in zip(names, paths, strict=True)]
    return motions, skipped


def _create(
    scenes: str | Path, frames: str | Path, entries: list[ManifestEntry], motions: list[Motion], synthesis: Synthesis
) -> tuple[SceneStore, FrameStore]:
    """Two unfinished stores; their attributes record all inputs, so that only an equal run resumes them."""
    config, variation, per_part = synthesis.motion, synthesis.variation, synthesis.sequences_per_part
    files = [(entry.file.encode(), b"\0", bytes.fromhex(sha256(synthesis.images / entry.file))) for entry in entries]
    attributes: dict[str, Any] = {
        "synthesize": asdict(config),
        "variation": asdict(variation) if variation else None,
        "layout": synthesis.polarizers.layout,
        "seed": synthesis.seed,
        "images_sha256": sha256(*itertools.chain.from_iterable(files)),
    }
    scene_of = {motion.sequence: motion.scene for motion in motions}
    splits = {motion.sequence: motion.split for motion in motions}
    variant_of = {motion.sequence: motion.picture for motion in motions if motion.scene != motion.picture}
    masked = any(entry.masked_fraction for entry in entries)  # null for photographs
    if masked and synthesis.polarizers.crosstalk:
        attributes["crosstalk"] = synthesis.polarizers.crosstalk
    contents = Contents(splits, attributes, variant_of, masked, per_part)
    sensor = config.sensor_height, config.sensor_width
    scene_store = SceneStore.create(scenes, contents, scene_of, sensor)
    contents = replace(contents, attributes={**attributes, "scenes": scene_of})
    height, width, _ = grid(synthesis.polarizers.layout, *sensor)
    frame_store = FrameStore.create(frames, contents, height, width)
    return scene_store, frame_store


@one_thread()
def _synthesize_part(scenes: SceneStore, frames: FrameStore, synthesis: Synthesis, motions: Sequence[Motion]) -> None:
    """Write the part of both stores that holds the sequences of these motions."""
    config, polarizers, valid = synthesis.motion, synthesis.polarizers, None
    t_us, pixels = frame_times_us(config), grid(polarizers.layout, config.sensor_height, config.sensor_width)
    for (name, picture), over_scene in itertools.groupby(steps(motions), lambda motion: (motion.scene, motion.picture)):
        planes, dynamic_range = _planes_of(name, picture, synthesis)
        if not scenes.masked:
            planes = planes._replace(valid=None)
        scene = stretched(scene_from_polarization(planes.s0, planes.dolp, planes.aolp), dynamic_range)
        for sequence, *_, trajectory in over_scene:
            scenes.write(sequence, planes, asdict(trajectory), t_us[-1], dynamic_range)
            if planes.valid is not None:
                valid = valid_frames(planes.valid, trajectory, t_us, pixels, polarizers.crosstalk)
            frames.write(sequence, torch.tensor(t_us), *frames_of(scene, trajectory, t_us, *pixels), valid)


def _planes_of(scene: str, picture: str, synthesis: Synthesis) -> tuple[Polarization, float | None]:
    """Scene made from a picture, quantised as stored, and the dynamic range to which `stretched` stretches it.

    Events and truth are rendered from the same values. The mask of known pixels is None where all are known.
    """
    dynamic_range, valid = synthesis.motion.dynamic_range, None
    measured, light, rgb = (synthesis.images / f"{picture}{suffix}" for suffix in (".npz", LIGHT, ".png"))
    if light.exists():
        polarization = scene_module.polarization_from_light(np.load(light).transpose(2, 0, 1))
    elif measured.exists():
        intensities, valid = read_intensities(measured)
        s = scene_module.scene_from_intensities(intensities).stokes
        polarization = torch.stack([s[0].clamp(max=1), stokes.dolp(s).clamp(max=1), stokes.aolp(s)])
    else:
        polarization = scene_module.polarization_from_rgb(read_rgb(rgb))
    if synthesis.variation and scene != picture:
        polarization = varied(polarization, synthesis.variation, generator_for(synthesis.seed, scene, "variation"))
    s0, dolp, aolp = polarization
    if light.exists():
        s0, dynamic_range = logarithmic(s0, LIGHT_RANGE), LIGHT_RANGE
    return as_stored(Polarization(s0, dolp, aolp, valid)), dynamic_range
