"""Baselines that the pipeline trains, one record each, collected from the modules of this folder."""

import importlib
import pkgutil
from pathlib import Path

from polarnet.training.engine.task import Baseline

_NAMES = [name for _, name, _ in pkgutil.iter_modules([str(Path(__file__).parent)]) if name != "baselines"]
_RECORDS = [getattr(importlib.import_module(f"{__package__}.{name}"), "BASELINE", None) for name in _NAMES]

BASELINES: dict[str, Baseline] = {record.name: record for record in _RECORDS if record is not None}
"""Baseline by name, the section of `baselines` in params.yaml."""
