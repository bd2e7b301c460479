"""What damaged artefacts and killed writers do, and whether bytes are the same elsewhere: python -m studies.faults

- artefacts: copies of the artefacts of a finished run are damaged, one after another, by one of FAULTS. Used as the
  next stage would, an artefact must be refused with one line that names the file or the folder, or give the same values
  as before. --runs names projects with a finished run (`polarnet preset smoke`, then `dvc repro`); the first is
  damaged, the others, such as one with seed=2, serve for exchanges.
- kills: writers are killed at a random rename. The old or the new result must be whole, and a rerun must work.
- same_bytes: the stages ingest, synthesize and emulate run at smoke size on several workers, and with libraries that
  are restricted to older instructions of an x86-64 processor. Before each run, the libraries must say that they use no
  newer instructions. The files must be equal.

--only NAME runs one of them; --write puts the counts into docs/results/reliability.json.
"""

import hashlib
import itertools
import json
import multiprocessing
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from polarnet.benchmark.results import read_record, read_rows
from polarnet.cli.outputs import run_folder
from polarnet.config.origins import Run
from polarnet.config.tree import load
from polarnet.events.stream import Events
from polarnet.metrics.lpips import Lpips, stored_record
from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.pictures.images import read_rgb
from polarnet.pictures.manifest import read_manifest
from polarnet.runtime import files
from polarnet.runtime.files import ORIGIN, SUMS, seal, sha256
from polarnet.runtime.machine import generator_for
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.scenes import SceneStore
from polarnet.training.engine.recorder import read_history
from studies.study import ROOT, arguments_of, command_line, machine_record, run_stage, write_section

REFUSALS = (ValueError, OSError, RuntimeError, MemoryError)  # what stages and commands end with, in one line
TEXTS = (".json", ".csv", "SHA256SUMS")
OUTCOMES = ("refused", "harmless", "unnamed", "traceback", "silent", "lost")
WORKERS = (2, 5)
SMALL = ("experiment=smoke", "storage.sequences_per_part=2")  # ten parts, so that five workers have work
OLD_PROCESSOR = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "ATEN_CPU_CAPABILITY": "default",
    "ONEDNN_MAX_CPU_ISA": "SSE41",
    "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,FP16,AVX",
    "NUMBA_CPU_NAME": "generic",
    "NUMBA_CPU_FEATURES": "",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX2,-FMA,-AVX",
}
"""Variables that keep numpy, torch, oneDNN, OpenCV, numba and the C library from AVX and FMA."""

Generator = np.random.Generator
Fault = Callable[[Path, Sequence[Path], Generator], None]
"""Damages the artefact in a folder; further folders hold others of its kind."""


def digest(*values: Any) -> str:
    """Hash of arrays, tensors, bytes and plain values, one after another; tuples and lists count by their parts."""
    content = hashlib.sha256()
    for value in values:
        if isinstance(value, tuple | list):
            content.update(digest(*value).encode())
        else:
            array = value.numpy() if isinstance(value, torch.Tensor) else value
            content.update(array.tobytes() if isinstance(array, np.ndarray) else repr(array).encode())
    return content.hexdigest()


def read_store(folder: Path) -> str:
    """All sequences of a store of events, frames or scenes."""
    if folder.name == "events.zarr":
        events = EventStore.open(folder)
        return digest(*((name, [(e.t, e.x, e.y, e.p) for e in events.read(name)]) for name in events.sequences))
    store: Any = FrameStore.open(folder) if folder.name == "frames.zarr" else SceneStore.open(folder)
    read = store.frames if folder.name == "frames.zarr" else store.read
    return digest(*((name, tuple(read(name))) for name in store.sequences))


def read_images(folder: Path) -> str:
    """The manifest and the pictures that it lists."""
    manifest = read_manifest(folder)
    return digest(manifest, *(read_rgb(folder / entry.file) for entry in manifest.pictures))


def read_training(folder: Path) -> str:
    """The best weights of a training with their record, and its history."""
    tensors, metadata = load_checkpoint(folder / "best.safetensors")
    return digest(metadata, read_history(folder), *((name, tensors[name]) for name in sorted(tensors)))


def read_row(folder: Path) -> str:
    """Scores and panels of a row of the tables on every set."""
    values: list[Any] = [read_record(folder)]
    for test_set in sorted(path.name for path in folder.iterdir() if path.is_dir()):
        results = read_rows({folder.name: folder}, test_set)
        values += [results.rows, results.costs]
        for panel in results.panels:
            shown = [panel.truth, *panel.predictions.values()]
            values += [panel.events, panel.s0, panel.film_events, panel.film_s0, panel.film_t_us]
            values += [frame for one in shown for frame in one if frame is not None]
    return digest(*values)


def read_weights(folder: Path) -> str:
    """LPIPS of the table."""
    backbone = stored_record(folder, "benchmark")["backbone"]
    return digest(*Lpips.load(folder, "benchmark", backbone or "").state_dict().values())


READERS: tuple[tuple[str, str, Callable[[Path], str]], ...] = (
    ("store", "**/events.zarr", read_store),
    ("store", "**/frames.zarr", read_store),
    ("store", "**/scenes.zarr", read_store),
    ("images", "images", read_images),
    ("training", "train/*", read_training),
    ("row", "benchmark/rows/*", read_row),
    ("LPIPS", "weights", read_weights),
)
"""Kind of artefact, its folders below `paths.data`, and its reader: the hash of all values that the next stage uses."""


def files_in(folder: Path) -> list[Path]:
    """Files of an artefact that have content."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.stat().st_size)


def flip(content: bytes, generator: Generator) -> bytes:
    """One other bit."""
    place = int(generator.integers(len(content)))
    return content[:place] + bytes([content[place] ^ 1 << int(generator.integers(8))]) + content[place + 1 :]


def truncation(content: bytes, generator: Generator) -> bytes:
    """The end lost, as after a power cut."""
    return content[: int(generator.integers(len(content)))]


def digit(content: bytes, generator: Generator) -> bytes:
    """One other digit; content without digits stays."""
    places = [place for place, byte in enumerate(content) if 48 <= byte <= 57]
    if not places:
        return content
    place = places[int(generator.integers(len(places)))]
    return content[:place] + bytes([48 + (content[place] - 47) % 10]) + content[place + 1 :]


def one_file(change: Callable[[bytes, Generator], bytes], endings: tuple[str, ...] = ("",)) -> Fault:
    """The fault that changes one file whose name has one of these endings."""

    def fault(folder: Path, others: Sequence[Path], generator: Generator) -> None:
        files = [file for file in files_in(folder) if file.name.endswith(endings)]
        if files:
            file = files[int(generator.integers(len(files)))]
            file.write_bytes(change(file.read_bytes(), generator))

    return fault


def deletion(folder: Path, others: Sequence[Path], generator: Generator) -> None:
    """One file less."""
    files = files_in(folder)
    files[int(generator.integers(len(files)))].unlink()


def exchange_of_files(folder: Path, others: Sequence[Path], generator: Generator) -> None:
    """One file replaced by another of its kind, in this artefact or in another of its kind."""
    files = files_in(folder)
    file = files[int(generator.integers(len(files)))]
    alike = [one for place in (folder, *others) for one in files_in(place) if one.suffix == file.suffix and one != file]
    if alike:
        shutil.copy(alike[int(generator.integers(len(alike)))], file)


def exchange_of_artefacts(folder: Path, others: Sequence[Path], generator: Generator) -> None:
    """The whole artefact replaced by another of its kind, of this run or of one with another seed."""
    if others:
        shutil.rmtree(folder)
        shutil.copytree(others[int(generator.integers(len(others)))], folder)


def without_seal(folder: Path, others: Sequence[Path], generator: Generator) -> None:
    """The seal or the origin removed or emptied, and then one other digit in a text."""
    seals = [file for file in files_in(folder) if file.name in (SUMS, ORIGIN)]
    for file in seals:
        file.unlink() if generator.random() < 0.5 else file.write_bytes(b"")
    one_file(digit, TEXTS)(folder, others, generator)


def sealed_again(folder: Path, others: Sequence[Path], generator: Generator) -> None:
    """One other digit in a text, and a seal that fits it."""
    one_file(digit, (".json", ".csv"))(folder, others, generator)
    if (folder / SUMS).exists():
        seal(folder)


FAULTS: dict[str, Fault] = {
    "flipped bit": one_file(flip),
    "truncation": one_file(truncation),
    "other digit": one_file(digit, TEXTS),
    "deletion": deletion,
    "exchange of files": exchange_of_files,
    "exchange of artefacts": exchange_of_artefacts,
    "no seal": without_seal,
    "sealed again": sealed_again,
}


def outcome(use: Callable[[], str], folder: Path, undamaged: str) -> tuple[str, str]:
    """One of OUTCOMES for a damaged artefact, and the message."""
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    try:
        result = ("harmless", "") if use() == undamaged else ("silent", "other values")
    except REFUSALS as error:
        named = folder.name in str(error) or any(path.name in str(error) for path in before)
        result = ("refused" if named and "\n" not in str(error) else "unnamed"), str(error)
    except Exception as error:
        result = "traceback", repr(error)
    changed = {path for path in folder.rglob("*") if path.is_file()} != {*before}
    lost = changed or any(path.read_bytes() != content for path, content in before.items())
    return ("lost", "the reader changed files") if lost else result


def inject(runs: Sequence[Path], faults: int, seed: int) -> tuple[dict[str, dict[str, int]], list[str]]:
    """Outcomes of `faults` faults by kind (FAULT of ARTEFACT), and a line for each that is no refusal and not harmless.

    The artefacts of the first of `runs` (each the root of a project with a finished run) are damaged in a copy, and
    used as the report would: their origins are compared, then all values are read. Others serve for exchanges.
    """
    generator = generator_for(seed, "faults", "place and kind")
    counts: dict[str, dict[str, int]] = {}
    lines: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        data = shutil.copytree(runs[0] / "data", Path(scratch, "data"))
        config = load(runs[0], [f"paths.data={data}"])
        every = [(kind, read, folder) for kind, at, read in READERS for folder in sorted(data.glob(at))]
        found = [one for one in every if files_in(one[2])]
        if not found:
            raise SystemExit(f"--runs {runs[0]}: no artefacts of a run there; `dvc repro` makes some")
        sound = {folder: read(folder) for _, read, folder in found}
        for number in range(faults):
            kind, read, folder = found[number % len(found)]
            name = [*FAULTS][int(generator.integers(len(FAULTS)))]
            alike = [other for one, _, other in found if (one, other.suffix) == (kind, folder.suffix)]
            others = [other for other in alike if other != folder]
            others += [run / "data" / folder.relative_to(data) for run in runs[1:]]
            kept = shutil.copytree(folder, Path(scratch, "kept"))
            FAULTS[name](folder, others, generator)

            def use(read: Callable[[Path], str] = read, folder: Path = folder) -> str:
                Run(runs[0], config, "report").check_inputs()
                return read(folder)

            what, message = outcome(use, folder, sound[folder])
            shutil.rmtree(folder)
            kept.rename(folder)
            counts.setdefault(f"{name} of {kind}", dict.fromkeys(OUTCOMES, 0))[what] += 1
            if what not in ("refused", "harmless"):
                lines.append(f"{what}: {name} of {folder.relative_to(data)}: {message}")
                print(lines[-1], flush=True)
    return dict(sorted(counts.items())), lines


def write_folder(place: Path, value: str) -> None:
    """A run of a command that writes 30 files of a value."""
    with run_folder(place, "recover") as partial:
        for number in range(30):
            (partial / f"{number}.txt").write_text(value)


def read_folder(place: Path) -> set[str]:
    """The values in the folder of a command."""
    return {file.read_text() for file in place.glob("*.txt")}


def write_store(place: Path, value: str) -> None:
    """A store of three parts with a value as its attribute and in its events."""
    store = EventStore.create(place, ["a", "b", "c"], 8, 9, {"value": value})
    for name in store.missing():
        t = torch.full((50,), int(value))
        x = torch.ones(50)
        store.write(name, [Events(t, x.short(), x.short(), x.to(torch.int8), 8, 9)] * 4, 5000)
    store.finish()


def read_events(place: Path) -> set[str]:
    """The values in a store of `write_store`."""
    store = EventStore.open(place)
    return {str(int(t)) for name in store.sequences for t in store.read(name)[0].t} | {store.attributes["value"]}


WRITERS: dict[str, tuple[Callable[[Path, str], None], Callable[[Path], set[str]]]] = {
    "folder of a command": (write_folder, read_folder),
    "store": (write_store, read_events),
}
"""What is killed while it replaces an old result with a new one, and what reads the values there."""


def killed_write(write: Callable[[Path, str], None], place: Path, value: str, after: int) -> None:
    """In a process of its own: write, and die by SIGKILL before call `after` of a rename."""
    calls = itertools.count()

    def dying(call: Callable[..., Any]) -> Callable[..., Any]:
        def call_or_die(*paths: Any) -> Any:
            if next(calls) == after:
                os.kill(os.getpid(), signal.SIGKILL)
            return call(*paths)

        return call_or_die

    os.rename, os.replace, files._exchanged = dying(os.rename), dying(os.replace), dying(files._exchanged)
    write(place, value)


def kills(cases: int) -> dict[str, dict[str, int]]:
    """Outcomes of writers killed at any rename: the old or the new result is whole, or lost; no rerun works: stuck."""
    counts = {f"kill of a {name}": dict.fromkeys(("whole", "lost", "stuck"), 0) for name in WRITERS}
    for name, (write, read) in WRITERS.items():
        with tempfile.TemporaryDirectory() as scratch:
            place, value = Path(scratch, "place"), 1
            write(place, str(value))
            for number in range(cases):
                after = int(80 ** generator_for(number, name, "kill").random()) - 1  # folders have few renames
                process = multiprocessing.get_context("fork").Process(
                    target=killed_write, args=(write, place, str(value + 1), after)
                )
                process.start()
                process.join()
                what = "whole" if read(place) in ({str(value)}, {str(value + 1)}) else "lost"
                value += 2
                write(place, str(value))
                counts[f"kill of a {name}"][what if read(place) == {str(value)} else "stuck"] += 1
    return counts


def older_processor() -> dict[str, str]:
    """Environment of a process whose libraries use neither AVX nor FMA; RuntimeError if one of them says it does."""
    variables = {**os.environ, **OLD_PROCESSOR, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    script = "from studies.faults import newer_instructions; print(newer_instructions())"
    done = subprocess.run([sys.executable, "-c", script], env=variables, stdout=subprocess.PIPE, text=True, check=True)
    if done.stdout.strip() != "[]":
        raise RuntimeError(f"expected no library with AVX or FMA under {OLD_PROCESSOR}, got {done.stdout.strip()}")
    return variables


def newer_instructions() -> list[str]:
    """Libraries that say in this process that they use AVX2, FMA or AVX-512."""
    from numpy._core._multiarray_umath import __cpu_features__ as features

    opencv = cv2.getCPUFeaturesLine().replace("*", "").split()  # the line marks disabled ones: AVX2?
    uses = {
        "numpy": any(features[one] for one in ("X86_V3", "X86_V4", "AVX512_ICL", "AVX512_SPR")),
        "torch": torch.backends.cpu.get_cpu_capability() != "DEFAULT",
        "OpenCV": "AVX2" in opencv,
    }
    return [library for library, newer in uses.items() if newer]


def same_bytes() -> dict[str, dict[str, Any]]:
    """For each run: the number of files, and of those whose bytes differ from the run on one worker."""
    runs: dict[str, tuple[Mapping[str, str], int]] = {"1 worker": ({}, 1)}
    runs |= {f"{workers} workers": ({}, workers) for workers in WORKERS}
    if platform.machine() == "x86_64":
        runs["1 worker, libraries without AVX and FMA"] = (older_processor(), 1)
    rows: dict[str, dict[str, Any]] = {}
    reference: dict[str, str] = {}
    for name, (variables, workers) in runs.items():
        with tempfile.TemporaryDirectory() as scratch:
            overrides = (*SMALL, f"paths.data={scratch}", f"runtime.workers={workers}", f"hydra.run.dir={scratch}/log")
            for stage in ("ingest", "synthesize", "emulate"):
                run_stage(stage, *overrides, environment=variables)
            files = [path for path in Path(scratch).rglob("*") if path.is_file() and "log" not in path.parts]
            hashes = {path.relative_to(scratch).as_posix(): sha256(path) for path in files}
        reference = reference or hashes
        different = sum(hashes.get(file) != expected for file, expected in reference.items())
        rows[name] = {"compared": len(reference), "different": different + len(hashes.keys() - reference.keys())}
        print(name, rows[name], flush=True)
    return rows


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/reliability.json")
    parser.add_argument("--only", choices=("artefacts", "kills", "same_bytes"), help="default: all three")
    parser.add_argument("--runs", type=Path, nargs="+", default=[ROOT], help="projects with finished runs")
    parser.add_argument("--faults", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=100, help="of each kind")
    arguments = arguments_of(parser)
    studies: dict[str, Callable[[], Mapping[str, Any]]] = {
        "artefacts": lambda: inject(arguments.runs, arguments.faults, seed=1)[0],
        "kills": lambda: kills(arguments.kills),
        "same_bytes": same_bytes,
    }
    for name in [arguments.only] if arguments.only else studies:
        record, figures = machine_record(), studies[name]()
        print(name, json.dumps(figures, indent=2))
        if arguments.write:
            write_section("reliability", name, figures, record)


if __name__ == "__main__":
    main()
