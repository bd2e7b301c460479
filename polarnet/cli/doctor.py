"""Report on this machine: versions, device and resources that matter to polarnet."""

import importlib.metadata
import platform
import shutil
from collections.abc import Iterator

import psutil
import torch

from polarnet.metrics.lpips import BACKBONES
from polarnet.metrics.lpips_weights import local_source
from polarnet.runtime.machine import bf16_units, usable_cores

PACKAGES = ("torch", "numpy", "numba", "zarr", "OpenImageIO", "opencv-contrib-python-headless", "scikit-image",
            "dvc", "hydra-core")  # fmt: skip


def findings() -> Iterator[str]:
    """Readable lines on versions, device, threads, bf16 and AMX, LPIPS weights, memory and free disk space."""
    yield f"polarnet   {_version('polarnet')}"
    yield f"system     Python {platform.python_version()}, {platform.platform()}"
    yield "packages   " + ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    yield f"device     {_device()}"
    yield f"threads    {usable_cores()} cores, torch uses {torch.get_num_threads()}"
    yield f"bf16       {_bf16()}"
    for backbone in BACKBONES:
        yield f"LPIPS      {_lpips(backbone)}"
    memory = psutil.virtual_memory()
    yield f"memory     {memory.available / 2**30:.1f} of {memory.total / 2**30:.1f} GiB free"
    yield f"disk       {shutil.disk_usage('.').free / 2**30:.1f} GiB free here"


def _lpips(backbone: str) -> str:
    try:
        return f"{backbone}: {local_source(backbone, None)}"
    except ValueError as error:
        return str(error)


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"


def _device() -> str:
    if torch.cuda.is_available():
        return ", ".join(torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count()))
    return f"CPU ({platform.processor() or platform.machine()}); no GPU that torch can use"


def _bf16() -> str:
    units = bf16_units(torch.device("cuda" if torch.cuda.is_available() else "cpu"))
    return ", ".join(units) if units else "emulated here and slower than fp32; train.precision=auto therefore uses fp32"
