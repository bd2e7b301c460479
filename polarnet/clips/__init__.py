"""Videos and image sequences of the user's own, simulated as a polarization camera would see them."""

from typing import TYPE_CHECKING

from polarnet.terminal.lazy import attach

if TYPE_CHECKING:
    from polarnet.clips.video import VideoSimulation as VideoSimulation
    from polarnet.clips.video import simulate_video as simulate_video

__getattr__, __dir__, __all__ = attach(__name__, __file__)
