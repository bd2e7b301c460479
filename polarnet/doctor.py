"""What this machine offers polarnet."""

import importlib.metadata
import platform
import shutil
from collections.abc import Iterator

import psutil
import torch

from polarnet.lpips import BACKBONES, LpipsConfig, lpips_problem
from polarnet.runtime import usable_cores

PACKAGES = ("torch", "numpy", "numba", "zarr", "OpenImageIO", "opencv-contrib-python-headless", "scikit-image",
            "dvc", "hydra-core")  # fmt: skip


def findings() -> Iterator[str]:
    """Lines for a person: versions, device, threads, bf16 and AMX, LPIPS weights, memory, free disk."""
    yield f"polarnet   {_version('polarnet')}"
    yield f"system     Python {platform.python_version()}, {platform.platform()}"
    yield "packages   " + ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    yield f"device     {_device()}"
    yield f"threads    {usable_cores()} cores, torch uses {torch.get_num_threads()}"
    yield f"bf16       {_bf16()}"
    for backbone in BACKBONES:
        problem = lpips_problem(LpipsConfig(backbone=backbone, path=None, required=False))
        yield f"LPIPS      {backbone}: {problem or 'weights found'}"
    memory = psutil.virtual_memory()
    yield f"memory     {memory.available / 2**30:.1f} of {memory.total / 2**30:.1f} GiB free"
    yield f"disk       {shutil.disk_usage('.').free / 2**30:.1f} GiB free here"


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
    if torch.cuda.is_available():
        return "CUDA, fast" if torch.cuda.is_bf16_supported() else "not on this GPU: set train.precision=fp32"
    if not torch.backends.mkldnn.is_available():
        return "no oneDNN in this torch: set train.precision=fp32"
    amx, avx512 = torch.cpu._is_amx_tile_supported(), torch.cpu._is_avx512_bf16_supported()
    found = [name for name, there in (("AMX", amx), ("AVX512-BF16", avx512)) if there]
    return ", ".join(found) if found else "emulated on this processor, slow: set train.precision=fp32"
