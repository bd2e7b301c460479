"""Baselines that the pipeline trains, one record each, collected from the modules of this folder."""

import importlib
import pkgutil
from pathlib import Path

from polarnet.training.engine.task import Baseline

_NAMES = [name for _, name, _ in pkgutil.iter_modules([str(Path(__file__).parent)]) if name != "baselines"]
_MODULES = {name: importlib.import_module(f"{__package__}.{name}") for name in _NAMES}

BASELINES: dict[str, Baseline] = {n: module.BASELINE for n, module in _MODULES.items() if hasattr(module, "BASELINE")}
"""Baseline by name of its module: its section of `baselines` in params.yaml, and its folder below data/train."""
