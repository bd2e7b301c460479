"""Recordings with true polarization: python -m studies.recorded [--published ROW=FILE ...] [--picture] [--write].

Built-in photographs are simulated and written as a PDAVIS records them, in E2P's layout (`studies.e2p_writer`). The
truth reader is compared with the simulated truth, and `polarnet benchmark --recordings` scores every method that has
its weights. `--write` puts the scores into docs/results/recorded.json, and the number of formats that polarnet reads
and of methods scored into docs/results/paper.json; `--picture` draws docs/pictures/recorded.png.
"""

import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from polarnet.cli.own_scenes import Request, benchmark_recordings
from polarnet.config.tree import Config, load
from polarnet.events.mosaic import join_mosaic
from polarnet.networks.e2p.network import MOSAIC
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.recordings.noise import Cleaning
from polarnet.recordings.recording import FORMATS
from polarnet.recordings.truth import read_truth
from polarnet.reports.tables import as_markdown, score_table
from polarnet.simulation.sets import make_folder_set
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from studies.e2p_writer import WHITE, mosaicked, write_e2p
from studies.measure import ROOT, arguments_of, command_line, machine_record, write_section
from studies.tables import Block

PHOTOGRAPHS = ("astronaut", "coffee", "rocket")
NO_CLEANING = Cleaning(None, 4.0, None)


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


def measured(config: Config, work: Path, photographs: Sequence[Path]) -> tuple[dict[str, Any], Path]:
    """Scores by method, errors of the truth reader, and the folder of the benchmark's page."""
    pictures, made, folder, out = (work / name for name in ("pictures", "made", "recordings", "benchmark"))
    pictures.mkdir(parents=True)
    for photograph in photographs:
        (pictures / photograph.name).symlink_to(photograph)
    make_folder_set(pictures, "photographs", made, config.recipe, config.mapper)
    write_recordings(made, folder)
    out.mkdir()
    command = "polarnet benchmark --recordings recordings"
    request = Request(folder, out, work / "work", None, command)
    notes = benchmark_recordings(config, request, MOSAIC, NO_CLEANING)
    print("\n".join(notes))
    scores = json.loads((out / "metrics.json").read_text())
    return {"scores": scores, "reader_errors": reader_errors(made, folder)}, out


RECORDED_BLOCK = Block(
    "recorded",
    "simulated",
    "studies.recorded",
    lambda results: as_markdown(score_table(results["simulated"]["scores"])),
    caption="Simulated photographs in E2P's layout. The truth reader's DoLP differs from the simulated one by at most "
    "{simulated[reader_errors][dolp]:.4f}, its AoLP by at most {simulated[reader_errors][aolp_deg]:.2f} degrees: "
    "half a step between the file's whole numbers. {origin}",
)


def figures_of(scores: Mapping[str, Any]) -> dict[str, int]:
    """The number of methods scored, without references."""
    return {"methods": len(set(scores) - {"zeros", "train_mean", "oracle_mean"})}


def main() -> None:
    """Measure, print and perhaps write."""
    parser = command_line(__doc__, "docs/results/recorded.json and paper.json")
    parser.add_argument("--published", nargs="*", default=[], metavar="ROW=FILE", help="published weights of a row")
    parser.add_argument("--picture", action="store_true", help="draw docs/pictures/recorded.png")
    arguments = arguments_of(parser)
    record = machine_record(ROOT)
    given = dict(entry.split("=", 1) for entry in arguments.published)
    rows = ["zeros", "oracle_mean", "cf", "highpass", "cf+gain", "highpass+gain", *given]
    rows += [f"{row}+gain" for row in given if not row.startswith("e2p")]
    weights = [f"methods.{row}.weights={Path(file).resolve()}" for row, file in given.items()]
    config = load(ROOT, [f"benchmark.methods=[{','.join([*rows, 'ours'])}]", *weights])
    photographs = [photo.path for photo in BUILTIN_PHOTOS if photo.path.stem in PHOTOGRAPHS]
    with tempfile.TemporaryDirectory() as folder:
        results, out = measured(config, Path(folder), photographs)
        if arguments.picture:
            with Image.open(out / "comparison.png") as picture:
                picture.reduce(2).quantize().save(ROOT / "docs" / "pictures" / "recorded.png", optimize=True)
    print(json.dumps({row: scores["psnr"] for row, scores in results["scores"].items()}, indent=2))
    print(results["reader_errors"], {"formats_read": len(FORMATS)}, figures_of(results["scores"]))
    if arguments.write:
        print(write_section(ROOT, "recorded", "simulated", results, record))
        figures = figures_of(results["scores"])
        print(write_section(ROOT, "paper", "recordings_with_truth", figures, record, {"formats_read": len(FORMATS)}))


if __name__ == "__main__":
    main()
