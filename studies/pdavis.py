"""A static polarizer before a PDAVIS, written as jAER, DV and E2P write it: python -m studies.pdavis FOLDER [--write].

Squares of a polarizer at 0, 30 or 90 degrees lie on a photograph, over which a sensor of 260x346 pixels with a mosaic
moves. (Events of a scene that is polarized alike everywhere are those of an unpolarized one: they see ratios of light.)
FOLDER gets pdavis_ANGLE.aedat, .aedat4 and .h5, each with events and frames. AoLP that `polarnet recover` finds in each
file, and AoLP of its frames, are compared with the polarizer's. --write: docs/results/recordings.json, section pdavis.
"""

import argparse
import math
from datetime import timedelta
from pathlib import Path
from typing import Any

import dv_processing
import numpy as np
import torch
import zarr
from jaxtyping import Int64, UInt8

from polarnet.cli import main as polarnet
from polarnet.events.stream import Events, join_mosaic
from polarnet.networks.e2p.network import MOSAIC
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.pictures.images import read_rgb, write_png
from polarnet.recordings.truth import read_truth
from polarnet.stokes import POLARIZER_ANGLES_DEG, intensities_from_stokes, stokes_from_polarization
from polarnet.storage.events import EventStore
from polarnet.storage.true_frames import APPENDED, open_truth
from studies.recording_files import EXPOSURE_US, WHITE, mosaicked, write_aedat2, write_e2p
from studies.study import command_line, measure_sections

MOSAIC_TEXT = "90 45 / 135 0"
POLARIZERS_DEG, TRUE_DOLP = (0, 30, 90), 0.8
SQUARE = 64  # pixels of the photograph, of which every other square lies behind the polarizer
WARM_UP = 5  # windows, as in the benchmark


def write_aedat4(path: Path, events: Events, t_us: Int64[np.ndarray, " n"], frames: UInt8[np.ndarray, "n h w"]) -> None:
    """As DV writes it, by its own library."""
    size = events.width, events.height
    config = dv_processing.io.MonoCameraWriter.Config("DAVIS346")
    config.addEventStream(size)
    config.addFrameStream(size)
    writer = dv_processing.io.MonoCameraWriter(str(path), config)
    store = dv_processing.EventStore()
    for t, x, y, p in zip(*(column.tolist() for column in (events.t, events.x, events.y, events.p)), strict=True):
        store.push_back(t, x, y, p > 0)
    writer.writeEvents(store)
    for middle, raw in zip(t_us.tolist(), frames, strict=True):
        frame = dv_processing.Frame(middle - EXPOSURE_US // 2, raw)
        frame.exposure = timedelta(microseconds=EXPOSURE_US)
        writer.writeFrame(frame)


def simulate(folder: Path, polarizer_deg: int) -> Path:
    """Events and frames behind a polarizer, by `polarnet simulate` from its four measured intensities."""
    grey = read_rgb(next(one.path for one in BUILTIN_PHOTOS if one.path.stem == "astronaut")).mean(0)
    row, column = (torch.arange(side) // SQUARE % 2 for side in grey.shape)
    polarized = (row[:, None] == column) * TRUE_DOLP
    pictures = folder / f"polarizer_{polarizer_deg}"
    pictures.mkdir(parents=True, exist_ok=True)
    for angle in POLARIZER_ANGLES_DEG:
        light = grey * (1 + polarized * math.cos(2 * math.radians(angle - polarizer_deg))) / (1 + TRUE_DOLP)
        write_png(
            pictures / f"astronaut_{angle}.png", np.repeat(light.numpy()[..., None], 3, axis=2).astype(np.float32), 16
        )
    made = folder / f"simulated_{polarizer_deg}"
    size = ["synthesize.sensor_height=130", "synthesize.sensor_width=173", "synthesize.duration_s=2"]
    if polarnet(["simulate", str(pictures), "--out", str(made), "--no-preview", *size]):
        raise SystemExit("polarnet simulate failed")
    return made


def write_recordings(made: Path, folder: Path, polarizer_deg: int) -> list[Path]:
    """The simulated events and frames in the three formats; time starts at the half of an exposure."""
    store = EventStore.open(made / "events.zarr")
    events = join_mosaic(store.read(store.sequences[0]), MOSAIC)
    truth = open_truth(made / APPENDED, store.sequences[0])
    inside = np.flatnonzero(truth.t_us >= EXPOSURE_US)
    frames = [truth[int(k)] for k in inside]
    intensity = intensities_from_stokes(torch.stack([stokes_from_polarization(f.s0, f.dolp, f.aolp) for f in frames]))
    levels = np.rint(WHITE * mosaicked(2 * intensity.numpy()).clip(0, 1)).astype(np.uint8)
    t_us, name = truth.t_us[inside], folder / f"pdavis_{polarizer_deg:03d}"
    write_aedat2(name.with_suffix(".aedat"), events, t_us, levels)
    write_aedat4(name.with_suffix(".aedat4"), events, t_us, levels)
    write_e2p(name.with_suffix(".h5"), events, t_us, levels, None)
    return [name.with_suffix(suffix) for suffix in (".aedat", ".aedat4", ".h5")]


def error_deg(aolp: torch.Tensor, dolp: torch.Tensor, polarizer_deg: int) -> float:
    """Difference in degrees between the polarizer and the mean of AoLP, weighted with DoLP, as an angle of [0, pi)."""
    doubled = torch.polar(dolp.double(), 2 * (aolp.double() - math.radians(polarizer_deg))).mean()
    return abs(math.degrees(float(doubled.angle())) / 2)


def score(recording: Path, polarizer_deg: int) -> dict[str, Any]:
    """Errors of the AoLP that `polarnet recover` and the recording's own frames give."""
    out = recording.with_suffix("")
    if polarnet(["recover", str(recording), "--mosaic", MOSAIC_TEXT, "--out", str(out), "--write", "zarr"]):
        raise SystemExit(f"polarnet recover {recording} failed")
    group = zarr.open_group(out / "recovered.zarr", mode="r")
    aolp, dolp = (torch.from_numpy(np.asarray(group[name]).astype(np.float64)) for name in ("aolp", "dolp"))
    aolp *= math.pi / 2**16
    scored = zip(aolp[WARM_UP:], dolp[WARM_UP:], strict=True)  # frames that the benchmark would score
    truth = read_truth(recording, MOSAIC)
    return {
        "polarizer_deg": polarizer_deg,
        "format": recording.suffix.removeprefix("."),
        "aolp_error_deg": error_deg(aolp, dolp, polarizer_deg),
        "frame_aolp_error_deg_max": max(error_deg(*frame, polarizer_deg) for frame in scored),
        "frames_aolp_error_deg": error_deg(truth.aolp[truth.valid], truth.dolp[truth.valid], polarizer_deg),
    }


def measure(given: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """Errors of each file."""
    given.folder.mkdir(parents=True, exist_ok=True)
    angles = [(write_recordings(simulate(given.folder, deg), given.folder, deg), deg) for deg in POLARIZERS_DEG]
    return {"files": [score(recording, deg) for recordings, deg in angles for recording in recordings]}, {}


if __name__ == "__main__":
    parser = command_line(__doc__, "docs/results/recordings.json")
    parser.add_argument("folder", type=Path, help="folder for the files")
    measure_sections(parser, {"pdavis": ("recordings", "pdavis", measure)})
