"""The folder that a stage writes for real recordings, which says whether they are in use."""

import json
import shutil
from pathlib import Path

STATUS_FILE = "status.json"


def start_over(out: Path, *, enabled: bool) -> None:
    """An empty folder but for what it says."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    (out / STATUS_FILE).write_text(json.dumps({"enabled": enabled}) + "\n")
