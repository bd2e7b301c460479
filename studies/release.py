"""All figures of a release from one commit: python -m studies.release --shared FOLDER --work FOLDER [--only NAME ...]

Runs every study whose section of docs/results names another commit than HEAD, one after the other, so that a run that
was stopped goes on where it was. FOLDER of --shared holds the photographs (data/rgb, data/rgb_more), the measured
scenes (data/polarization, data/polarization_more), the recordings (cases/recordings) that the figures are about, and
the published FireNet (weights/firenet_1000.pth.tar). The two runs of hours, `paper_small` and `photographs`, are made
by hand (`studies.measure --run`).

Then docs/results/release.json gets the commit, the number of sections and of those from another commit, the lines of
README and docs, and what README's installation downloads.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from studies.study import ROOT, arguments_of, command_line, machine_record, read_results, write_section

SETS = "--photographs {shared}/data/rgb --measured {shared}/data/polarization {shared}/data/polarization_more"
FIRENET = "data/external/firenet_1000.pth.tar"
LARGE = (
    f"{SETS} --photographs-large {{shared}}/data/rgb_more --work {{work}}/robustness --limit 24 --sensor-limit 12 "
    f"--set +rows.firenet_published={{{{needs:{FIRENET},settings:methods}}}}"
)
STUDIES = {
    ("robustness", "test"): "studies.robustness " + LARGE,
    ("robustness", "frames_test"): "studies.robustness --frames --conditions photographs measured " + LARGE,
    ("robustness", "whole_file_test"): "studies.robustness --whole-file --conditions photographs photographs_large "
    "measured " + LARGE,
    ("robustness", "speed"): "studies.speed --only network",
    ("registration", "bounds"): "studies.registration --work {work}/registration " + SETS,
    ("emulation", "models"): "studies.speed --only simulation",
    ("speed", "live"): "studies.speed --only live",
    ("recordings", "readers"): "studies.recordings --sections readers bytes",
    ("recordings", "memory"): "studies.recordings --sections memory",
    ("recordings", "cases"): "studies.recordings --sections cases",
    ("recordings", "pdavis"): "studies.pdavis {work}/pdavis",
    ("camera", "defects"): "studies.camera",
    ("light", "dolp"): "studies.light",
    ("reliability", "artefacts"): "studies.faults",
    ("pipeline", "demo"): "studies.measure --pipeline",
}
"""Command by file and section of docs/results. Some write further sections of the same file."""
INSTALL = ("-c", "constraints.txt", ".[recordings]")  # README's


def of_other_commits(commit: str) -> list[tuple[str, str]]:
    """File and section of every measurement in docs/results that names another commit."""
    files = sorted((ROOT / "docs" / "results").glob("*.json"))
    records = {path.stem: read_results(ROOT, path.stem).get("records", {}) for path in files}
    return [(name, part) for name, of_file in records.items() for part, one in of_file.items()
            if one["commit"] != commit]  # fmt: skip


def download_mb(*requirements: str) -> int:
    """Megabytes that pip downloads to install `requirements` into an empty environment."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--dest", folder, *requirements]
        subprocess.run(command, cwd=ROOT, check=True)
        return round(sum(file.stat().st_size for file in Path(folder).iterdir()) / 1e6)


def lines_of(*files: Path) -> int:
    """Lines of text files together."""
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def release(commit: str) -> dict[str, Any]:
    """The figures of docs/results/release.json."""
    sections = sum(len(read_results(ROOT, path.stem).get("records", {})) for path in (ROOT / "docs/results").iterdir())
    return {
        "commit": commit,
        "tables": sections,
        "tables_of_other_commits": len(of_other_commits(commit)),
        "readme_lines": lines_of(ROOT / "README.md"),
        "docs_lines": lines_of(*(ROOT / "docs").glob("*.md")),
        "install_mb_cpu": download_mb(*INSTALL),
    }


def main() -> None:
    """Measure what is missing, then write docs/results/release.json."""
    parser = command_line(__doc__, "every section that is measured, and docs/results/release.json")
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--only", nargs="*", metavar="NAME", help="files of docs/results (default: all)")
    arguments = arguments_of(parser)
    record = machine_record()
    (ROOT / FIRENET).parent.mkdir(parents=True, exist_ok=True)
    if (published := arguments.shared / "weights" / Path(FIRENET).name).exists():
        shutil.copy(published, ROOT / FIRENET)
    missing = set(of_other_commits(record["commit"]))
    environment = os.environ | {"POLARNET_SHARED": str(arguments.shared)}
    for (name, section), words in STUDIES.items():
        measured = section in read_results(ROOT, name).get("records", {}) and (name, section) not in missing
        if measured or (arguments.only is not None and name not in arguments.only):
            continue
        command = words.format(shared=arguments.shared, work=arguments.work).split()
        writing = [] if command[1:] == ["--pipeline"] else ["--write"] * arguments.write
        print(f"{name}, {section}: python -m {' '.join([*command, *writing])}", flush=True)
        subprocess.run([sys.executable, "-m", *command, *writing], cwd=ROOT, env=environment, check=True)
    figures = release(record["commit"])
    print(json.dumps(figures, indent=1))
    if arguments.write:
        write_section("release", "release", {}, record, figures)


if __name__ == "__main__":
    main()
