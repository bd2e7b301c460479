"""From pictures to polarization events: scenes, motion, and the pixels of an event camera.

`from polarnet.simulation import simulate, SENSORS` loads the modules of these names on first use. Importing the package
alone loads none.
"""

from typing import TYPE_CHECKING

from polarnet.terminal.lazy import attach

if TYPE_CHECKING:
    from polarnet.pictures.builtin import BUILTIN_PHOTOS as BUILTIN_PHOTOS
    from polarnet.pictures.images import read_light as read_light
    from polarnet.pictures.images import read_rgb as read_rgb
    from polarnet.simulation.camera import Camera as Camera
    from polarnet.simulation.camera import pixel_analyzers as pixel_analyzers
    from polarnet.simulation.emulator import EmulatorConfig as EmulatorConfig
    from polarnet.simulation.emulator import SensorState as SensorState
    from polarnet.simulation.emulator import emulate as emulate
    from polarnet.simulation.motion import SynthesizeConfig as SynthesizeConfig
    from polarnet.simulation.motion import Trajectory as Trajectory
    from polarnet.simulation.motion import random_trajectory as random_trajectory
    from polarnet.simulation.moving_sensor import emulate_motion as emulate_motion
    from polarnet.simulation.presets import MOTIONS as MOTIONS
    from polarnet.simulation.presets import POLARIZERS as POLARIZERS
    from polarnet.simulation.presets import SENSORS as SENSORS
    from polarnet.simulation.scene import PolarizationScene as PolarizationScene
    from polarnet.simulation.scene import scene_from_intensities as scene_from_intensities
    from polarnet.simulation.scene import scene_from_light as scene_from_light
    from polarnet.simulation.scene import scene_from_polarization as scene_from_polarization
    from polarnet.simulation.scene import scene_from_rgb as scene_from_rgb
    from polarnet.simulation.sequence import Simulation as Simulation
    from polarnet.simulation.sequence import simulate as simulate

__getattr__, __dir__, __all__ = attach(__name__, __file__)
