"""What damaged files do, and whether bytes are the same elsewhere: python -m studies.faults [--only NAME] [--write]

- artefacts: copies of the artefacts of a finished run are damaged, one file at a time: a flipped bit, a truncation, a
  deletion, an exchange with another file of its kind, or a changed digit of a text. The reader of the next stage must
  refuse the whole artefact with one line that names the file or the folder, or read the same values as before. --data
  names the `paths.data` of the run (`polarnet preset smoke`, then `dvc repro`).
- inputs: pictures, recordings, values of the configuration and checkpoints are damaged; half of the checkpoints get the
  hash of the damaged tensors, as a hostile file would have. A case must end with a result or with a refusal of one
  line. Other endings are a traceback, the end of the process (crash), or more than `HANG_S` seconds (hang).
- same_bytes: the stages ingest, synthesize and emulate run at smoke size on several workers, and with libraries that
  are restricted to older instructions of an x86-64 processor. Before each run, the libraries must say that they use no
  newer instructions. The files must be equal.

--write puts the counts into docs/results/reliability.json.
"""

import hashlib
import json
import multiprocessing
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from safetensors.torch import save

from polarnet.benchmark.row_results import read_record, read_rows
from polarnet.config.tree import load
from polarnet.metrics.lpips import Lpips, stored_record
from polarnet.networks.base.checkpoint import load_checkpoint, save_checkpoint
from polarnet.pictures.images import read_rgb
from polarnet.pictures.manifest import read_manifest
from polarnet.recordings.recording import FORMATS
from polarnet.runtime.files import sha256
from polarnet.runtime.machine import generator_for
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.scenes import SceneStore
from polarnet.training.engine.history import read_history
from studies.study import ROOT, arguments_of, command_line, machine_record, run_stage, write_section

REFUSALS = (ValueError, OSError, RuntimeError, MemoryError)  # what stages and commands end with, in one line
TEXTS = (".json", ".csv", "SHA256SUMS")
OUTCOMES = ("refused", "harmless", "unnamed", "traceback", "silent", "lost")
ENDINGS = ("read", "refused", "traceback", "crash", "hang")
HANG_S = 30
SECTIONS = ("ingest", "synthesize", "emulate", "loss", "train")  # whose parameters are replaced
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
Case = Callable[[Generator], object]
"""Draws a damaged input and reads it."""


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


def damaged(content: bytes, fault: str, others: Sequence[Path], generator: Generator) -> bytes | None:
    """The content of a file after `fault`, None if it is deleted; text without digits and a lone file stay."""
    place, bit = int(generator.integers(len(content))), int(generator.integers(8))
    if fault == "swap":
        return others[int(generator.integers(len(others)))].read_bytes() if others else content
    if fault == "truncation":
        return content[:place]
    if fault == "flip":
        return content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]
    if fault == "digit" and (digits := [place for place, byte in enumerate(content) if 48 <= byte <= 57]):
        place = digits[int(generator.integers(len(digits)))]
        return content[:place] + bytes([48 + (content[place] - 47) % 10]) + content[place + 1 :]
    return None if fault == "deletion" else content


def outcome(read: Callable[[Path], str], folder: Path, file: Path, undamaged: str) -> tuple[str, str]:
    """One of OUTCOMES for a damaged file, and the reader's message."""
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.stat().st_size < 2**16}
    try:
        same = read(folder) == undamaged
        result = ("harmless", "") if same else ("silent", "other values")
    except REFUSALS as error:
        named = any(name in str(error) for name in (file.name, file.stem, str(folder)))
        result = ("refused" if named and "\n" not in str(error) else "unnamed"), str(error)
    except Exception as error:
        result = "traceback", repr(error)
    changed = any(not path.exists() or path.read_bytes() != content for path, content in before.items())
    return ("lost", "the reader changed files") if changed else result


def inject(data: Path, faults: int, seed: int) -> tuple[dict[str, dict[str, int]], list[str]]:
    """Outcomes of `faults` faults by kind of artefact, and a line for each one that is neither refused nor harmless."""
    generator = generator_for(seed, "faults", "place and kind")
    lines: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        copies: dict[str, list[tuple[Callable[[Path], str], Path, str]]] = {}
        folders = [(kind, read, folder) for kind, pattern, read in READERS for folder in sorted(data.glob(pattern))]
        for number, (kind, read, folder) in enumerate(folders):
            if any(folder.iterdir()):
                shutil.copytree(folder, copy := Path(scratch, str(number), folder.name))
                copies.setdefault(kind, []).append((read, copy, read(copy)))
        if not copies:
            raise SystemExit(f"--data {data}: no artefacts of a run there; `dvc repro` makes some")
        counts = {kind: dict.fromkeys(OUTCOMES, 0) for kind in sorted(copies)}
        for number in range(faults):
            kind = [*counts][number % len(counts)]
            read, folder, undamaged = copies[kind][int(generator.integers(len(copies[kind])))]
            files = sorted(path for path in folder.rglob("*") if path.is_file() and path.stat().st_size)
            file = files[int(generator.integers(len(files)))]
            possible = ["flip", "truncation", "deletion", "swap", *(["digit"] if file.name.endswith(TEXTS) else [])]
            fault, content = possible[int(generator.integers(len(possible)))], file.read_bytes()
            others = [path for path in files if path.suffix == file.suffix and path != file]
            file.unlink()
            if (after := damaged(content, fault, others, generator)) is not None:
                file.write_bytes(after)
            what, message = outcome(read, folder, file, undamaged)
            file.write_bytes(content)
            counts[kind][what] += 1
            if what not in ("refused", "harmless"):
                lines.append(f"{what}: {fault} of {file.relative_to(scratch)} ({kind}): {message}")
                print(lines[-1], flush=True)
    return counts, lines


def changed(content: bytes, generator: Generator) -> bytes:
    """Bytes with one to four changes: a bit, a number of four bytes, a cut, a deletion, a repetition, an insertion."""
    for _ in range(int(generator.integers(1, 5))):
        reach = min(len(content), 200) if generator.random() < 0.5 else len(content)  # headers are at the start
        place, length = int(generator.integers(max(1, reach))), int(generator.integers(1, 40))
        head, tail = content[:place], content[place:]
        tails = (
            bytes([tail[0] ^ 1 << length % 8]) + tail[1:] if tail else tail,
            int(generator.integers(2**32)).to_bytes(4, "little") + tail[4:],
            b"" if length < 10 else tail,
            tail[length:],
            tail[:length] * 2 + tail[length:],
            generator.bytes(length % 12) + tail,
        )
        content = head + tails[int(generator.integers(len(tails)))]
    return content


def pictures(folder: Path) -> Case:
    """Small pictures of six formats."""
    rgb = generator_for(0, "faults", "picture").integers(0, 256, (12, 16, 3)).astype(np.uint8)
    files = [folder / f"picture.{extension}" for extension in ("png", "jpg", "tif", "bmp", "webp", "hdr")]
    for file in files:
        cv2.imwrite(str(file), rgb.astype(np.float32) / 255 if file.suffix == ".hdr" else rgb)
    sound = {file: file.read_bytes() for file in files}

    def case(generator: Generator) -> object:
        file = files[int(generator.integers(len(files)))]
        file.write_bytes(changed(sound[file], generator))
        return read_rgb(file)

    return case


def recordings(folder: Path) -> Case:
    """Small recordings of every format whose library is installed, as tests/recordings makes them."""
    sys.path[:0] = [str(ROOT / "tests" / "recordings"), str(ROOT / "tests")]
    from damaged_files import EVENTS, Sample
    from event_fixtures import random_events

    samples = [Sample(form, folder, random_events(0, EVENTS, 300_000, 260, 346)) for form in FORMATS]

    def case(generator: Generator) -> None:
        sample = samples[int(generator.integers(len(samples)))]
        number = int(generator.integers(len(sample.sound)))
        content, says_format = changed(sample.sound[number], generator), generator.random() < 0.8
        if sample.ending_of(content, number, says_format, int(generator.integers(1, 101))) == "refused":
            raise ValueError("refused")

    return case


def parameters(folder: Path) -> Case:
    """Values of the configuration, replaced by others of any kind on the command line."""
    config = load(ROOT)
    keys = [f"{name}.{key}" for name in SECTIONS for key in vars(getattr(config, name))]
    values = ("0", "-1", "3.5", "1e300", "nan", "inf", "true", "null", "''", "../x", "[]", "[[]]", "{a: 1}", "x" * 500)

    def case(generator: Generator) -> object:
        chosen = generator.choice(keys, int(generator.integers(1, 4)))
        return load(ROOT, [f"{key}={values[int(generator.integers(len(values)))]}" for key in chosen])

    return case


def checkpoints(folder: Path) -> Case:
    """A checkpoint; half of the damaged tensor files have the hash that the record names."""
    path = folder / "best.safetensors"
    tensors = {"w": torch.arange(12.0).view(3, 4), "b": torch.zeros(3)}
    save_checkpoint(path, tensors, {"network": "x", "config": {"a": 1}, "in_channels": 4})
    record, weights = path.with_suffix(".json").read_text(), save(tensors)

    def case(generator: Generator) -> object:
        content, text = weights, record.encode()
        if generator.random() < 0.6:
            content = changed(weights, generator)
            if generator.random() < 0.5:
                text = json.dumps(json.loads(record) | {"sha256": sha256(content)}).encode()
        else:
            text = changed(text, generator)
        path.write_bytes(content)
        path.with_suffix(".json").write_bytes(text)
        return load_checkpoint(path)

    return case


KINDS = {each.__name__: each for each in (pictures, recordings, parameters, checkpoints)}


def run_cases(kind: str, cases: int, counts: Any, state: Any) -> None:
    """In a process of its own: run the cases from number `state[0]` on; `state[1]` is the time at which one began."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libpng and others write lines about damage
    with tempfile.TemporaryDirectory() as scratch:
        case = KINDS[kind](Path(scratch))
        while (number := int(state[0])) < cases:
            state[0], state[1] = number + 1, time.time()
            try:
                case(generator_for(1, f"{kind} {number}", "faults"))
                what = "read"
            except REFUSALS as error:
                what = "traceback" if kind != "parameters" and "\n" in str(error) else "refused"
            except Exception as error:
                what = "traceback"
                print(f"{kind} {number}: {error!r}", flush=True)
            counts[ENDINGS.index(what)] += 1


def endings_of(kind: str, cases: int) -> dict[str, int]:
    """Endings of the cases of a kind; a new process replaces one that crashes or hangs, from the next case on."""
    context = multiprocessing.get_context("spawn")
    counts, state = context.RawArray("q", len(ENDINGS)), context.RawArray("d", 2)
    while state[0] < cases:
        state[1] = time.time() + 60  # setting up takes time, too
        process = context.Process(target=run_cases, args=(kind, cases, counts, state), daemon=True)
        process.start()
        while process.is_alive() and time.time() - state[1] < HANG_S:
            process.join(1)
        if process.is_alive() or process.exitcode:
            counts[ENDINGS.index("hang" if process.is_alive() else "crash")] += 1
            print(f"{kind} {state[0] - 1:.0f}: ended with {process.exitcode}", flush=True)
            process.kill()
            process.join()
    return dict(zip(ENDINGS, counts, strict=True))


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
    names = ("artefacts", "inputs", "same_bytes")
    parser = command_line(__doc__, "docs/results/reliability.json")
    parser.add_argument("--only", choices=names, help="default: all three")
    parser.add_argument("--data", type=Path, default=ROOT / "data", help="`paths.data` of a finished run")
    parser.add_argument("--faults", type=int, default=1000)
    parser.add_argument("--cases", type=int, default=10_000, help="damaged inputs of each kind")
    arguments = arguments_of(parser)
    for name in [arguments.only] if arguments.only else names:
        record = machine_record()
        if name == "artefacts":
            figures: Mapping[str, Any] = inject(arguments.data, arguments.faults, seed=1)[0]
        else:
            figures = same_bytes() if name == "same_bytes" else {k: endings_of(k, arguments.cases) for k in KINDS}
        print(name, json.dumps(figures, indent=2))
        if arguments.write:
            write_section("reliability", name, figures, record)


if __name__ == "__main__":
    main()
