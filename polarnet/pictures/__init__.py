"""Pictures from files, from scikit-image and from seeds: one size, one colour space, split by source picture."""

from typing import TYPE_CHECKING

from polarnet.terminal.lazy import attach

if TYPE_CHECKING:
    from polarnet.pictures.builtin import BUILTIN_PHOTOS as BUILTIN_PHOTOS
    from polarnet.pictures.images import read_light as read_light
    from polarnet.pictures.images import read_rgb as read_rgb

__getattr__, __dir__, __all__ = attach(__name__, __file__)
