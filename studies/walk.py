"""Walks of a new user, from nothing to a result: python -m studies.walk [--write]

Each walk types its commands into a shell, in a new folder that holds the user's own files alone, with a new Python
environment. A command that fails, or a result that is not there at the end, ends the study. The environment already
sees the packages that polarnet needs, so the seconds do not contain their download. `--write` puts commands and
seconds into docs/results/report.json, with the largest number of commands as `new_user_commands`.
"""

import json
import os
import re
import shutil
import subprocess
import sysconfig
import tempfile
import time
import venv
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from polarnet.cli import main as polarnet
from polarnet.pictures import BUILTIN_PHOTOS
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
CLONE = 'git clone "$POLARNET" polarnet'
INSTALL = "pip install ./polarnet"
VIDEO = b"ftyp"
"""Bytes at the start of every MP4."""


class Walk(NamedTuple):
    """Commands from nothing to a result."""

    title: str
    commands: tuple[str, ...]
    result: str
    """File that the last command leaves."""
    contains: bytes


WALKS = {
    "demo": Walk(
        "the first DoLP video", (CLONE, INSTALL, "polarnet demo"), "outputs/demo/recovered/recovered.mp4", VIDEO
    ),
    "photograph": Walk(
        "a video of their own photograph",
        (CLONE, INSTALL, "polarnet simulate lake.png --out lake", "polarnet recover lake/events.zarr --out recovered"),
        "recovered/recovered.mp4",
        VIDEO,
    ),
    "camera": Walk(
        "a video of their own camera file",
        (CLONE, INSTALL, 'polarnet recover my_camera.raw --mosaic "90 45 / 135 0"'),
        "outputs/recover/my_camera/recovered.mp4",
        VIDEO,
    ),
    "method": Walk(
        "an own method in the table",
        (
            CLONE,
            "pip install --editable ./polarnet",
            "cp activity.py polarnet/polarnet/methods",
            "polarnet benchmark --scenes photographs --methods activity,highpass,ours benchmark.lpips=false",
        ),
        "outputs/benchmark/photographs/metrics.json",
        b'"activity"',
    ),
}


def write_own_files(folder: Path) -> None:
    """Files that a user brings: photographs, a recording of a simulated camera, and the method of docs/methods.md."""
    (folder / "photographs").mkdir(parents=True)
    photos = [photo.path for photo in BUILTIN_PHOTOS if photo.path.stem in ("coffee", "astronaut", "chelsea")]
    for path in photos:
        shutil.copy(path, folder / "photographs")
    shutil.copy(photos[0], folder / "lake.png")
    size = ["ingest.height=256", "ingest.width=384", "synthesize.sensor_height=128", "synthesize.sensor_width=192"]
    with tempfile.TemporaryDirectory() as work:
        camera = ["polarizers=micropolarizers", *size, "--format", "evt3", "--no-preview", "--out", f"{work}/camera"]
        if polarnet(["simulate", str(photos[0]), *camera]):
            raise RuntimeError("the recording of a simulated camera failed; see the message above")
        shutil.copy(next(Path(work, "camera").glob("sensor*.raw")), folder / "my_camera.raw")
    module = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "methods.md").read_text(), re.DOTALL)
    assert module, "docs/methods.md shows no method"
    (folder / "activity.py").write_text(module[1])


def new_environment(folder: Path) -> dict[str, str]:
    """Variables of a shell with a new Python environment, which sees the packages of this one."""
    venv.create(folder, with_pip=True)
    packages = sysconfig.get_path("purelib", "venv", {"base": str(folder)})
    Path(packages, "shared.pth").write_text(sysconfig.get_path("purelib") + "\n")
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return {**inherited, "PATH": f"{folder / 'bin'}:{inherited['PATH']}", "POLARNET": str(ROOT)}


def walked(walk: Walk, folder: Path, environment: Mapping[str, str]) -> list[float]:
    """Seconds of each command in `folder`; RuntimeError for one that fails, and for a missing result."""
    seconds = []
    for command in walk.commands:
        started = time.perf_counter()
        run = subprocess.run(["bash", "-c", command], cwd=folder, env=environment, capture_output=True, text=True)
        seconds.append(round(time.perf_counter() - started, 1))
        print(f"{seconds[-1]:7.1f} s  {command}", flush=True)
        if run.returncode:
            raise RuntimeError(f"{command}: status {run.returncode}: {run.stderr}")
    result = folder / walk.result
    if not result.is_file() or walk.contains not in result.read_bytes():
        raise RuntimeError(f"{walk.title}: expected {walk.result} with {walk.contains!r} in it")
    return seconds


def measured() -> dict[str, Any]:
    """Commands and seconds of all walks, each in a folder and an environment of its own."""
    figures = {}
    with tempfile.TemporaryDirectory() as work:
        write_own_files(Path(work, "own"))
        for name, walk in WALKS.items():
            shutil.copytree(Path(work, "own"), Path(work, name))
            seconds = walked(walk, Path(work, name), new_environment(Path(work, f"{name}-python")))
            figures[name] = {"title": walk.title, "commands": list(walk.commands), "seconds": seconds}
    return figures


def main() -> None:
    """Walk, print and perhaps write."""
    arguments = arguments_of(command_line(__doc__, "docs/results/report.json"))
    record, figures = machine_record(ROOT), measured()
    largest = max(len(walk["commands"]) for walk in figures.values())
    print(json.dumps({**figures, "new_user_commands": largest}, indent=2))
    if arguments.write:
        print(write_section(ROOT, "report", "walk", figures, record, {"new_user_commands": largest}))


if __name__ == "__main__":
    main()
