"""Files from real cameras, read as events."""

from typing import TYPE_CHECKING

from polarnet.terminal.lazy import attach

if TYPE_CHECKING:
    from polarnet.recordings.arrangements import read_four as read_four
    from polarnet.recordings.arrangements import read_mosaic as read_mosaic
    from polarnet.recordings.recording import read_recording as read_recording

__getattr__, __dir__, __all__ = attach(__name__, __file__)
