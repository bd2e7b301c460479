"""The output folder of a stage for real recordings, with a file that says whether recordings are in use."""

import json
import shutil
from pathlib import Path

STATUS_FILE = "status.json"


def start_over(out: Path, *, enabled: bool) -> None:
    """Empty the folder and write its status file."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    (out / STATUS_FILE).write_text(json.dumps({"enabled": enabled}) + "\n")
