"""Pictures -> scenes, trajectories and the exact frames that an ideal camera in their place would take."""

import dataclasses
import functools
import hashlib
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from polarnet import stokes
from polarnet.events.frames import FrameStore
from polarnet.runtime import generator_for, one_thread
from polarnet.simulation.motion import MotionConfig, Trajectory, frame_times_us, random_trajectory, render
from polarnet.simulation.pictures.images import read_rgb
from polarnet.simulation.pictures.manifest import Manifest, ManifestEntry, read_manifest
from polarnet.simulation.pictures.polarimetry import read_intensities
from polarnet.simulation.scene import (
    PolarizationScene,
    polarization_from_rgb,
    scene_from_intensities,
    scene_from_polarization,
)
from polarnet.simulation.scenes import SceneStore, made_from, variant_name
from polarnet.simulation.variation import VariationConfig, varied

logger = logging.getLogger(__name__)

REASONS_SHOWN = 5


@one_thread()
def frames_of(
    scene: PolarizationScene, trajectory: Trajectory, t_us: Sequence[int], height: int, width: int
) -> tuple[Float[Tensor, "n 4 h w"], Float[Tensor, "n h w"], Float[Tensor, "n h w"]]:
    """(intensity behind the four polarizers, DoLP, AoLP) that a window of a scene sees at times in microseconds.

    Light mixes between pixels, angles do not: all three follow from the interpolated Stokes vector.
    """
    seen = render(scene, trajectory, np.asarray(t_us) * 1e-6, height, width)
    return stokes.intensities_from_stokes(seen).clamp(0, 1), stokes.dolp(seen).clamp(0, 1), stokes.aolp(seen)


def valid_frames(
    valid: Bool[Tensor, "h1 w1"], trajectory: Trajectory, t_us: Sequence[int], height: int, width: int
) -> Bool[Tensor, "n h w"]:
    """Where a window of a scene shows known light: at pixels whose interpolation uses valid pixels of the scene alone.

    The weights of the interpolation are not negative, so that a masked plane seen through it is 0 just there.
    """
    masked = (~valid).float()
    seen = render(PolarizationScene(masked.expand(3, -1, -1)), trajectory, np.asarray(t_us) * 1e-6, height, width)
    return seen[:, 0] == 0


def synthesize(
    images: Path,
    scenes: Path,
    frames: Path,
    config: MotionConfig,
    seed: int,
    mapper: Callable[..., Iterable[Any]],
    variation: VariationConfig | None = None,
) -> int:
    """Fill both stores with `sequences_per_picture` sequences of every scene; how many there are.

    A scene is a picture of `images`, or a variant of one of the training split (`variation` None: there are none).

    `mapper` is `polarnet.cluster.pmap` with its workers bound, or the built-in `map`. Every trajectory depends on
    the seed and the sequence's name alone. An interrupted run goes on where it stopped.

    Warns about every picture too small for the window and its motion, and makes no scene of it; ValueError where none
    is left.
    """
    manifest = read_manifest(images)
    manifest = _large_enough(manifest, too_small(manifest, config, seed, variation))
    scene_store, frame_store = _create(manifest, images, scenes, frames, config, variation, seed)
    missing = {*scene_store.missing(), *frame_store.missing()}
    pictures = {scene_store.picture_of[sequence] for sequence in missing} | set(scene_store.missing_pictures())
    task = functools.partial(
        _synthesize_scene,
        images=images,
        scenes=scene_store,
        frames=frame_store,
        config=config,
        variation=variation,
        seed=seed,
    )
    for _ in mapper(task, sorted(pictures)):
        pass
    scene_store.finish()
    frame_store.finish()
    return len(scene_store.sequences)


def too_small(
    manifest: Manifest, config: MotionConfig, seed: int, variation: VariationConfig | None = None
) -> dict[str, str]:
    """The pictures in which the window cannot move as one of their sequences should: name and reason."""
    reasons = {}
    for entry in manifest.pictures:
        try:
            for sequence in (each for of in _sequences_of(entry, config, variation).values() for each in of):
                random_trajectory(config, entry.height, entry.width, generator_for(seed, sequence, "motion"))
        except ValueError as error:
            reasons[entry.name] = str(error)
    return reasons


def _sequences_of(
    entry: ManifestEntry, config: MotionConfig, variation: VariationConfig | None
) -> dict[str, list[str]]:
    """The names of a picture's scenes, and of the sequences of each."""
    variants = variation.scenes_per_picture if variation and entry.split == "train" else 0
    scenes = [entry.name, *(variant_name(entry.name, k) for k in range(1, variants + 1))]
    return {scene: [f"{scene}-{number:02d}" for number in range(config.sequences_per_picture)] for scene in scenes}


def _large_enough(manifest: Manifest, reasons: Mapping[str, str]) -> Manifest:
    """The manifest without the pictures that there are reasons against; ValueError with some where none is left."""
    for name, reason in reasons.items():
        logger.warning("skipped %s: %s", name, reason)
    kept = tuple(entry for entry in manifest.pictures if entry.name not in reasons)
    if not kept:
        shown = "".join(f"\n  {name}: {reason}" for name, reason in list(reasons.items())[:REASONS_SHOWN])
        raise ValueError(f"none of {len(reasons)} pictures can be used:{shown}")
    return dataclasses.replace(manifest, pictures=kept)


def _create(
    manifest: Manifest,
    images: Path,
    scenes: Path,
    frames: Path,
    config: MotionConfig,
    variation: VariationConfig | None,
    seed: int,
) -> tuple[SceneStore, FrameStore]:
    """Two unfinished stores; their attributes say what they are made from, so that only the same is resumed."""
    picture_of, splits = {}, {}
    for entry in manifest.pictures:
        for scene, sequences in _sequences_of(entry, config, variation).items():
            for sequence in sequences:
                picture_of[sequence], splits[sequence] = scene, entry.split
    attributes = {
        "synthesize": asdict(config),
        "variation": asdict(variation) if variation else None,
        "seed": seed,
        "images_sha256": _digest(manifest, images),
    }
    window = config.window_height, config.window_width
    largest = max(entry.height for entry in manifest.pictures), max(entry.width for entry in manifest.pictures)
    names = Trajectory.vector_names()
    masked = any(entry.masked_fraction for entry in manifest.pictures)  # null for photographs
    scene_store = SceneStore.create(
        scenes,
        picture_of,
        splits,
        largest_picture=largest,
        window=window,
        trajectory_names=names,
        attributes=attributes,
        masked=masked,
    )
    n_frames = len(frame_times_us(config))
    frame_attributes = {**attributes, "scenes": picture_of}
    frame_store = FrameStore.create(frames, list(picture_of), splits, n_frames, *window, frame_attributes, masked)
    return scene_store, frame_store


@one_thread()
def _synthesize_scene(
    picture: str,
    images: Path,
    scenes: SceneStore,
    frames: FrameStore,
    config: MotionConfig,
    variation: VariationConfig | None,
    seed: int,
) -> None:
    """Write one picture, or a variant of it, and all its sequences."""
    source = made_from(picture)
    polarization, valid = _read_polarization(images, source)
    if variation and source != picture:
        polarization = varied(polarization, variation, generator_for(seed, picture, "variation"))
    s0, dolp, aolp = polarization
    scenes.write_picture(picture, s0, dolp, aolp, valid if scenes.masked else None)
    height, width = s0.shape
    t_us = frame_times_us(config)
    for sequence in [name for name, of in scenes.picture_of.items() if of == picture]:
        trajectory = random_trajectory(config, height, width, generator_for(seed, sequence, "motion"))
        scenes.write(sequence, torch.from_numpy(trajectory.to_vector()), t_us[-1])
        record = scenes.read(sequence)  # quantised: the scene that is emulated, and so the truth
        scene = scene_from_polarization(record.s0, record.dolp, record.aolp)
        seen = frames_of(scene, trajectory, t_us, config.window_height, config.window_width)
        known = None
        if record.valid is not None:
            known = valid_frames(record.valid, trajectory, t_us, config.window_height, config.window_width)
        frames.write(sequence, torch.tensor(t_us), *seen, known)


def _read_polarization(images: Path, picture: str) -> tuple[Float[Tensor, "3 h w"], Bool[Tensor, "h w"] | None]:
    """(S0, DoLP, AoLP) of a photograph, by its colours, or of a measurement, and where that is known (None: all)."""
    measured = images / f"{picture}.npz"
    if not measured.exists():
        return polarization_from_rgb(read_rgb(images / f"{picture}.png")), None
    intensities, valid = read_intensities(measured)
    seen = scene_from_intensities(intensities).stokes
    return torch.stack([seen[0].clamp(max=1), stokes.dolp(seen).clamp(max=1), stokes.aolp(seen)]), valid


def _digest(manifest: Manifest, images: Path) -> str:
    """Of all picture files."""
    digest = hashlib.sha256()
    for entry in manifest.pictures:
        digest.update(entry.file.encode() + b"\0" + hashlib.sha256((images / entry.file).read_bytes()).digest())
    return digest.hexdigest()
