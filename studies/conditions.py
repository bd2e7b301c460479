"""Conditions of `studies.robustness`: sets of pictures, sensors and lengths of windows."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from studies.rate import RATED
from studies.scored_pictures import ingested, part_of, sources_of

SENSORS: dict[str, tuple[str, ...]] = {
    "default": (),
    "noisy": ("sensor=noisy",),
    "noisy_300_hz": ("sensor=noisy", "emulate.cutoff_hz=300"),  # the default sensor's bandwidth
    "thresholds_0.1": ("emulate.contrast_threshold_on=0.1", "emulate.contrast_threshold_off=0.1"),
    "thresholds_0.4": ("emulate.contrast_threshold_on=0.4", "emulate.contrast_threshold_off=0.4"),
    "off_1.4_times_on": ("emulate.contrast_threshold_off=0.28",),
    "mismatch_0.06": ("emulate.contrast_threshold_sigma_on=0.06", "emulate.contrast_threshold_sigma_off=0.06"),
    "mismatch_half": ("emulate.contrast_threshold_sigma_on=0.1", "emulate.contrast_threshold_sigma_off=0.1"),
    "slow": ("synthesize.speed_min_px_s=10", "synthesize.speed_max_px_s=40"),
    "fast": (
        "synthesize.speed_min_px_s=160", "synthesize.speed_max_px_s=320", "synthesize.acceleration_max_px_s2=3200",
    ),
    "60_hz": ("synthesize.frame_rate_hz=60",),
    "260x346": ("synthesize.sensor_height=260", "synthesize.sensor_width=346"),
    "v2e": ("emulate.model=v2e",),
    "esim": ("emulate.model=esim",),
    "dvs_voltmeter": ("emulate.model=dvs_voltmeter",),
    "imperfect_polarizers": (
        "polarizers.extinction_ratio=[100,100,100,100]", "polarizers.angle_error_deg=[2,-2,-2,2]",
        "polarizers.transmission=[1,0.95,1,0.95]",
    ),
    "dofp": ("polarizers.layout=dofp", "synthesize.sensor_height=240", "synthesize.sensor_width=360"),
    "saturating_readout": ("readout.max_events_per_s=300000",),  # a sensor fires 500,000 a second on average
    "randomised": ("sensor=random",),
}  # fmt: skip
"""Overrides of params.yaml by name; the scenes are the same, at the same places where the sensor has the same size."""
TIMES: dict[str, tuple[str, ...]] = {"5ms": ("synthesize.frame_rate_hz=200",)}
"""Overrides that change the windows."""
BINNING = 2
"""Side in pixels of the blocks that the network is also scored and timed with."""


def conditions_of(
    images: Mapping[str, Path], arguments: argparse.Namespace
) -> dict[str, list[tuple[Path, tuple[str, ...]]]]:
    """Folders of pictures and overrides by condition; `images` are the ingested photographs."""
    work, limit = arguments.work, arguments.limit
    parts = {name: part_of(folder, work / name, arguments.split, limit) for name, folder in images.items()}
    conditions: dict[str, list[tuple[Path, tuple[str, ...]]]] = {"photographs": [(parts["rgb"], ())]}
    if "more" in parts:
        conditions["photographs_large"] = [(part, ()) for part in parts.values()]
    for folder in arguments.measured:
        for name, root in sources_of(folder, work).items():
            chosen = ("ingest.source=polarization", "ingest.val_fraction=0", "ingest.test_fraction=1")
            measured = ingested(root, work / name, *chosen)
            conditions[f"measured.{name}"] = [(part_of(measured, work / name, "test", limit), ())]
    small = part_of(images["rgb"], work / "rgb", arguments.split, arguments.sensor_limit or limit)
    others = {"sensors": SENSORS, "time": TIMES}
    scenes = [part for name, parts in conditions.items() if name.startswith("measured.") for part in parts]
    conditions[f"{RATED}.photographs"] = [(small, ())]
    if scenes:
        conditions[f"{RATED}.measured"] = scenes
    return conditions | {
        f"{kind}.{name}": [(small, overrides)] for kind, of in others.items() for name, overrides in of.items()
    }


def selected(conditions: Mapping[str, Any], wanted: Sequence[str] | None) -> dict[str, Any]:
    """The conditions whose names, or the beginnings of whose names, are `wanted`; None: all."""
    return {
        name: parts
        for name, parts in conditions.items()
        if wanted is None or any(name == one or name.startswith(f"{one}.") for one in wanted)
    }
