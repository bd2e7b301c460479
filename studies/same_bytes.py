"""Bytes of pictures, scenes, frames and events under other instruction sets and numbers of workers.

python -m studies.same_bytes [--write]

The functions of the stages ingest, synthesize and emulate make a set of smoke size, once with the default settings,
once under each of `studies.instruction_sets.SETTINGS`, and once with each of `WORKERS`. The files must be equal.
--write puts the number of settings with equal files into docs/results/reliability.json.
"""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from polarnet.config.tree import load
from polarnet.pictures.ingest import ingest
from polarnet.runtime.files import sha256
from polarnet.runtime.machine import configure, threads_of
from polarnet.simulation.dataset import emulate_scenes
from polarnet.simulation.truth import Synthesis, synthesize
from studies.faults import STORES, digest
from studies.instruction_sets import SETTINGS, checked_levels
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
ARTEFACTS = ("images", *STORES)
WORKERS = (2, 5)
SMALL = ("experiment=smoke", "storage.sequences_per_part=2")  # ten parts, so that five workers have work


def make(data: str, workers: int) -> None:
    """Make a set in the folder `data`, as the stages ingest, synthesize and emulate do."""
    config = load(ROOT, [*SMALL, f"paths.data={data}", f"runtime.workers={workers}"])
    configure(config.runtime, config.seed)
    paths, seed, per_part = config.paths, config.seed, config.storage.sequences_per_part
    images, scenes, frames, events = (Path(path) for path in (paths.images, paths.scenes, paths.frames, paths.events))
    ingest(config.ingest, seed, images, config.mapper("ingest"))
    synthesis = Synthesis(images, config.synthesize, seed, per_part, config.variation, config.polarizers.layout)
    synthesize(synthesis, scenes, frames, config.mapper("synthesize"))
    emulate_scenes(scenes, events, config.camera, seed, config.mapper("emulate"), threads_of(config.runtime))


def hashes(data: Path) -> dict[str, dict[str, str]]:
    """SHA-256 of each picture file, and of the columns and numbers of each sequence, by artefact."""
    items = {"images": {path.name: sha256(path) for path in sorted((data / "images").iterdir())}}
    for name, kind in STORES.items():
        store = kind.open(data / name)
        axes = {column.axis for column in store.columns.values()}  # the places of a sequence depend on the others
        for sequence in store.sequences:
            numbers = {key: value for key, value in store.record(sequence).items() if key not in axes}
            columns = [store.read_column(column, sequence) for column in store.columns]
            items.setdefault(name, {})[sequence] = digest(numbers, *columns)
    return items


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
            script = f"from studies.same_bytes import make; make({scratch!r}, {workers})"
            used = checked_levels(setting, script)
            items, all_bytes = hashes(Path(scratch)), bytes_of(Path(scratch))
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
