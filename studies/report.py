"""The report page in headless Chromium: python -m studies.report --page FILE --benchmark FOLDER [--write]

FILE is the report of a run, or the page of `polarnet benchmark --scenes`, which has no trainings. FOLDER is
the output of `polarnet benchmark --scenes`, or data/benchmark.

- `console_errors`, `outside_requests`, `cut_off_elements`: on FILE at 400, 800 and 1400 pixels, in light and dark, with
  every part of the page open.
- `axe_serious`: serious and critical accessibility faults that axe-core finds, in light and dark.
- `page_mb_50_scenes`, `open_seconds_50_scenes`: size of a page with 50 scenes, and the median time until its player
  shows the first. `page_frames_a_scene` is the number of frames of each. The scenes of FOLDER repeat under other names:
  it is a measurement of the page, not of 50 different scenes.
- `dolp_error_of_player`: mean and largest difference between the DoLP of its strips (WebP) and the DoLP before
  compression.

`--write` puts the figures into docs/results/report.json. Other commands add their own keys there.
"""

import argparse
import json
import re
import shutil
import statistics
import tempfile
import time
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np

from polarnet.reports.page import write_set_page
from studies.browser import axe_serious, chromium_path, cut_off, opened, wait_for_player, wear
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
SCENES = 50
OPENINGS = 5
WIDTHS = (400, 800, 1400)
SCHEMES = ("light", "dark")


def faults(browser: Any, page_file: Path) -> dict[str, int]:
    """Number of faults of a page over all widths and schemes."""
    cut: list[str] = []
    axe: list[str] = []
    with opened(browser, page_file, WIDTHS[-1], SCHEMES[0]) as (page, problems):
        for scheme in SCHEMES:
            for width in WIDTHS:
                wear(page, width, scheme)
                cut += cut_off(page)
            axe += axe_serious(page)
    for problem in (*problems, *cut, *axe):
        print(problem)
    requests = sum(problem.startswith("request") for problem in problems)
    return {
        "console_errors": len(problems) - requests,
        "outside_requests": requests,
        "cut_off_elements": len(cut),
        "axe_serious": len(axe),
    }


def repeated(benchmark: Path, folder: Path) -> Path:
    """A page of `SCENES` scenes from a benchmark's scenes, repeated under other names."""
    shutil.copytree(benchmark, folder, ignore=shutil.ignore_patterns("rows", "sets"))
    details = json.loads((folder / "details.json").read_text())
    names = {f"{scene}-copy-{k}": scene for k, scene in enumerate(islice(cycle(details["scenes"]), SCENES))}
    details["scenes"] = list(names)
    for of_methods in details["scene_means"].values():
        for row, means in of_methods.items():
            of_methods[row] = {name: means[scene] for name, scene in names.items() if scene in means}
    (folder / "details.json").write_text(json.dumps(details))
    panels = sorted((folder / "panels").glob("*.npz"))
    for k, panel in enumerate(islice(cycle(panels), SCENES)):
        shutil.copy(panel, folder / "panels" / f"{panel.stem}-copy-{k}.npz")
    for panel in panels:
        panel.unlink()
    return write_set_page(folder, f"{SCENES} scenes", "python -m studies.report", [])


def strips(page: Path) -> dict[str, Any]:
    """Frames of a scene in the page's player, and the error of the DoLP that its strips hold."""
    player = re.search(r'data-role="data">(.*?)</script>', page.read_text(encoding="utf-8"))
    assert player, f"{page} has no player"
    scenes = json.loads(player[1])["scenes"]
    means, largest = zip(*(one["error"] for scene in scenes for one in scene["maps"] if "error" in one), strict=True)
    error = {"mean": round(statistics.fmean(means), 4), "max": round(max(largest), 3)}
    return {"page_frames_a_scene": min(len(scene["ms"]) for scene in scenes), "dolp_error_of_player": error}


def opening_seconds(browser: Any, file: Path) -> float:
    """Median time from opening a page until the player shows a scene."""
    times = []
    for _ in range(OPENINGS):
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        started = time.perf_counter()
        page.goto(file.as_uri())
        wait_for_player(page)
        times.append(time.perf_counter() - started)
        page.close()
    return statistics.median(times)


def measured(arguments: argparse.Namespace) -> dict[str, Any]:
    """All figures of this command."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as work:
        browser = playwright.chromium.launch(executable_path=chromium_path())
        figures: dict[str, Any] = dict(faults(browser, arguments.page.resolve()))
        page = repeated(arguments.benchmark, Path(work) / "repeated")
        figures["page_mb_50_scenes"] = round(page.stat().st_size / 1e6, 2)
        figures |= strips(page)
        figures["open_seconds_50_scenes"] = round(opening_seconds(browser, page), 2)
        browser.close()
    return figures


def sizes(benchmark: Path) -> dict[str, Any]:
    """Size of the films that were repeated: scenes, and frames, height and width of a film; methods in the table."""
    panels = sorted((benchmark / "panels").glob("*.npz"))
    with np.load(panels[0]) as arrays:
        frames, height, width = arrays["film_truth_dolp"].shape
    methods = len(json.loads((benchmark / "metrics.json").read_text()))
    return {"scenes": len(panels), "frames": frames, "height": height, "width": width, "methods": methods}


def main() -> None:
    """Measure, print and perhaps write."""
    parser = command_line(__doc__, "docs/results/report.json")
    parser.add_argument("--page", type=Path, required=True, help="index.html of a report")
    parser.add_argument("--benchmark", type=Path, required=True, help="folder with metrics.json and panels")
    arguments = arguments_of(parser)
    record = machine_record(ROOT)
    figures = measured(arguments)
    print(json.dumps(figures, indent=2))
    if arguments.write:
        print(write_section(ROOT, "report", "page", sizes(arguments.benchmark), record, figures))


if __name__ == "__main__":
    main()
