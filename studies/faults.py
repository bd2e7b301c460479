"""Damaged artefacts, killed writers and hostile names, and what polarnet does with each: python -m studies.faults

- artefacts: copies of the artefacts of a finished run are damaged, one after another, by one of FAULTS. Used as the
  next stage would, an artefact must be refused with one line that names the file or the folder, or give the same values
  as before. The run is the smoke pipeline in a clone; that of another seed serves for exchanges. --runs names other
  projects with a finished run, of which the first is damaged.
- kills: writers of stores are killed at a random rename. The old or the new one must be whole, a rerun must work.
- names: commands read stores whose sequences have names that could be places elsewhere. They must refuse each.

--only NAME runs one of them; --write puts the counts into docs/results/reliability.json.
"""

import argparse
import contextlib
import dataclasses
import functools
import hashlib
import io
import itertools
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from polarnet import cli
from polarnet.benchmark.results import read_record, read_rows
from polarnet.config.origins import Run
from polarnet.config.tree import load
from polarnet.events.stream import Events
from polarnet.networks.base.checkpoint import load_checkpoint
from polarnet.pictures.images import read_rgb
from polarnet.pictures.manifest import read_manifest
from polarnet.runtime import files
from polarnet.runtime.files import ORIGIN, SUMS, seal
from polarnet.runtime.machine import generator_for
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.scenes import SceneStore
from polarnet.training.engine.recorder import read_history
from studies.study import ROOT, command_line, measure_sections, read_results

REFUSALS = (ValueError, OSError, RuntimeError, MemoryError)  # what stages and commands end with, in one line
MAX_RENAMES = 51  # of `write_store` on an old store
TEXTS = (".json", ".csv", "SHA256SUMS")
FAILURES = ("unnamed", "traceback", "silent", "lost", "stuck", "outside")
SEEDS = (1, 2)  # of the smoke runs
OUTCOMES = ("refused", "harmless", *FAILURES[:4])
Generator = np.random.Generator
Fault = Callable[[Path, Sequence[Path], Generator], None]
"""Damages the artefact in a folder; further folders hold others of its kind."""


def digest(*values: Any) -> str:
    """Hash of arrays, tensors, bytes and plain values, one after another; collections and records count by parts."""
    content = hashlib.sha256()
    for value in values:
        parts = vars(value) if dataclasses.is_dataclass(value) else value
        if isinstance(parts, Mapping):
            parts = [*parts.items()]
        if isinstance(parts, tuple | list):
            content.update(digest(*parts).encode())
        else:
            array = parts.numpy() if isinstance(parts, torch.Tensor) else parts
            content.update(array.tobytes() if isinstance(array, np.ndarray) else repr(array).encode())
    return content.hexdigest()


def values_of(kind: str, folder: Path) -> str:
    """All values that the next stage uses of an artefact of this kind."""
    if kind == "images":
        manifest = read_manifest(folder)
        return digest(manifest, *(read_rgb(folder / entry.file) for entry in manifest.pictures))
    if kind == "training":
        tensors, metadata = load_checkpoint(folder / "best.safetensors")
        return digest(metadata, read_history(folder), *((name, tensors[name]) for name in sorted(tensors)))
    if kind == "row":
        sets = sorted(path.name for path in folder.iterdir() if path.is_dir())
        return digest(read_record(folder), *(read_rows({folder.name: folder}, one) for one in sets))
    store: Any = STORES[folder.stem].open(folder)
    read = store.frames if folder.stem == "frames" else store.read
    return digest(*((name, read(name)) for name in store.sequences))


STORES: dict[str, Any] = {"events": EventStore, "frames": FrameStore, "scenes": SceneStore}
PLACES = {"store": "**/*s.zarr", "images": "images", "training": "train/*", "row": "benchmark/rows/*"}
"""Folders of each kind of artefact, below `paths.data`."""


def contents(folder: Path) -> dict[Path, bytes]:
    """Every file of an artefact."""
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def files_in(folder: Path) -> list[Path]:
    """Files of an artefact that have content."""
    return [path for path, content in contents(folder).items() if content]


def one_of(things: Sequence[Any], generator: Generator) -> Any:
    """A random one."""
    return things[int(generator.integers(len(things)))]


def flip(content: bytes, generator: Generator) -> bytes:
    """One other bit."""
    place = int(generator.integers(len(content)))
    return content[:place] + bytes([content[place] ^ 1 << int(generator.integers(8))]) + content[place + 1 :]


def truncation(content: bytes, generator: Generator) -> bytes:
    """The end lost, as after a power cut."""
    return content[: int(generator.integers(len(content)))]


def digit(content: bytes, generator: Generator) -> bytes:
    """One other digit; content without digits stays."""
    if places := [place for place, byte in enumerate(content) if 48 <= byte <= 57]:
        place = one_of(places, generator)
        content = content[:place] + bytes([48 + (content[place] - 47) % 10]) + content[place + 1 :]
    return content


def one_file(change: Callable[[bytes, Generator], bytes], endings: tuple[str, ...] = ("",)) -> Fault:
    """The fault that changes one file whose name has one of these endings."""

    def fault(folder: Path, others: Sequence[Path], generator: Generator) -> None:
        if files := [file for file in files_in(folder) if file.name.endswith(endings)]:
            file = one_of(files, generator)
            file.write_bytes(change(file.read_bytes(), generator))

    return fault


def exchange_of_files(folder: Path, others: Sequence[Path], generator: Generator) -> None:
    """One file replaced by another of its kind, in this artefact or in another of its kind."""
    file = one_of(files_in(folder), generator)
    every = itertools.chain.from_iterable(map(files_in, (folder, *others)))
    if alike := [one for one in every if one.suffix == file.suffix and one != file]:
        shutil.copy(one_of(alike, generator), file)


def exchange_of_artefacts(folder: Path, others: Sequence[Path], generator: Generator) -> None:
    """The whole artefact replaced by another of its kind, of this run or of one with another seed."""
    if others:
        shutil.rmtree(folder)
        shutil.copytree(one_of(others, generator), folder)


def without_seal(folder: Path, others: Sequence[Path], generator: Generator) -> None:
    """The seal or the origin removed or emptied, and then one other digit in a text."""
    for file in [file for file in files_in(folder) if file.name in (SUMS, ORIGIN)]:
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
    "deletion": lambda folder, others, generator: one_of(files_in(folder), generator).unlink(),
    "exchange of files": exchange_of_files,
    "exchange of artefacts": exchange_of_artefacts,
    "no seal": without_seal,
    "sealed again": sealed_again,
}


def outcome(use: Callable[[], str], folder: Path, undamaged: str) -> tuple[str, str]:
    """One of OUTCOMES for a damaged artefact, and the message."""
    before = contents(folder)
    try:
        result = ("harmless", "") if use() == undamaged else ("silent", "other values")
    except REFUSALS as error:
        named = folder.name in str(error) or any(path.name in str(error) for path in before)
        result = ("refused" if named and "\n" not in str(error) else "unnamed"), str(error)
    except Exception as error:
        result = "traceback", repr(error)
    return result if contents(folder) == before else ("lost", "the reader changed files")


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
        every = [(kind, folder) for kind, at in PLACES.items() for folder in sorted(data.glob(at))]
        found = [one for one in every if files_in(one[1])]
        if not found:
            raise SystemExit(f"--runs {runs[0]}: no artefacts of a run there; `dvc repro` makes some")
        sound = {folder: values_of(kind, folder) for kind, folder in found}
        for number in range(faults):
            kind, folder = found[number % len(found)]
            name = one_of([*FAULTS], generator)
            others = [other for one, other in found if one == kind and other != folder]
            others += [run / "data" / folder.relative_to(data) for run in runs[1:]]
            kept = shutil.copytree(folder, Path(scratch, "kept"))
            FAULTS[name](folder, others, generator)

            def use(kind: str = kind, folder: Path = folder) -> str:
                Run(runs[0], config, "report").check_inputs()
                return values_of(kind, folder)

            what, message = outcome(use, folder, sound[folder])
            shutil.rmtree(folder)
            kept.rename(folder)
            counts.setdefault(f"{name} of {kind}", dict.fromkeys(OUTCOMES, 0))[what] += 1
            if what not in ("refused", "harmless"):
                lines.append(f"{what}: {name} of {folder.relative_to(data)}: {message}")
                print(lines[-1], flush=True)
    return dict(sorted(counts.items())), lines


def write_store(place: Path, value: str, names: Sequence[str] = ("a", "b", "c")) -> None:
    """A store with a value as its attribute and in its events, a part for each name."""
    store = EventStore.create(place, names, 8, 9, {"value": value})
    for name in store.missing():
        x = np.ones(50, int)
        store.write(name, [Events.from_columns(int(value) * x, x, x, x, 8, 9)] * 4, 5000)
    store.finish()


def read_events(place: Path) -> set[str]:
    """The values in a store of `write_store`."""
    store = EventStore.open(place)
    return {str(int(t)) for name in store.sequences for t in store.read(name)[0].t} | {store.attributes["value"]}


def killed_write(place: Path, value: str, after: int) -> None:
    """In a process of its own: write a store, and die by SIGKILL before call `after` of a rename."""
    calls = itertools.count()

    def dying(call: Callable[..., Any]) -> Callable[..., Any]:
        def call_or_die(*paths: Any) -> Any:
            if next(calls) == after:
                os.kill(os.getpid(), signal.SIGKILL)
            return call(*paths)

        return call_or_die

    os.rename, os.replace, files._exchanged = dying(os.rename), dying(os.replace), dying(files._exchanged)
    write_store(place, value)


def kills(cases: int) -> dict[str, dict[str, int]]:
    """Outcomes of kills at any rename: the old or the new store is whole, or lost; no rerun works: stuck."""
    counts, fork = dict.fromkeys(("whole", "lost", "stuck"), 0), multiprocessing.get_context("fork")
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch, "place")
        write_store(place, "1")
        for number in range(cases):
            old, new, rerun = (str(2 * number + k) for k in (1, 2, 3))
            after = int(generator_for(number, "store", "kill").uniform(0, MAX_RENAMES))
            process = fork.Process(target=killed_write, args=(place, new, after))
            process.start()
            process.join()
            what = "whole" if read_events(place) in ({old}, {new}) else "lost"
            write_store(place, rerun)
            counts[what if read_events(place) == {rerun} else "stuck"] += 1
    return {"kill of a store": counts}


NAMES = ["../outside", "../../../outside", "{root}/outside", "b/../../outside", "..", ".", "", "b\\..\\outside"]
NAMES += ["b\x00", "b\n", "b\u202e", "b\u2028"]
COMMANDS = {"convert": ["out"], "inspect": [], "recover": ["--out", "out", "--method", "cf"], "video": []}
"""Commands that read a store whole, and what follows its name."""


def hostile_names() -> dict[str, dict[str, int]]:
    """Outcomes of commands on stores of a stranger, one for each of `NAMES`, that has a sequence of that name.

    A file that a command writes beside its folder counts as outside.
    """
    counts = {f"{word} of a store with hostile names": dict.fromkeys(("refused", *FAILURES), 0) for word in COMMANDS}
    for name, (word, options) in itertools.product(NAMES, COMMANDS.items()):
        with tempfile.TemporaryDirectory() as scratch:
            work = Path(scratch, "a", "b", "work")
            work.mkdir(parents=True)
            with mock.patch("polarnet.storage.parts.check_name", lambda name: name):
                write_store(work / "events.zarr", "1", ["a", name.format(root=scratch)])
            before = {*Path(scratch).rglob("*")}
            with contextlib.chdir(work), contextlib.redirect_stderr(io.StringIO()) as errors:
                try:
                    what = "refused" if cli.main([word, "events.zarr", *options]) else "silent"
                except Exception:
                    what = "traceback"
            if what == "refused" and "expected a name" not in errors.getvalue():
                what = "unnamed"
            if not all(path.is_relative_to(work) for path in {*Path(scratch).rglob("*")} - before):
                what = "outside"
            counts[f"{word} of a store with hostile names"][what] += 1
    return counts


def smoke_runs(folder: Path) -> list[Path]:
    """Clones of HEAD below `folder`, each with a smoke run of another seed; CalledProcessError if one fails."""
    runs = [folder / f"seed_{seed}" for seed in SEEDS]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for seed, run in zip(SEEDS, runs, strict=True):
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(run)], check=True)
        environment = os.environ | {"PATH": path, "PYTHONPATH": str(run)}
        for command in ("polarnet preset smoke", f"dvc exp run --quiet --set-param seed={seed}"):
            subprocess.run(command.split(), cwd=run, env=environment, check=True)
    return runs


def damaged_artefacts(given: argparse.Namespace) -> Mapping[str, Any]:
    """Outcomes of each fault in the artefacts of `given.runs`, or of two smoke runs."""
    with tempfile.TemporaryDirectory() as folder:
        return inject(given.runs or smoke_runs(Path(folder)), given.faults, seed=1)[0]


SECTIONS: dict[str, Callable[[argparse.Namespace], Mapping[str, Any]]] = {
    "artefacts": damaged_artefacts,
    "kills": lambda given: kills(given.kills),
    "names": lambda _: hostile_names(),
}
HEADLINES = {
    "stuck": "stuck", "lost": "faults_lost", "silent": "silent_uses", "outside": "outside_writes",
    "traceback": "tracebacks",
}  # fmt: skip
"""Name of each failure among the headlines."""


def measure(name: str, given: argparse.Namespace) -> tuple[Mapping[str, Any], Mapping[str, int]]:
    """Counts of one of `SECTIONS`, and over all kinds of faults, with the counts of docs/results for other sections."""
    counts = SECTIONS[name](given)
    known = {**read_results("reliability"), name: counts}
    kinds = [one for section in SECTIONS for one in known.get(section, {}).values()]
    injected = {"faults_injected": sum(sum(one.values()) for one in kinds), "kinds": len(kinds)}
    return counts, injected | {key: sum(one.get(what, 0) for one in kinds) for what, key in HEADLINES.items()}


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/reliability.json")
    parser.add_argument("--runs", type=Path, nargs="+", help="projects with finished runs")
    parser.add_argument("--faults", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=100, help="of stores")
    sections = {name: ("reliability", name, functools.partial(measure, name)) for name in SECTIONS}
    measure_sections(parser, sections)
