"""The pipeline's outputs as the report reads them, and the code, machine and versions behind them."""

import json
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from polarnet.reports.legend import Legend, legend_of
from polarnet.reports.tables import Table, score_table
from polarnet.runtime.machine import usable_cores
from polarnet.storage.panels import Panel, read_panel
from polarnet.terminal.installation import versions

SIMULATED = "simulated"  # name of the pipeline's own test set
TITLES = {"measured": "Measured polarization", "recordings": "Real targets"}  # of the pipeline's further test sets


@dataclass(frozen=True)
class ReportPaths:
    """Paths of the artefacts that the report reads, named like the stages' outputs."""

    images: Path
    scenes: Path
    train: Path  # holds a folder for each trained network
    benchmark: Path

    @property
    def simulated(self) -> Path:
        """Results on the simulated test set."""
        return self.benchmark / "sets" / SIMULATED


class Results(NamedTuple):
    """Benchmark results on one test set."""

    name: str
    metrics: Mapping[str, Mapping[str, Any]]  # scores and costs by row
    details: Mapping[str, Any]  # content of details.json: the test data scored, and each scene's mean
    panels: Sequence[Panel]

    @property
    def title(self) -> str:
        """Title of the test set on a page; the name for a set of the user's."""
        return TITLES.get(self.name, self.name)

    @property
    def legend(self) -> Legend:
        """Labels and colours that name the networks behind the rows."""
        return legend_of(self.details["weights"])

    @property
    def table(self) -> Table:
        """The scores, with a note on the windows that count."""
        return score_table(self.metrics, labels=self.legend.labels, warmup_windows=self.details["warmup_windows"])


def read_results(folder: Path) -> Results:
    """Read a folder written by `write_benchmark`; the set's name comes from details.json, or from the folder."""
    details, costs = _json(folder / "details.json"), _json(folder / "cost.json")
    metrics = {row: {**scores, **costs[row]} for row, scores in _json(folder / "metrics.json").items()}
    panels = [read_panel(path) for path in sorted((folder / "panels").glob("*.npz"))]
    return Results(details.get("set", folder.name), metrics, details, panels)


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


class Run(NamedTuple):
    """Provenance of a run's results, as shown on the page."""

    command: str  # repeats it
    parameters: Mapping[str, Any]  # the params.yaml in use: sections and single values
    facts: Mapping[str, str]  # seed, commit, machine, versions


def facts(root: Path) -> dict[str, str]:
    """Commit of the project at `root`, if any, and machine and versions of this process."""
    commit = git(root, "rev-parse", "HEAD") or "none: not a git repository with a commit"
    # the pipeline's own outputs do not count as changes of the code
    changed = git(root, "status", "--porcelain", "--untracked-files=no", "--", ".", ":!dvc.lock", ":!data")
    return {
        "commit": f"{commit}, with uncommitted changes" if changed else commit,
        "machine": f"{processor()}, {usable_cores()} cores, {platform.system()} {platform.machine()}",
        "versions": f"Python {platform.python_version()}, {versions()}",
    }


def git(root: Path, *arguments: str) -> str:
    """Output of a git command; empty if it fails."""
    try:
        done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True)
    except FileNotFoundError:  # git is not installed
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def processor() -> str:
    """The processor's name, as reported by the system."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
