"""From pictures to polarization events: scenes, motion, and the pixels of an event camera.

`from polarnet.simulation import simulate, SENSORS` and the other names of `HOMES` load their modules when first asked
for, so that importing this package costs nothing.
"""

from importlib import import_module
from typing import Any

HOMES = {
    "BUILTIN_PHOTOS": "pictures.builtin",
    "EmulatorConfig": "emulator",
    "MOTIONS": "presets",
    "MotionConfig": "motion",
    "PolarizationScene": "scene",
    "SENSORS": "presets",
    "SensorState": "emulator",
    "Simulation": "sequence",
    "Trajectory": "motion",
    "emulate": "emulator",
    "random_trajectory": "motion",
    "read_rgb": "pictures.images",
    "scene_from_intensities": "scene",
    "scene_from_polarization": "scene",
    "scene_from_rgb": "scene",
    "simulate": "sequence",
    "emulate_motion": "moving_sensor",
}
"""The public names, and the module of each."""

__all__ = list(HOMES)


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *HOMES])
