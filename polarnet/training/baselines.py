"""Baselines that the pipeline trains, one record each, collected from the modules of this folder."""

import importlib
import pkgutil

from polarnet import training
from polarnet.training.task import Baseline

_MODULES = sorted(name for _, name, _ in pkgutil.iter_modules(training.__path__) if name != "baselines")
_RECORDS = [getattr(importlib.import_module(f"{training.__name__}.{name}"), "BASELINE", None) for name in _MODULES]

BASELINES: dict[str, Baseline] = {record.name: record for record in _RECORDS if record is not None}
"""Baseline by name, the section of `baselines` in params.yaml."""
