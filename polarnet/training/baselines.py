"""Which baselines are trained: those whose weights a row of `benchmark.methods` uses."""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

USERS: Mapping[str, tuple[str, ...]] = {"e2v": ("e2v", "firenet", "e2vid"), "e2p": ("e2p",)}
"""A section of `baselines` that is a training: the rows of the benchmark that use its weights."""

NOT_TRAINED = "not_trained.json"


def is_used(baseline: str, rows: Sequence[str], methods: Any) -> bool:
    """Whether one of `rows`, with or without solved gains, uses the weights that the training of `baseline` leaves.

    A row whose weights are a file of their own does not: `methods.ROW.weights`, `methods` being that section of the
    configuration.
    """
    used = {row.removesuffix("+gain") for row in rows}
    return any(row in used and getattr(methods, row).weights is None for row in USERS[baseline])


def leave_untrained(baseline: str, folder: Path) -> str:
    """Empty the folder of a training that no row uses, but for `NOT_TRAINED` with the reason, which is returned."""
    reason = (
        f"no row of benchmark.methods uses weights of baselines.{baseline}, so none were trained; "
        f"{' or '.join(USERS[baseline])} among benchmark.methods would use them"
    )
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / NOT_TRAINED).write_text(json.dumps({"reason": reason}, indent=2) + "\n")
    return reason
