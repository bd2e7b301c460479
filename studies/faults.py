"""Faults in a run's artefacts, and what the next reader makes of them: python -m studies.faults [--faults N] [--write]

The command damages copies of the artefacts of a finished run, one file at a time: a flipped bit, a truncation, a
deletion, an exchange with another file of its kind, or a changed digit of a text. After each fault the reader of the
next stage reads the whole artefact. It must refuse with one line that names the file or the folder, or read the same
values as before. --write puts the counts into docs/results/reliability.json.

--data names the `paths.data` of a finished run (`polarnet run experiment=smoke paths.data=FOLDER`).
"""

import dataclasses
import hashlib
import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from polarnet.benchmark.row_results import read_record, read_rows
from polarnet.metrics.lpips import Lpips, stored_record
from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.pictures.images import read_rgb
from polarnet.pictures.manifest import read_manifest
from polarnet.runtime.machine import generator_for
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.parts import Store
from polarnet.storage.scenes import SceneStore
from polarnet.training.engine.history import read_history
from polarnet.training.engine.recorder import read_running
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
STORES: dict[str, type[Store]] = {"events.zarr": EventStore, "frames.zarr": FrameStore, "scenes.zarr": SceneStore}
REFUSALS = (ValueError, OSError, RuntimeError, MemoryError)  # what stages and commands end with, in one line
TEXTS = (".json", ".csv", "SHA256SUMS")
OUTCOMES = ("refused", "harmless", "unnamed", "traceback", "silent", "lost")
BAD = ("unnamed", "traceback", "silent", "lost")


class Artefact(NamedTuple):
    """A folder of a run, and the reader of the next stage."""

    kind: str
    folder: Path
    read: Callable[[Path], str]
    """Hash of all values in a folder that the next stage uses."""


def digest(*values: Any) -> str:
    """Hash of arrays, tensors, bytes and plain values, one after another."""
    content = hashlib.sha256()
    for value in values:
        array = value.numpy() if isinstance(value, torch.Tensor) else value
        content.update(array.tobytes() if isinstance(array, np.ndarray) else repr(array).encode())
    return content.hexdigest()


def read_store(folder: Path) -> str:
    """All sequences of a store."""
    store = STORES[folder.name].open(folder)
    columns = [(name, store.read_column(column, name)) for name in store.sequences for column in store.columns]
    return digest(
        store.header, *(store.record(name) for name in store.sequences), *(part for pair in columns for part in pair)
    )


def read_images(folder: Path) -> str:
    """The manifest and the pictures that it lists."""
    manifest = read_manifest(folder)
    return digest(manifest, *(read_rgb(folder / entry.file) for entry in manifest.pictures))


def read_training(folder: Path) -> str:
    """The best weights of a training with their record, and its history."""
    tensors, metadata = load_checkpoint(folder / "best.safetensors")
    return digest(metadata, read_history(folder), *(part for name in sorted(tensors) for part in (name, tensors[name])))


def read_row(folder: Path) -> str:
    """Results of a row of the tables on every set."""
    record, sets = read_record(folder), sorted(path.name for path in folder.iterdir() if path.is_dir())
    return digest(record, *(read_benchmark(folder, name) for name in sets))


def read_benchmark(folder: Path, test_set: str) -> str:
    """Results of a row on one set."""
    results = read_rows({folder.name: folder}, test_set)
    maps = [frame for panel in results.panels for frame in panel.maps.values()]
    sums = [sum_ for row in results.reliability.values() for sum_ in dataclasses.astuple(row)]
    return digest(results.rows, results.costs, [sorted(panel.maps) for panel in results.panels], *maps, *sums)


def read_weights(folder: Path) -> str:
    """LPIPS of the table."""
    backbone = stored_record(folder, "benchmark")["backbone"]
    return digest(*Lpips.load(folder, "benchmark", backbone or "").state_dict().values())


def read_resume(folder: Path) -> str:
    """The running checkpoint of a training."""
    content = read_running(folder / "running.pt")
    return digest(sorted(content), content["progress"], *content["network"].values())


def artefacts_of(data: Path) -> Iterator[Artefact]:
    """The artefacts of a run, those that it has."""
    for path in sorted([*data.glob("*.zarr"), *data.glob("sets/*/*.zarr")]):
        if path.name in STORES:
            yield Artefact("store", path, read_store)
    for pattern, kind, read in (
        ("images", "images", read_images),
        ("train/*", "training", read_training),
        ("benchmark/rows/*", "row", read_row),
        ("weights", "LPIPS", read_weights),
        ("resume/*", "resume file", read_resume),
    ):
        for folder in sorted(path for path in data.glob(pattern) if path.is_dir() and any(path.iterdir())):
            yield Artefact(kind, folder, read)


def flip(content: bytes, generator: np.random.Generator) -> bytes:
    """One bit changed."""
    place, bit = int(generator.integers(len(content))), int(generator.integers(8))
    return content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]


def truncate(content: bytes, generator: np.random.Generator) -> bytes:
    """The beginning alone."""
    return content[: int(generator.integers(len(content)))]


def change_digit(content: bytes, generator: np.random.Generator) -> bytes:
    """One digit of a text changed to another; text without digits stays."""
    digits = [place for place, byte in enumerate(content) if 48 <= byte <= 57]
    if not digits:
        return content
    place = digits[int(generator.integers(len(digits)))]
    other = 48 + (content[place] - 48 + int(generator.integers(1, 10))) % 10
    return content[:place] + bytes([other]) + content[place + 1 :]


CHANGES = {"flip": flip, "truncation": truncate, "digit": change_digit}


def damage(file: Path, fault: str, folder: Path, generator: np.random.Generator) -> None:
    """Damage a file of an artefact in the way of `fault`."""
    if fault == "deletion":
        file.unlink()
    elif fault == "swap":
        others = sorted(path for path in folder.rglob(f"*{file.suffix}") if path.is_file() and path != file)
        if others:
            file.write_bytes(others[int(generator.integers(len(others)))].read_bytes())
    else:
        file.write_bytes(CHANGES[fault](file.read_bytes(), generator))


def outcome(artefact: Artefact, folder: Path, file: Path, undamaged: str) -> tuple[str, str]:
    """One of OUTCOMES for a damaged file, and the reader's message."""
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.stat().st_size < 2**16}
    try:
        same = artefact.read(folder) == undamaged
    except REFUSALS as error:
        named = any(name in str(error) for name in (file.name, file.stem, str(folder)))
        result = ("refused" if named and "\n" not in str(error) else "unnamed"), str(error)
    except Exception as error:
        result = "traceback", repr(error)
    else:
        result = ("harmless", "") if same else ("silent", "other values")
    changed = any(not path.exists() or path.read_bytes() != content for path, content in before.items())
    return ("lost", "the reader changed files") if changed else result


def inject(data: Path, faults: int, seed: int) -> tuple[Counter[tuple[str, str, str]], list[str]]:
    """Outcomes of `faults` faults by kind of artefact, fault and outcome, and a line for each bad one."""
    generator = generator_for(seed, "faults", "place and kind")
    counts: Counter[tuple[str, str, str]] = Counter()
    lines = []
    with tempfile.TemporaryDirectory() as scratch:
        copies: list[tuple[Artefact, Path, str]] = []
        for number, artefact in enumerate(artefacts_of(data)):
            copy = Path(scratch, str(number), artefact.folder.name)
            shutil.copytree(artefact.folder, copy)
            copies.append((artefact, copy, artefact.read(copy)))
        if not copies:
            raise SystemExit(f"--data {data}: no artefacts of a run there; `polarnet run experiment=smoke` makes some")
        kinds = sorted({artefact.kind for artefact, _, _ in copies})
        for number in range(faults):
            of_kind = [copy for copy in copies if copy[0].kind == kinds[number % len(kinds)]]
            artefact, folder, undamaged = of_kind[int(generator.integers(len(of_kind)))]
            files = sorted(path for path in folder.rglob("*") if path.is_file() and path.stat().st_size)
            file = files[int(generator.integers(len(files)))]
            possible = ["flip", "truncation", "deletion", "swap", *(["digit"] if file.name.endswith(TEXTS) else [])]
            fault, content = possible[int(generator.integers(len(possible)))], file.read_bytes()
            damage(file, fault, folder, generator)
            what, message = outcome(artefact, folder, file, undamaged)
            file.write_bytes(content)
            counts[artefact.kind, fault, what] += 1
            if what in BAD:
                lines.append(f"{what}: {fault} of {file.relative_to(scratch)} ({artefact.kind}): {message}")
                print(lines[-1], flush=True)
    return counts, lines


def figures_of(counts: Counter[tuple[str, str, str]]) -> dict[str, Any]:
    """Counts of outcomes, in all and for each kind of artefact."""
    total = Counter[str]()
    kinds: dict[str, Counter[str]] = {}
    for (kind, _, what), count in counts.items():
        total[what] += count
        kinds.setdefault(kind, Counter())[what] += count
    return {
        "faults_injected": total.total(),
        **{what: total[what] for what in OUTCOMES},
        "artefacts": {kind: {what: of_kind[what] for what in OUTCOMES} for kind, of_kind in sorted(kinds.items())},
        "faults": dict(sorted(Counter(fault for (_, fault, _), n in counts.items() for _ in range(n)).items())),
    }


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/reliability.json")
    parser.add_argument("--data", type=Path, default=ROOT / "outputs" / "run" / "smoke", help="`paths.data` of a run")
    parser.add_argument("--faults", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = arguments_of(parser)
    record = machine_record(ROOT)
    counts, _ = inject(arguments.data, arguments.faults, arguments.seed)
    figures = figures_of(counts)
    print(json.dumps(figures, indent=2))
    if arguments.write:
        headlines = {
            "faults_injected": figures["faults_injected"],
            "faults_lost": figures["lost"],
            "silent_uses": figures["silent"],
        }
        print(write_section(ROOT, "reliability", "artefacts", figures, record, headlines))


if __name__ == "__main__":
    main()
