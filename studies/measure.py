"""All figures of a release from one commit: python -m studies.measure release --shared FOLDER --work FOLDER

    python -m studies.measure pipeline
    python -m studies.measure paper DATA

`release` runs every study whose section of docs/results names another commit than HEAD, one after the other, so that a
run that was stopped goes on where it was; --only NAME ... takes some files alone. FOLDER of --shared holds the
photographs (data/rgb, data/rgb_more), the measured scenes (data/polarization, data/polarization_more), the recordings
(cases/recordings) that the figures are about, and the published FireNet (weights/firenet_1000.pth.tar). Then
docs/results/release.json gets the commit, the number of sections and of those from another commit, the lines of README
and docs, and what README's installation downloads.

`pipeline` times the demo in a fresh clone (docs/results/pipeline.json). `paper` reads the simulated test set of a run
of experiment=paper_small in the folder DATA, which takes hours and is made by hand (docs/paper.md). All need a
committed tree, because figures name a commit.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from polarnet.runtime.machine import usable_cores
from studies.study import ROOT, machine_record, read_results, scores_and_costs, uncommitted, write_section

SETS = "--photographs {shared}/data/rgb --measured {shared}/data/polarization {shared}/data/polarization_more"
FIRENET = "data/external/firenet_1000.pth.tar"
LARGE = (
    f"{SETS} --photographs-large {{shared}}/data/rgb_more --work {{work}}/robustness --limit 24 --sensor-limit 12 "
    f"--set runtime.workers={usable_cores()} +rows.firenet_published={{{{needs:{FIRENET},settings:methods}}}} --write"
)
STUDIES = {
    ("robustness", "test"): "studies.robustness " + LARGE,
    ("robustness", "frames_test"): "studies.robustness --frames --conditions photographs measured " + LARGE,
    ("robustness", "whole_file_test"): "studies.robustness --whole-file --conditions photographs photographs_large "
    "measured " + LARGE,
    ("robustness", "layers_test"): "studies.robustness --layers " + LARGE,
    ("robustness", "speed"): "studies.speed --only network --write",
    ("robustness", "bounds"): f"studies.registration --work {{work}}/registration {SETS} --write",
    ("emulation", "models"): "studies.speed --only simulation --write",
    ("speed", "live"): "studies.speed --only live --write",
    ("recordings", "readers"): "studies.recordings --only readers --write",
    ("recordings", "memory"): "studies.recordings --only memory --write",
    ("recordings", "cases"): "studies.recordings --only cases --write",
    ("recordings", "pdavis"): "studies.pdavis {work}/pdavis --write",
    ("camera", "defects"): "studies.camera --only defects --write",
    ("light", "dolp"): "studies.camera --only events dolp --write",
    ("reliability", "artefacts"): "studies.faults --write",
    ("pipeline", "demo"): "studies.measure pipeline",
}
"""Command by file and section of docs/results. Some write further sections of the same file."""
INSTALL = ("-c", "constraints.txt", ".[recordings]")  # README's
DEMO_METRICS = "data/benchmark/metrics.json"


def commits_of_results() -> dict[tuple[str, str], str]:
    """Commit by file and section of every measurement in docs/results."""
    files = sorted((ROOT / "docs" / "results").glob("*.json"))
    records = {path.stem: read_results(path.stem).get("records", {}) for path in files}
    return {(name, part): one["commit"] for name, of_file in records.items() for part, one in of_file.items()}


def download_mb(*requirements: str) -> int:
    """Megabytes that pip downloads to install `requirements` into an empty environment."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--dest", folder, *requirements]
        subprocess.run(command, cwd=ROOT, check=True)
        return round(sum(file.stat().st_size for file in Path(folder).iterdir()) / 1e6)


def lines_of(*files: Path) -> int:
    """Lines of text files together."""
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def measure_release(shared: Path, work: Path, only: list[str] | None) -> Path:
    """Measure what HEAD has not measured, then write release.json; CalledProcessError if a study fails."""
    record = machine_record()
    (ROOT / FIRENET).parent.mkdir(parents=True, exist_ok=True)
    if (published := shared / "weights" / Path(FIRENET).name).exists():
        shutil.copy(published, ROOT / FIRENET)
    environment = os.environ | {"POLARNET_SHARED": str(shared)}
    for (name, section), words in STUDIES.items():
        measured = commits_of_results().get((name, section)) == record["commit"]
        if not measured and (only is None or name in only):
            print(f"{name}, {section}: python -m {words}", flush=True)
            command = words.format(shared=shared, work=work).split()
            subprocess.run([sys.executable, "-m", *command], cwd=ROOT, env=environment, check=True)
    commits = commits_of_results()
    figures = {
        "commit": record["commit"],
        "tables": len(commits),
        "tables_of_other_commits": sum(commit != record["commit"] for commit in commits.values()),
        "readme_lines": lines_of(ROOT / "README.md"),
        "docs_lines": lines_of(*(ROOT / "docs").glob("*.md")),
        "install_mb_cpu": download_mb(*INSTALL),
    }
    return write_section("release", "release", {}, record, figures)


def measure_pipeline() -> Path:
    """Clone HEAD, time its set-up, `make repro` and `make test`; write pipeline.json.

    `dvc.lock` and the demo's metrics come from the same run. CalledProcessError if a command fails.
    """
    machine = machine_record()
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "polarnet"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
        figures: dict[str, Any] = {f"{target}_minutes": minutes_of(target, clone) for target in ("setup", "repro")}
        (ROOT / DEMO_METRICS).parent.mkdir(parents=True, exist_ok=True)
        for name in ("dvc.lock", DEMO_METRICS):
            shutil.copy(clone / name, ROOT / name)
        figures["test_minutes"] = minutes_of("test", clone)
    return write_section("pipeline", "demo", figures, machine)


def minutes_of(target: str, folder: Path) -> float:
    """Run `make target`, and return its minutes; CalledProcessError if it fails."""
    started = time.monotonic()
    subprocess.run(["make", target], cwd=folder, check=True)
    return round((time.monotonic() - started) / 60, 2)


def measure_paper(data: Path) -> Path:
    """Write paper.json from the simulated test set of a finished run of experiment=paper_small in the folder `data`."""
    folder = data / "benchmark" / "sets" / "simulated"
    details = json.loads((folder / "details.json").read_text(encoding="utf-8"))
    figures = {"scenes": len(details["scenes"]), "frames": details["frames"], "rows": scores_and_costs(folder)}
    return write_section("paper", "paper_small", figures, machine_record())


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(dest="kind", required=True)
    release = kinds.add_parser("release")
    release.add_argument("--shared", type=Path, required=True)
    release.add_argument("--work", type=Path, required=True)
    release.add_argument("--only", nargs="+", metavar="NAME", help="files of docs/results (default: all)")
    kinds.add_parser("pipeline")
    kinds.add_parser("paper").add_argument("data", type=Path)
    arguments = parser.parse_args()
    if changed := uncommitted():
        parser.error(f"commit first, because the figures name a commit; changed:\n{changed}")
    if arguments.kind == "release":
        measure_release(arguments.shared.resolve(), arguments.work.resolve(), arguments.only)
    elif arguments.kind == "pipeline":
        measure_pipeline()
    else:
        measure_paper(arguments.data.resolve())


if __name__ == "__main__":
    main()
