"""Events of one polarizer channel: columns, windows of time, dense representations, streaming."""

from typing import TYPE_CHECKING

from polarnet.terminal.lazy import attach

if TYPE_CHECKING:
    from polarnet.events.stream import Events as Events
    from polarnet.events.streaming import EventWindow as EventWindow

__getattr__, __dir__, __all__ = attach(__name__, __file__)
