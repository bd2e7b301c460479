"""`polarnet doctor`: versions, device and resources of this machine that matter to polarnet."""

import argparse
import functools
import platform
import shutil
from collections.abc import Callable, Iterator

import torch

from polarnet.metrics.lpips import BACKBONES, installed_version
from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.networks.weights import shipped_weights
from polarnet.runtime.files import sha256
from polarnet.runtime.machine import bf16_units, memory, usable_cores
from polarnet.terminal.installation import EXTRAS, installation, missing, requirements, versions


def doctor(options: argparse.Namespace) -> None:
    """Print a line on each finding."""
    for subject, finding in _findings():
        print(f"{subject:10} {finding}")


def _findings() -> Iterator[tuple[str, str]]:
    cuda = torch.cuda.is_available()
    gpus = ", ".join(torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())) if cuda else ""
    units = ", ".join(bf16_units(torch.device("cuda" if cuda else "cpu")))
    yield "system", f"Python {platform.python_version()}, {platform.platform()}"
    yield "packages", versions()
    yield "device", gpus or f"CPU ({platform.processor() or platform.machine()}); no GPU that torch can use"
    yield "threads", f"{usable_cores()} cores, torch uses {torch.get_num_threads()}"
    yield "bf16", units or "emulated here and slower than fp32; train.precision=auto therefore uses fp32"
    for backbone in BACKBONES:
        yield "LPIPS", f"{backbone}: {_or_error(functools.partial(installed_version, backbone))}"
    file = shipped_weights()
    digest = sha256(file)[:12]
    yield "weights", _or_error(lambda: f"{file} (network {load_checkpoint(file)[1]['network']}, sha256 {digest})")
    for extra, task in EXTRAS.items():
        yield "extra", f"{extra} ({task}): {_extra(extra)}"
    yield "memory", "{:.1f} of {:.1f} GiB free".format(*(amount / 2**30 for amount in memory()))
    yield "disk", f"{shutil.disk_usage('.').free / 2**30:.1f} GiB free here"


def _or_error(finding: Callable[[], str]) -> str:
    try:
        return finding()
    except (ValueError, FileNotFoundError) as error:
        return str(error)


def _extra(extra: str) -> str:
    if not requirements(extra):
        return f"not known to this installation; {installation(extra)}"
    absent = missing(extra)
    return f"{', '.join(absent)} missing; {installation(extra)}" if absent else "installed"
