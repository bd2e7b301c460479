"""Recordings with true polarization: python -m studies.recorded [--published ROW=FILE ...] [--write].

Built-in photographs are simulated and written as a PDAVIS records them, in E2P's layout (`studies.e2p_writer`). The
truth reader is compared with the simulated truth, and `polarnet benchmark --recordings` scores every method that has
its weights. `--write` puts the scores into docs/results/recorded.json and draws docs/pictures/recorded.png.
"""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from polarnet.cli import main as polarnet
from polarnet.config.tree import load
from polarnet.events.mosaic import join_mosaic
from polarnet.networks.e2p.network import MOSAIC
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.recordings.truth import read_truth
from polarnet.simulation.sets import make_folder_set
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from studies.e2p_writer import WHITE, mosaicked, write_e2p
from studies.study import (
    PICTURES,
    ROOT,
    arguments_of,
    command_line,
    machine_record,
    row_of,
    scores_and_costs,
    write_section,
)

PHOTOGRAPHS = ("astronaut", "coffee", "rocket")
MOSAIC_TEXT = "90 45 / 135 0"


def write_recordings(made: Path, folder: Path) -> None:
    """Write every sequence of a simulated set as a file of E2P: events and frames of the mosaic, and its maps."""
    events, frames = EventStore.open(made / "events.zarr"), FrameStore.open(made / "frames.zarr")
    folder.mkdir(parents=True, exist_ok=True)
    for name in events.sequences:
        truth = frames.frames(name)
        s0 = (truth.intensity[:, 0] + truth.intensity[:, 2]).numpy()
        levels = np.rint(WHITE * mosaicked(2 * truth.intensity.numpy()).clip(0, 1)).astype(np.uint8)
        maps = s0, truth.dolp.numpy(), truth.aolp.numpy()
        write_e2p(folder / f"{name}.h5", join_mosaic(events.read(name), MOSAIC), truth.t_us.numpy(), levels, maps)


def reader_errors(made: Path, folder: Path) -> dict[str, float]:
    """Largest error of the truth reader's DoLP and AoLP (degrees, where DoLP is above 0.1) against the simulated truth.

    The file holds maps in 255 steps, so half a step remains.
    """
    frames, dolp, aolp = FrameStore.open(made / "frames.zarr"), 0.0, 0.0
    for name in frames.sequences:
        known, truth = frames.frames(name), read_truth(folder / f"{name}.h5", MOSAIC)
        dolp = max(dolp, float((truth.dolp - known.dolp).abs().max()))
        away = torch.asin(torch.sin(truth.aolp - known.aolp)).abs()[known.dolp > 0.1]
        aolp = max(aolp, float(torch.rad2deg(away.max())))
    return {"dolp": dolp, "aolp_deg": aolp}


def measured(work: Path, photographs: Sequence[Path], rows: Sequence[str], overrides: Sequence[str]) -> dict[str, Any]:
    """Scores by row and errors of the truth reader; the benchmark's files are in `work`/benchmark."""
    pictures, made, folder = (work / name for name in ("pictures", "made", "recordings"))
    pictures.mkdir(parents=True)
    for photograph in photographs:
        (pictures / photograph.name).symlink_to(photograph)
    config = load(ROOT)
    make_folder_set(pictures, "photographs", made, config.recipe, config.mapper)
    write_recordings(made, folder)
    asked = ["--recordings", str(folder), "--mosaic", MOSAIC_TEXT, "--methods", ",".join(rows)]
    if polarnet(["benchmark", *asked, "--out", str(work / "benchmark"), *overrides]):
        raise RuntimeError("polarnet benchmark --recordings failed; what it printed is above")
    return {"rows": scores_and_costs(work / "benchmark"), "reader_errors": reader_errors(made, folder)}


def main() -> None:
    """Measure, print and perhaps write."""
    parser = command_line(__doc__, "docs/results/recorded.json")
    parser.add_argument("--published", nargs="*", default=[], metavar="ROW=FILE", help="published weights of a row")
    arguments = arguments_of(parser)
    record = machine_record()
    given = dict(entry.split("=", 1) for entry in arguments.published)
    rows = ["zeros", "oracle_mean", "cf", "highpass", "cf+gain", "highpass+gain", *given]
    rows += [f"{row}+gain" for row in given if not row.startswith("e2p")]
    weights = [row_of(row, Path(file)) for row, file in given.items()]
    photographs = [photo.path for photo in BUILTIN_PHOTOS if photo.path.stem in PHOTOGRAPHS]
    with tempfile.TemporaryDirectory() as folder:
        results = measured(Path(folder), photographs, [*rows, "ours"], weights)
        print(json.dumps({row: scores["psnr"] for row, scores in results["rows"].items()}, indent=2))
        if arguments.write:
            write_section("recorded", "simulated", results, record)
            with Image.open(Path(folder, "benchmark", "comparison.png")) as picture:
                picture.reduce(2).quantize().save(PICTURES / "recorded.png", optimize=True)


if __name__ == "__main__":
    main()
