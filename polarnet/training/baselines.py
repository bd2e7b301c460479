"""Selection of the baselines to train: those whose weights a row of `benchmark.methods` uses."""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

USERS: Mapping[str, tuple[str, ...]] = {"e2v": ("e2v", "firenet", "e2vid"), "e2p": ("e2p",)}
"""For each trained section of `baselines`, the benchmark rows that use its weights."""

NOT_TRAINED = "not_trained.json"


def is_used(baseline: str, rows: Sequence[str], methods: Any) -> bool:
    """Whether one of `rows`, with or without `+gain`, uses the weights from the training of `baseline`.

    `methods` is that section of the configuration. A row with its own weights file (`methods.ROW.weights`) does not
    use the trained weights.
    """
    used = {row.removesuffix("+gain") for row in rows}
    return any(row in used and getattr(methods, row).weights is None for row in USERS[baseline])


def leave_untrained(baseline: str, folder: Path) -> str:
    """Empty the folder of an unused training, write the reason to `NOT_TRAINED` there, and return the reason."""
    reason = (
        f"no row of benchmark.methods uses weights of baselines.{baseline}, so none were trained; "
        f"{' or '.join(USERS[baseline])} among benchmark.methods would use them"
    )
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / NOT_TRAINED).write_text(json.dumps({"reason": reason}, indent=2) + "\n")
    return reason
