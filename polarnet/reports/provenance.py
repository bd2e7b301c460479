"""Provenance of a report: the code, machine and package versions behind it."""

import importlib.metadata
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from polarnet.runtime.machine import usable_cores

PACKAGES = ("polarnet", "torch", "numpy", "numba", "zarr", "opencv-contrib-python-headless", "dvc", "hydra-core")


@dataclass(frozen=True)
class Run:
    """Provenance of a run's results, as shown on the page."""

    command: str
    """Command that reproduces the results."""
    parameters: Mapping[str, Any]
    """The params.yaml in use: sections and single values."""
    facts: Mapping[str, str]
    """Seed, commit, machine, versions."""


def facts(root: Path) -> dict[str, str]:
    """Commit of the project at `root`, if any, and machine and versions of this process."""
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES)
    return {
        "commit": _commit(root),
        "machine": f"{processor()}, {usable_cores()} cores, {platform.system()} {platform.machine()}",
        "versions": f"Python {platform.python_version()}, {versions}",
    }


def _commit(root: Path) -> str:
    commit = git(root, "rev-parse", "HEAD")
    if not commit:
        return "none: not a git repository with a commit"
    # the pipeline's own outputs do not count as changes of the code
    changed = git(root, "status", "--porcelain", "--untracked-files=no", "--", ".", ":!dvc.lock", ":!data")
    return f"{commit}, with uncommitted changes" if changed else commit


def git(root: Path, *arguments: str) -> str:
    """Output of a git command; empty if it fails."""
    try:
        done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True)
    except FileNotFoundError:  # git is not installed
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def processor() -> str:
    """The processor's name, as reported by the system."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
