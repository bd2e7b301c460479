"""Stores of events, frames and scenes on disk, and their export for other tools."""

from typing import TYPE_CHECKING

from polarnet.terminal.lazy import attach

if TYPE_CHECKING:
    from polarnet.storage.events import EventStore as EventStore
    from polarnet.storage.frames import Contents as Contents
    from polarnet.storage.frames import FrameStore as FrameStore
    from polarnet.storage.scenes import SceneStore as SceneStore
    from polarnet.storage.true_frames import open_truth as open_truth

__getattr__, __dir__, __all__ = attach(__name__, __file__)
