"""Bytes of pictures, scenes, frames and events under other instruction sets and numbers of workers.

python -m studies.same_bytes [--write]

The stages ingest, synthesize and emulate make a set of smoke size, once with the default settings, once under each of
`studies.instruction_sets.SETTINGS`, and once with each of `WORKERS`. The files must be equal. --write puts the number
of settings with equal files into docs/results/reliability.json.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from polarnet.runtime.files import sha256
from studies.faults import STORES, digest
from studies.instruction_sets import SETTINGS, checked_levels, environment
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
STAGES = ("ingest", "synthesize", "emulate")
ARTEFACTS = ("images", *STORES)
WORKERS = (2, 5)
SMALL = ("experiment=smoke", "storage.sequences_per_part=2")  # ten parts, so that five workers have work


def make(setting: Mapping[str, str], workers: int, scratch: Path) -> Path:
    """The folder of a set that the stages made under a setting."""
    variables = environment(setting) | {"NUMBA_CACHE_DIR": str(scratch / "numba")}
    for stage in STAGES:
        words = [*SMALL, f"paths.data={scratch}", f"runtime.workers={workers}", f"hydra.run.dir={scratch / stage}"]
        subprocess.run([sys.executable, "-m", f"stages.{stage}", *words], cwd=ROOT, env=variables, check=True)
    return scratch


def hashes(data: Path) -> dict[str, dict[str, str]]:
    """SHA-256 of each picture file, and of the columns and numbers of each sequence, by artefact."""
    found = {"images": {path.name: sha256(path) for path in sorted((data / "images").iterdir())}}
    for name, kind in STORES.items():
        store = kind.open(data / name)
        axes = {column.axis for column in store.columns.values()}  # the places of a sequence depend on the others
        for sequence in store.sequences:
            numbers = {key: value for key, value in store.record(sequence).items() if key not in axes}
            columns = [store.read_column(column, sequence) for column in store.columns]
            found.setdefault(name, {})[sequence] = digest(numbers, *columns)
    return found


def bytes_of(data: Path) -> str:
    """SHA-256 of the names and bytes of all files of the artefacts."""
    files = sorted(path for name in ARTEFACTS for path in (data / name).rglob("*") if path.is_file())
    return sha256(*(part for path in files for part in (path.relative_to(data).as_posix().encode(), path)))


def compared() -> dict[str, dict[str, Any]]:
    """For each run: workers, levels, how many items differ from the default run, and whether all bytes are equal.

    Items are files of pictures, or sequences of a store.
    """
    runs: dict[str, tuple[Mapping[str, str], int]] = {"default": ({}, 1)}
    runs |= {name: (setting, 1) for name, setting in SETTINGS.items()}
    runs |= {f"{workers} workers": ({}, workers) for workers in WORKERS}
    rows: dict[str, dict[str, Any]] = {}
    reference: dict[str, dict[str, str]] = {}
    reference_bytes = ""
    for name, (setting, workers) in runs.items():
        with tempfile.TemporaryDirectory() as scratch:
            used, data = checked_levels(setting), make(setting, workers, Path(scratch))
            items, all_bytes = hashes(data), bytes_of(data)
        reference, reference_bytes = reference or items, reference_bytes or all_bytes
        rows[name] = {"workers": workers, "levels": used, "equal": all_bytes == reference_bytes}
        for artefact, expected in reference.items():
            different = sum(items[artefact].get(key) != value for key, value in expected.items())
            rows[name][artefact.removesuffix(".zarr")] = {"different": different, "of": len(expected)}
        print(name, json.dumps(rows[name]), flush=True)
    return rows


def main() -> None:
    """The command line."""
    arguments = arguments_of(command_line(__doc__, "docs/results/reliability.json"))
    record = machine_record(ROOT)
    rows = compared()
    equal = sum(rows[name]["equal"] for name in SETTINGS)
    print(f"{equal} of {len(SETTINGS)} settings give the same files")
    if arguments.write:
        headlines = {"isa_settings_equal": equal}
        print(write_section(ROOT, "reliability", "same_bytes", rows, record, headlines))


if __name__ == "__main__":
    main()
