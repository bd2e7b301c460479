"""Extras of pyproject.toml: packages that polarnet needs for some tasks only."""

import importlib.metadata
import re

from polarnet.runtime.files import in_source_tree

EXTRAS = {
    "pipeline": "dvc repro",
    "cluster": "stages on a Dask cluster",
    "hdf5": "HDF5 files",
    "recordings": "camera files of DSEC and faery",
    "rosbag": "bags of ROS",
    "live": "a running camera",
    "remote": "stores in a bucket",
    "export": "polarnet onnx",
    "rerun": "polarnet view --rerun",
    "sweep": "sweeps and searches",
}
"""Task of each extra."""


def requirements(extra: str) -> list[str]:
    """Packages of an extra with their versions; none if polarnet runs from source without being installed."""
    try:
        lines = importlib.metadata.requires("polarnet") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    chosen = re.compile(rf"""extra\s*==\s*['"]{extra}['"]""")
    return [line.split(";")[0].strip() for line in lines if chosen.search(line) and not line.startswith("polarnet[")]


def missing(extra: str) -> list[str]:
    """Packages of an extra that are not installed."""
    names = [re.split(r"[<>=!~\[ ]", one)[0] for one in requirements(extra)]
    return [name for name in names if not _installed(name)]


def installation(extra: str) -> str:
    """Advice for an error about a missing package.

    polarnet is on no package index, so it names the clone, or the packages where polarnet came as a wheel.
    """
    if in_source_tree():
        return f"run pip install -e '.[{extra}]' in the clone"
    return f"run pip install {' '.join(map(repr, requirements(extra)))}"


def _installed(package: str) -> bool:
    try:
        importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True
