"""Shared parts of all studies: the record of a measurement, docs/results/NAME.json, command lines, running stages."""

import argparse
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import torch

from polarnet.reports.artefacts import git, processor
from polarnet.runtime.machine import bf16_units, usable_cores

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs" / "pictures"
VERSIONS_OF = ("torch", "numpy", "numba", "zarr", "dvc", "hydra-core")
MEASURED = ("docs/results", "docs/pictures", "dvc.lock", "data/benchmark/metrics.json")
"""Files that measurements write, so that they may differ from the commit that a figure names."""
Measurement = Callable[[argparse.Namespace], tuple[Mapping[str, Any], Mapping[str, Any]]]
"""Figures of a section, and headlines above the sections of its file, for the arguments of the command line."""


def machine_record() -> dict[str, Any]:
    """Machine, versions and commit of a measurement: the keys common to all files in docs/results."""
    return {
        "machine": processor(),
        "bf16_units": bf16_units(torch.device("cpu")),
        "cores": usable_cores(),
        "load": round(os.getloadavg()[0], 2),
        "versions": {"python": platform.python_version()} | {n: importlib.metadata.version(n) for n in VERSIONS_OF},
        "commit": git(ROOT, "rev-parse", "HEAD"),
    }


def uncommitted() -> str:
    """Changed files of the project, except measured ones; empty if a figure may name its commit."""
    but_for = [f":!{path}" for path in MEASURED]
    return git(ROOT, "status", "--porcelain", "--untracked-files=no", "--", ".", *but_for)


def command_line(about: str | None, written: str) -> argparse.ArgumentParser:
    """Parser of a study with the option `--write`; `arguments_of` parses with it."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help=f"write {written}; needs a committed tree")
    return parser


def arguments_of(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The command's arguments, with absolute paths; `--write` with uncommitted changes ends the program."""
    arguments = parser.parse_args()
    if arguments.write and (changed := uncommitted()):
        parser.error(f"--write: commit first, because the figures name a commit; changed:\n{changed}")
    for name, value in vars(arguments).items():
        if isinstance(value, Path):
            setattr(arguments, name, value.resolve())
        elif isinstance(value, list) and value and all(isinstance(one, Path) for one in value):
            setattr(arguments, name, [one.resolve() for one in value])
    return arguments


def measure_sections(
    parser: argparse.ArgumentParser, sections: Mapping[str, tuple[str, str, Measurement]], default: Iterable[str] = ()
) -> None:
    """Measure what `--only` names (`default`, or all), print it, and with `--write` keep it.

    `sections` has the file of docs/results, its section and the measurement by name.
    """
    chosen = [*default] or [*sections]
    parser.add_argument("--only", nargs="+", choices=sections, default=chosen, help=f"default: {' '.join(chosen)}")
    arguments = arguments_of(parser)
    for name in arguments.only:
        file, section, measure = sections[name]
        record, (figures, headlines) = machine_record(), measure(arguments)
        print(name, json.dumps(figures, indent=1), flush=True)
        if arguments.write:
            write_section(file, section, figures, record, headlines)


def in_own_process(function: Callable[..., Any], *arguments: str | int, root: Path = ROOT) -> Any:
    """Print and return the result, as JSON, of a function of a module in a process of its own.

    `root` is the checkout whose modules the process imports. RuntimeError with the messages of a process that fails.
    """
    module, name = function.__globals__["__spec__"].name, function.__name__
    code = f"import json; from {module} import {name}; print(json.dumps({name}(*{arguments})))"
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{name}{arguments} failed:\n{done.stderr[-2000:]}")
    print(f"{name}{arguments}", done.stdout.splitlines()[-1], flush=True)
    return json.loads(done.stdout.splitlines()[-1])


def outcomes(*tests: str) -> dict[str, dict[str, Any]]:
    """Outcome of each case of these tests, by name: `passed`, which a skipped one has not, and what it recorded.

    Tests are named as pytest does.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.xml")
        options = ["-o", "junit_family=xunit1", f"--junitxml={report}"]
        subprocess.run([sys.executable, "-m", "pytest", *tests, *options], cwd=ROOT, check=False)
        cases = list(ElementTree.parse(report).getroot().iter("testcase"))
    not_passed = ("failure", "error", "skipped")
    return {
        str(case.get("name")): {
            "passed": not any(case.find(kind) is not None for kind in not_passed),
            **{str(one.get("name")): one.get("value") for one in case.iter("property")},
        }
        for case in cases
    }


def read_results(name: str) -> dict[str, Any]:
    """Content of docs/results/NAME.json; empty if the file does not exist yet."""
    path = ROOT / "docs" / "results" / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def write_section(
    name: str,
    section: str,
    figures: Mapping[str, Any],
    record: Mapping[str, Any],
    headlines: Mapping[str, Any] | None = None,
) -> Path:
    """Write `figures` and the record taken before measuring as a section of docs/results/NAME.json; others stay.

    `headlines` are figures above the sections; a mapping is merged into the existing one.
    """
    path, known = ROOT / "docs" / "results" / f"{name}.json", read_results(name)
    known["records"] = dict(sorted({**known.get("records", {}), section: dict(record)}.items()))
    known[section] = dict(figures)
    for key, value in (headlines or {}).items():
        known[key] = {**known.get(key, {}), **value} if isinstance(value, Mapping) else value
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(dict(sorted(known.items())), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    print(f"wrote section {section} of {path.relative_to(ROOT)}; `python -m studies.docs` brings it into the pages")
    return path


SCORES = (
    "mse", "psnr", "ssim", "lpips", "lpips_backbone", "level_mse", "pattern_mse", "corr", "grad", "skill", "aolp_deg",
    "ms_per_window", "gflop", "params",
)  # fmt: skip
"""Scores and costs that docs/results keeps of a row; the intervals stay in metrics.json."""


def scores_and_costs(folder: Path) -> dict[str, dict[str, Any]]:
    """Scores and costs by row, from metrics.json and cost.json in the folder of a test set's results."""
    metrics, costs = (json.loads((folder / f"{name}.json").read_text()) for name in ("metrics", "cost"))
    both = {row: {**scores, **costs[row]} for row, scores in metrics.items()}
    return {row: {key: one.get(key) for key in SCORES} for row, one in both.items()}
