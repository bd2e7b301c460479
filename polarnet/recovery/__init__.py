"""From a recording or a live camera to frames of polarization, pictures, video and a page."""

from typing import TYPE_CHECKING

from polarnet.terminal.lazy import attach

if TYPE_CHECKING:
    from polarnet.recovery.events import Recovery as Recovery
    from polarnet.recovery.events import recover as recover

__getattr__, __dir__, __all__ = attach(__name__, __file__)
