"""Commands that run two at once and write to one place: the second must wait or refuse, and one result stay whole."""

import contextlib
import itertools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.runtime.files import files_of, sha256
from polarnet.runtime.machine import generator_for
from polarnet.storage.events import EventStore

PLACE = "data/train/ours"
"""Where every command writes: `dvc repro train` writes nowhere else."""
STORE = "data/events.zarr"
SMALL = ["synthesize.duration_s=0.2", "synthesize.sensor_height=24", "synthesize.sensor_width=32", "runtime.threads=1"]
TINY: dict[str, dict[str, Any]] = {
    "train": {"windows": 1, "crop": [24, 32]},
    "loss": {"lpips": 0},
    "benchmark": {"lpips": False, "bootstrap_samples": 10},
    "networks": {"polarnet": {"channels": [8, 8, 8, 8, 8]}},
    "baselines": {"e2v": {"crop": [24, 32], "lpips": 0}},
}
"""Values of params.yaml that make a training short."""
MAX_DELAY_S = 12.0
STUCK_S = 300
"""A command that takes longer does not end."""
POLARNET, TO_PLACE = "polarnet.cli", ["--out", PLACE]
COMMANDS: dict[str, tuple[list[str], list[str], tuple[str, ...]]] = {
    "recover": (
        [POLARNET, "recover", STORE, "--method", "cf", "--write", "zarr", *TO_PLACE],
        ["--sequence=FIRST", "--sequence=LAST"],
        ("recovered.zarr",),
    ),
    "simulate": (
        [POLARNET, "simulate", str(BUILTIN_PHOTOS[0].path), "--no-preview", *TO_PLACE, *SMALL],
        ["seed=1", "seed=2"],
        ("events.zarr", "truth.zarr"),
    ),
    "demo": (
        [POLARNET, "demo", *TO_PLACE, *SMALL],
        ["seed=1", "seed=2"],
        ("simulated/events.zarr", "recovered/recovered.zarr"),
    ),
    "view": ([POLARNET, "view", STORE, "--no-browser", *TO_PLACE], ["--sequence=FIRST", "--sequence=LAST"], ("",)),
    "trial": (["stages.trial", f"hydra.run.dir={PLACE}", "benchmark.methods=[ours]"],
              ["loss.mse=1.0", "loss.mse=2.0"], ("train/ours", "finished.json")),
    "dvc repro": (["dvc", "repro", "-f", "-s", "--no-run-cache", "--no-commit", "train"], ["", ""], ("",)),
}  # fmt: skip
"""Words after `python -m`, words that make two results differ, and the files or folders that hold a result."""


def start(name: str, variant: int, output: Path) -> subprocess.Popen:
    """A process, the first of its own group, that runs a command and writes its messages into a file."""
    words, further, _ = COMMANDS[name]
    command = [sys.executable, "-m", *words, *filter(None, [further[variant]])]
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}  # in which DVC looks
    with output.open("wb") as file:
        return subprocess.Popen(command, stdout=file, stderr=file, env=environment, start_new_session=True)


def result_of(name: str) -> str | None:
    """Digest of the result of a command at PLACE; None if there is none."""
    places = [Path(PLACE, part) for part in COMMANDS[name][2]]
    files = [file for place in places for file in files_of(place)]
    return sha256(*(part for file in files for part in (str(file).encode(), file))) if files else None


def clear() -> None:
    """Remove what is at and beside PLACE."""
    for path in (*Path(PLACE).parent.glob(f"{Path(PLACE).name}*"), Path("outputs")):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def prepare(run_folder: Path, scratch: Path) -> None:
    """A copy of a project with a finished run, whose trainings are short; it becomes the working folder."""
    shutil.copytree(run_folder, scratch, ignore=shutil.ignore_patterns(".git", "cache", "tmp"), symlinks=True)
    os.chdir(scratch)
    Path(".dvc", "config.local").write_text("[core]\n    no_scm = true\n    analytics = false\n")
    OmegaConf.save(OmegaConf.merge(OmegaConf.load("params.yaml"), TINY), "params.yaml")
    config = Path("conf", "config.yaml")
    config.write_text(config.read_text().replace("threads: 0", "threads: 1"))
    first, *_, last = EventStore.open(STORE).sequences
    for words in COMMANDS.values():
        words[1][:] = [word.replace("FIRST", first).replace("LAST", last) for word in words[1]]


def pairs(run_folder: Path, cases: int) -> dict[str, dict[str, int]]:
    """Outcomes of each two commands: the second waited, one refused, or one of the failures of `studies.faults`.

    A trial is paired with itself alone: no other command writes into the folder of a sweep.
    """
    both = [pair for pair in itertools.combinations_with_replacement(COMMANDS, 2) if pair.count("trial") != 1]
    counts = {
        f"{one} and {other} at once": dict.fromkeys(("waited", "refused", "unnamed", "traceback", "lost", "stuck"), 0)
        for one, other in both
    }
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        prepare(run_folder, Path(folder, "project"))
        output = Path(folder, "output")
        expected: dict[str, list[str | None]] = {}
        seconds: dict[str, float] = {}
        for name in COMMANDS:
            for variant in (0, 1):
                clear()
                began = time.monotonic()
                if start(name, variant, output).wait():
                    raise SystemExit(f"{name} does not run alone:\n{output.read_text()[-3000:]}")
                expected.setdefault(name, []).append(result_of(name))
                seconds[name] = time.monotonic() - began
            print(name, f"{seconds[name]:.1f} s", flush=True)
        for number, (one, other) in itertools.product(range(cases), both):
            clear()
            longest_s = min(1.2 * seconds[one], MAX_DELAY_S)
            delay = generator_for(number, f"{one} and {other}", "delay").uniform(0, longest_s)
            what, message = outcome((one, other), delay, Path(folder), expected)
            counts[f"{one} and {other} at once"][what] += 1
            if what not in ("waited", "refused"):
                print(f"{what}: {one} and {other}, {delay:.2f} s apart: {message}", flush=True)
    return counts


def outcome(
    names: tuple[str, str], delay: float, folder: Path, expected: dict[str, list[str | None]]
) -> tuple[str, str]:
    """Outcome of two commands, and their messages."""
    outputs = [folder / "first", folder / "second"]
    processes = [start(names[0], 0, outputs[0])]
    time.sleep(delay)
    processes.append(start(names[1], 1, outputs[1]))
    try:
        for process in processes:
            process.wait(STUCK_S)
    except subprocess.TimeoutExpired:
        for process in processes:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
        return "stuck", "".join(output.read_text() for output in outputs)[-6000:]
    texts = [output.read_text() for output in outputs]
    well = [name for name, process in zip(names, processes, strict=True) if process.returncode == 0]
    message = " | ".join(text.strip().splitlines()[-1] if text.strip() else "" for text in texts)
    if "Traceback" in "".join(texts):
        return "traceback", "".join(texts)[-3000:]
    if not any(result_of(name) in expected[name] for name in well):
        return "lost", f"{well} ended well, but left no whole result: {message}"
    refusals = [text for text, process in zip(texts, processes, strict=True) if process.returncode]
    if not all(PLACE in text or "ours" in text for text in refusals):
        return "unnamed", message
    return ("refused" if refusals else "waited"), message
