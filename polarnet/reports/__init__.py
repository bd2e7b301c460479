"""Output for readers: figures, tables and pages."""

from typing import TYPE_CHECKING

from polarnet.terminal.lazy import attach

if TYPE_CHECKING:
    from polarnet.reports.preview import VideoWriter as VideoWriter
    from polarnet.reports.preview import write_true_video as write_true_video

__getattr__, __dir__, __all__ = attach(__name__, __file__)
