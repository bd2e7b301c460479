"""From pictures to polarization events: scenes, motion, and the pixels of an event camera.

`from polarnet.simulation import simulate, SENSORS` loads the modules of these names on first use. Importing the package
alone loads none.
"""

from importlib import import_module
from typing import Any

MODULE_OF = {
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
"""Module of each public name."""

__all__ = list(MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *MODULE_OF])
