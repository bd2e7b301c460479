"""Colour photographs from scikit-image's wheel, so that a fresh clone has real pictures without a network."""

from dataclasses import dataclass
from importlib import resources
from pathlib import Path


@dataclass(frozen=True)
class BuiltinPhoto:
    """One file of scikit-image's data folder, with its origin as scikit-image states it."""

    file: str
    origin: str
    licence: str
    author: str

    @property
    def path(self) -> Path:
        """Path in the installed scikit-image."""
        return Path(str(resources.files("skimage"))) / "data" / self.file


# Origins, licences and authors from the docstrings of skimage.data, scikit-image 0.26. Of the stereo pair of
# the motorcycle only the left half is here: both show one scene, which must not be in two splits.
BUILTIN_PHOTOS = tuple(BuiltinPhoto(*fields) for fields in (
    ("astronaut.png", "https://flic.kr/p/r9qvLn", "public domain (no known copyright restrictions)", "NASA"),
    ("chelsea.png", "skimage.data.chelsea", "CC0-1.0", "Stefan van der Walt"),
    ("coffee.png", "skimage.data.coffee, courtesy of Pikolo Espresso Bar", "CC0-1.0", "Rachel Michetti"),
    ("hubble_deep_field.jpg", "http://hubblesite.org/newscenter/archive/releases/2012/37/image/a/",
     "public domain (NASA media guidelines)", "NASA"),
    ("ihc.png", "skimage.data.immunohistochemistry", "no known copyright restrictions",
     "Center for Microscopy And Molecular Imaging (CMMI)"),
    ("motorcycle_left.png", "http://vision.middlebury.edu/stereo/data/scenes2014/",
     "unstated by scikit-image and the dataset; asks to cite Scharstein et al., GCPR 2014",
     "Nera Nesic, Porter Westling, Xi Wang, York Kitajima, Greg Krathwohl, Daniel Scharstein"),
    ("retina.jpg", "https://commons.wikimedia.org/wiki/File:Fundus_photograph_of_normal_left_eye.jpg", "CC0-1.0",
     "Mikael Häggström"),
    ("rocket.jpg", "https://www.flickr.com/photos/spacexphotos/16511594820/in/photostream/", "public domain", "SpaceX"),
))  # fmt: skip
"""Photographs in scikit-image's wheel.

>>> from polarnet.pictures import BUILTIN_PHOTOS
>>> BUILTIN_PHOTOS[2].path.name, BUILTIN_PHOTOS[2].licence
('coffee.png', 'CC0-1.0')
"""
