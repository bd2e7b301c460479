"""From pictures to polarization events: scenes, motion, and the pixels of an event camera.

`from polarnet.simulation import simulate, SENSORS` loads the modules of these names on first use. Importing the package
alone loads none.
"""

from importlib import import_module
from typing import Any

MODULE_OF = {
    "BUILTIN_PHOTOS": "polarnet.pictures.builtin",
    "Camera": "polarnet.simulation.camera",
    "EmulatorConfig": "polarnet.simulation.emulator",
    "MOTIONS": "polarnet.simulation.presets",
    "SynthesizeConfig": "polarnet.simulation.motion",
    "POLARIZERS": "polarnet.simulation.presets",
    "PolarizationScene": "polarnet.simulation.scene",
    "SENSORS": "polarnet.simulation.presets",
    "SensorState": "polarnet.simulation.emulator",
    "Simulation": "polarnet.simulation.sequence",
    "Trajectory": "polarnet.simulation.motion",
    "emulate": "polarnet.simulation.emulator",
    "random_trajectory": "polarnet.simulation.motion",
    "read_rgb": "polarnet.pictures.images",
    "scene_from_intensities": "polarnet.simulation.scene",
    "scene_from_polarization": "polarnet.simulation.scene",
    "scene_from_rgb": "polarnet.simulation.scene",
    "simulate": "polarnet.simulation.sequence",
    "simulate_video": "polarnet.simulation.video",
    "emulate_motion": "polarnet.simulation.moving_sensor",
}
"""Module of each public name."""

__all__ = list(MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *MODULE_OF])
