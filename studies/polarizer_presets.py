"""Measurements of the polarizers of conf/polarizers: python -m studies.polarizer_presets [--write]

Each preset looks at fully polarized light at 36 angles and at a built-in photograph. DoLP and AoLP come from its four
channels by Eq. 1 to 3, without calibration.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from polarnet.events.mosaic import places_of
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.pictures.images import read_rgb
from polarnet.pictures.polarimetry import demosaic
from polarnet.simulation.motion import render, resting_trajectory
from polarnet.simulation.polarizers import PolarizersConfig, weights_of
from polarnet.simulation.presets import POLARIZERS
from polarnet.simulation.rendering import channel_light
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization, scene_from_rgb
from polarnet.stokes import aolp, dolp, parse_mosaic, stokes_from_intensities
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).parents[1]
SIZE = (200, 300)  # rows and columns of the sensor
PHOTO = "coffee.png"
ANGLES_DEG = range(0, 180, 5)
BORDER = 4  # pixels of the sensor left out: a mosaic's demosaicked channels do not reach the border


def measured_stokes(scene: PolarizationScene, polarizers: PolarizersConfig) -> Float64[Tensor, "3 h w"]:
    """Stokes parameters from the channels of a still sensor in the middle of the scene, at full size.

    The channels of a DoFP sensor are interpolated at the centres of cells, and each cell is shown as 2x2 pixels.
    """
    channels = channels_of(scene, polarizers)
    if polarizers.layout == "dofp":
        raw = np.empty(SIZE)
        for channel, (row, column) in zip(channels, places_of(parse_mosaic(polarizers.mosaic)), strict=True):
            raw[row::2, column::2] = channel
        inner = demosaic(raw, parse_mosaic(polarizers.mosaic))
        missing = [(SIZE[axis] // 2 - inner.shape[axis + 1]) // 2 for axis in (0, 1)]
        cells = np.pad(inner, ((0, 0), *((border, border) for border in missing)), "edge")
        channels = cells.repeat(2, axis=1).repeat(2, axis=2)
    return stokes_from_intensities(torch.from_numpy(channels))


def channels_of(scene: PolarizationScene, polarizers: PolarizersConfig) -> Float64[np.ndarray, "4 h2 w2"]:
    """Light of the four channels, in [0, 1], of a still sensor in the middle of the scene."""
    weights = weights_of(polarizers, *SIZE, key=1)
    return channel_light(_stokes(scene), polarizers, weights)[:, 0].astype(np.float64) / 255


def _stokes(scene: PolarizationScene) -> Float32[np.ndarray, "3 1 h w"]:
    """Stokes parameters of the scene on the still sensor in its middle."""
    middle = replace(resting_trajectory(*SIZE), x=(scene.width - 1) / 2, y=(scene.height - 1) / 2)
    return render(scene, middle, np.zeros(1), *SIZE).numpy().transpose(1, 0, 2, 3)


def true_stokes(scene: PolarizationScene) -> Float64[Tensor, "3 h w"]:
    """Stokes parameters of the scene under the same sensor."""
    top, left = (scene.height - SIZE[0]) // 2, (scene.width - SIZE[1]) // 2
    return scene.stokes[:, top : top + SIZE[0], left : left + SIZE[1]].double()


def photograph() -> PolarizationScene:
    """The built-in scene that the presets look at."""
    return scene_from_rgb(read_rgb(next(photo.path for photo in BUILTIN_PHOTOS if photo.file == PHOTO)))


def figures_of(polarizers: PolarizersConfig) -> dict[str, float]:
    """DoLP of fully polarized light, RMS error of its AoLP over pixels and angles, and RMS error of a scene's DoLP."""
    plane = torch.ones(SIZE)
    degrees, errors = [], []
    for angle_deg in ANGLES_DEG:
        light = scene_from_polarization(plane, plane, math.radians(angle_deg) * plane)
        stokes = inside(measured_stokes(light, polarizers))
        degrees.append(dolp(stokes))
        errors.append((torch.rad2deg(aolp(stokes)) - angle_deg + 90) % 180 - 90)
    scene = photograph()
    difference = dolp(inside(measured_stokes(scene, polarizers))).clamp(0, 1) - dolp(inside(true_stokes(scene)))
    return {
        "dolp_of_full_polarization": round(float(torch.stack(degrees).mean()), 4),
        "aolp_error_deg": round(float(torch.stack(errors).square().mean().sqrt()), 3),
        "scene_dolp_rms": round(float(difference.square().mean().sqrt()), 4),
    }


def inside(stokes: Float64[Tensor, "3 h w"]) -> Float64[Tensor, "3 h2 w2"]:
    """Without the border."""
    return stokes[:, BORDER:-BORDER, BORDER:-BORDER]


def measured(presets: Mapping[str, PolarizersConfig]) -> dict[str, Any]:
    """Section `polarizer_presets` of docs/results/camera.json."""
    return {
        "number": len(presets),
        "angles": len(ANGLES_DEG),
        "scene": PHOTO,
        "presets": {name: figures_of(preset) for name, preset in presets.items()},
    }


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/camera.json")
    arguments = arguments_of(parser)
    record, section = machine_record(ROOT), measured(POLARIZERS)
    print(json.dumps(section, indent=2))
    if arguments.write:
        print(f"written to {write_section(ROOT, 'camera', 'polarizer_presets', section, record).relative_to(ROOT)}")


if __name__ == "__main__":
    main()
