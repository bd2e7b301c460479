"""Report on this machine: versions, device and resources that matter to polarnet."""

import importlib.metadata
import platform
import shutil
from collections.abc import Iterator
from pathlib import Path

import psutil
import torch

from polarnet.cli.project import settings_root
from polarnet.config.pipeline import setup_of
from polarnet.config.tree import load
from polarnet.methods import METHODS
from polarnet.metrics.lpips import BACKBONES, local_source
from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.networks.weights import shipped_weights
from polarnet.runtime.files import sha256
from polarnet.runtime.machine import bf16_units, usable_cores
from polarnet.terminal.installation import EXTRAS, installation, missing, requirements

PACKAGES = ("torch", "numpy", "numba", "zarr", "OpenImageIO", "opencv-contrib-python-headless", "scikit-image",
            "dvc", "hydra-core")  # fmt: skip


def findings() -> Iterator[str]:
    """Readable lines on versions, device, bf16 and AMX, weights, extras, memory and free disk space."""
    yield f"polarnet   {_version('polarnet')}"
    yield f"system     Python {platform.python_version()}, {platform.platform()}"
    yield "packages   " + ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    yield f"device     {_device()}"
    yield f"threads    {usable_cores()} cores, torch uses {torch.get_num_threads()}"
    yield f"bf16       {_bf16()}"
    for backbone in BACKBONES:
        yield f"LPIPS      {_lpips(backbone)}"
    yield f"weights    {_shipped()}"
    for extra, task in EXTRAS.items():
        yield f"extra      {_extra(extra, task)}"
    memory = psutil.virtual_memory()
    yield f"memory     {memory.available / 2**30:.1f} of {memory.total / 2**30:.1f} GiB free"
    yield f"disk       {shutil.disk_usage('.').free / 2**30:.1f} GiB free here"


def rows_for(file: Path) -> Iterator[str]:
    """Rows that can use a file of weights, with the parameters of its network; ValueError if there are none."""
    config, reasons, matches = load(settings_root()), {}, 0
    for method in METHODS.values():
        if method.weights is None or method.wraps is not None:
            continue
        try:
            recoverer = method.open(setup_of(config, method, file))
        except (ValueError, FileNotFoundError, KeyError) as error:
            reasons[method.name] = str(error).partition("\n")[0][:160]
            continue
        matches += 1
        count = sum(one.numel() for one in recoverer.network.parameters()) if recoverer.network else 0
        yield f"{file.name}: row {method.name} ({method.label}), {count:,} parameters"
    if not matches:
        raise ValueError(f"{file}: no method can use it; " + "; ".join(f"{n}: {text}" for n, text in reasons.items()))


def _lpips(backbone: str) -> str:
    try:
        return f"{backbone}: {local_source(backbone, None)}"
    except ValueError as error:
        return str(error)


def _shipped() -> str:
    """The checkpoint that comes with the package, and its network."""
    try:
        file = shipped_weights()
    except FileNotFoundError as error:
        return str(error)
    return f"{file} (network {load_checkpoint(file)[1]['network']}, sha256 {sha256(file)[:12]})"


def _extra(extra: str, task: str) -> str:
    if not requirements(extra):
        return f"{extra} ({task}): not known to this installation; {installation(extra)}"
    absent = missing(extra)
    return f"{extra} ({task}): " + (f"{', '.join(absent)} missing; {installation(extra)}" if absent else "installed")


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
