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
from collections import Counter
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.runtime.files import files_of, sha256
from polarnet.runtime.machine import generator_for
from polarnet.storage.events import EventStore

PLACE = "data/train/ours"
"""Where every command writes: `dvc repro train` writes nowhere else."""
STORE = "data/events.zarr"
SMALL = ["synthesize.duration_s=0.1", "synthesize.sensor_height=24", "synthesize.sensor_width=32", "runtime.threads=1"]
TINY: dict[str, dict[str, Any]] = {
    "train": {"windows": 1, "crop": [24, 32]},
    "loss": {"lpips": 0},
    "benchmark": {"lpips": False, "bootstrap_samples": 10},
    "networks": {"polarnet": {"channels": [8, 8, 8, 8, 8]}},
    "baselines": {"e2v": {"crop": [24, 32], "lpips": 0}},
}
"""Values of params.yaml that make a training short."""
MAX_DELAY_S, MAX_SECONDS = 6.0, 600.0
OUTCOMES = ("waited", "refused", "unnamed", "traceback", "lost", "stuck")
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
    "trial": (
        ["stages.trial", f"hydra.run.dir={PLACE}", "benchmark.methods=[ours]"],
        ["loss.mse=1.0", "loss.mse=2.0"],
        ("train/ours", "finished.json"),
    ),
    "dvc repro": (["dvc", "repro", "-s", "--no-run-cache", "--no-commit", "train"], ["--force", "--force"], ("",)),
}
"""Words of each command, words that make two results differ, and the files or folders that hold a result."""


def start(name: str, variant: int, sequences: list[str], output: Path) -> subprocess.Popen[bytes]:
    """A command of COMMANDS in a process, which writes its messages into a file."""
    words, further, _ = COMMANDS[name]
    word = further[variant].replace("FIRST", sequences[0]).replace("LAST", sequences[-1])
    with output.open("wb") as file:
        return subprocess.Popen(
            [sys.executable, "-m", *words, word], stdout=file, stderr=subprocess.STDOUT, start_new_session=True
        )


def result_of(name: str) -> str | None:
    """Digest of the result of a command at PLACE; None if there is none."""
    files = [file for part in COMMANDS[name][2] for file in files_of(Path(PLACE, part))]
    return sha256(*(part for file in files for part in (str(file).encode(), file))) if files else None


def clear() -> None:
    """Remove what is at and beside PLACE."""
    for path in (*Path(PLACE).parent.glob(f"{Path(PLACE).name}*"), Path("outputs")):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def prepare(run_folder: Path, project: Path) -> None:
    """A copy of a project with a finished run, whose trainings are short."""
    shutil.copytree(run_folder, project, ignore=shutil.ignore_patterns(".git", "cache", "tmp"), symlinks=True)
    (project / ".dvc" / "config.local").write_text("[core]\n    no_scm = true\n    analytics = false\n")
    yaml = YAML()
    params = yaml.load(project / "params.yaml")
    for section, values in TINY.items():
        for key, value in values.items():
            params[section][key] = {**params[section][key], **value} if isinstance(value, dict) else value
    yaml.dump(params, project / "params.yaml")
    subprocess.run([sys.executable, "-m", "stages.weights"], cwd=project, check=True)  # short trainings need none


def pairs(run_folder: Path, cases: int) -> dict[str, dict[str, int]]:
    """Outcomes of each two commands: the second waited, one refused, or one of the failures of `studies.faults`.

    A trial is paired with itself alone: no other command writes into the folder of a sweep.
    """
    both = [pair for pair in itertools.combinations_with_replacement(COMMANDS, 2) if pair.count("trial") != 1]
    counts = {pair: Counter(dict.fromkeys(OUTCOMES, 0)) for pair in both}
    with tempfile.TemporaryDirectory() as folder:
        prepare(run_folder, Path(folder, "project"))
        with contextlib.chdir(Path(folder, "project")):
            sequences, outputs = EventStore.open(STORE).sequences, [Path(folder, name) for name in ("first", "second")]
            expected: dict[str, list[str | None]] = {name: [] for name in COMMANDS}
            seconds: dict[str, float] = {}
            for name, variant in itertools.product(COMMANDS, (0, 1)):
                clear()
                began = time.monotonic()
                if start(name, variant, sequences, outputs[0]).wait():
                    raise SystemExit(f"{name} does not run alone:\n{outputs[0].read_text()[-3000:]}")
                seconds[name] = time.monotonic() - began
                expected[name].append(result_of(name))
            for number, pair in itertools.product(range(cases), both):
                clear()
                most_s = min(1.2 * seconds[pair[0]], MAX_DELAY_S)
                delay_s = generator_for(number, " and ".join(pair), "delay").uniform(0, most_s)
                processes = [start(pair[0], 0, sequences, outputs[0])]
                time.sleep(delay_s)
                processes.append(start(pair[1], 1, sequences, outputs[1]))
                what, message = outcome(pair, processes, outputs, expected)
                counts[pair][what] += 1
                if what not in ("waited", "refused"):
                    print(f"{what}: {' and '.join(pair)}, {delay_s:.2f} s apart: {message}", flush=True)
    return {f"{one} and {other} at once": dict(counts[one, other]) for one, other in both}


def outcome(
    names: tuple[str, str],
    processes: list[subprocess.Popen[bytes]],
    outputs: list[Path],
    expected: dict[str, list[str | None]],
) -> tuple[str, str]:
    """Outcome of two commands, and their messages."""
    try:
        codes = [process.wait(MAX_SECONDS) for process in processes]
    except subprocess.TimeoutExpired as error:
        for process in processes:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # with the stages that it started
        return "stuck", str(error)
    texts = [output.read_text() for output in outputs]
    well = [name for name, code in zip(names, codes, strict=True) if code == 0]
    message = " | ".join("".join(text.strip().splitlines()[-1:]) for text in texts)
    if "Traceback" in "".join(texts):
        return "traceback", "".join(texts)[-3000:]
    if not any(result_of(name) in expected[name] for name in well):
        return "lost", f"{well} ended well, but left no whole result: {message}"
    refusals = [text for text, code in zip(texts, codes, strict=True) if code]
    if not all(PLACE in text or "ours" in text for text in refusals):
        return "unnamed", message
    return ("refused" if refusals else "waited"), message
