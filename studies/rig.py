"""Accuracy of the calibration of a simulated rig: python -m studies.rig [--write] [--targets N]

Each target is another picture. Its eight captures are written as CeleX-5 files with random delays, sensor noise and hot
pixels, then calibrated as in the stage. The study prints errors of the start times from the landmark (in
camera frames) and refined (in ms, without the part common to all captures: the zero of their clock is a convention),
and the RMS difference between the DoLP and the scene's own. `--write` puts them into docs/results/recordings.json, what
`polarnet inspect` says of a capture into docs/results/inspection.json, and draws the pictures of the recordings' pages.
"""

import json
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skimage import data

from polarnet.captures.dot import EVENT_CAPTURES, RecordingsConfig, read_event_capture
from polarnet.captures.targets import Calibrated, calibrate_targets
from polarnet.config.tree import load
from polarnet.events.stream import slice_time
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.recordings.arrangements import shifted
from polarnet.recordings.inspection import findings, inspect_recording
from polarnet.recordings.recording import open_recording
from polarnet.recordings.writers import write_hdf5
from polarnet.reports.recordings import draw_calibration, draw_hot_pixels, recording_picture
from polarnet.runtime.machine import generator_for
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.scene import PolarizationScene, scene_from_rgb
from polarnet.storage.frames import FrameStore
from studies.simulated_rig import RigConfig, RigTruth, spread_us, true_dolp, write_rig
from studies.simulation_pictures import few_colours
from studies.study import PICTURES, ROOT, arguments_of, command_line, machine_record, write_section

PHOTOGRAPHS = (data.coffee, data.chelsea, data.astronaut, data.rocket)
QUARTER: dict[str, Any] = {"sensor": [200, 320], "region": [45, 2], "crop": [120, 180], "size": [30, 45]}
RIG = RigConfig(
    speed_px_s=100.0,
    longest_delay_s=0.35,
    duration_s=0.55,
    picture_rate_hz=60.0,
    full_well_electrons=20000.0,
    read_noise=2.0,
    hot_pixels=5,
    file_type="bin",
)
CUTOFF_HZ = 3000.0  # of the photoreceptor; a low one adds a delay


def scene_of(k: int) -> PolarizationScene:
    """The picture of target `k`, its value in 0.1 to 0.95: a black pixel has no DoLP that could be measured."""
    if k % 2 == 0 and k // 2 < len(PHOTOGRAPHS):
        rgb = torch.from_numpy(PHOTOGRAPHS[k // 2]()).float() / 255
    else:
        rgb = torch.from_numpy(dead_leaves(generator_for(1, str(k), "picture"), 400, 600))
    return scene_from_rgb(0.1 + 0.85 * rgb.permute(2, 0, 1))


def measured(
    folder: Path, count: int, recordings: RecordingsConfig, emulator: EmulatorConfig
) -> Iterator[dict[str, float]]:
    """Errors of each target; one at a time on disk."""
    for k in range(count):
        name = f"target-{k:02d}"
        raw, out = folder / "raw", folder / name
        truth = write_rig(raw / name, scene_of(k), RIG, recordings, emulator, seed=1, threads=2)
        (found,) = calibrate_targets(raw, out, recordings, {})
        yield errors_of(name, truth, found, recordings, out)
        for left in (raw, out):
            shutil.rmtree(left)


def errors_of(
    name: str, truth: RigTruth, found: Calibrated, recordings: RecordingsConfig, out: Path
) -> dict[str, float]:
    """Errors of a target's start times, and the squared error of its DoLP."""
    landmark_us = max(abs(found.landmark_us[capture] - start) for capture, start in truth.start_us.items())
    zero_us = float(np.mean([found.start_us[capture] - start for capture, start in truth.start_us.items()]))
    frames = FrameStore.open(out / "frames.zarr")
    expected = true_dolp(truth, frames.t_us(name).numpy() + round(zero_us), recordings)
    errors = {
        "start_frames": landmark_us * 1e-6 * RIG.picture_rate_hz,
        "refined_ms": float(np.abs(spread_us(found.start_us, truth.start_us)).max()) / 1000,
        "squared_dolp": float((frames.quantity("dolp", name) - expected).pow(2).mean()),
    }
    print(name, {key: round(value, 4) for key, value in errors.items()}, flush=True)
    return errors


def draw_documentation(scratch: Path, recordings: RecordingsConfig, emulator: EmulatorConfig) -> None:
    """The pictures of the pages on recordings, and what `polarnet inspect` says, of one target."""
    name = "coffee"
    truth = write_rig(scratch / "raw" / name, scene_of(0), RIG, recordings, emulator, seed=1, threads=2)
    (found,) = calibrate_targets(scratch / "raw", scratch / "calibrated", recordings, {})
    draw_calibration(found, recordings, PICTURES / "recordings_calibration.png")
    first = EVENT_CAPTURES[0]
    events = read_event_capture(scratch / "raw" / name / f"{first}.bin", recordings)
    capture = scratch / "events_0.h5"
    start_us = found.start_us[first]
    common = shifted(slice_time(events, start_us, start_us + found.duration_us), start_us)
    write_hdf5(capture, common, found.duration_us)
    assert recordings.hot_pixel_factor is not None
    inspection = inspect_recording(open_recording(capture), recordings.hot_pixel_factor)
    (PICTURES / "recordings_inspect.png").write_bytes(recording_picture(inspection))
    draw_hot_pixels(inspection.counts, inspection.hot, PICTURES / "recordings_hot_pixels.png")
    assert int(inspection.hot.sum()) == len(truth.hot)
    lines = [f"$ polarnet inspect {capture.name}", *findings(inspection), f"picture     {capture.name}.png"]
    (ROOT / "docs" / "results" / "inspection.json").write_text(json.dumps({"text": "\n".join(lines)}, indent=2) + "\n")
    for path in PICTURES.glob("recordings_*.png"):
        path.write_bytes(few_colours(path.read_bytes()))


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/recordings.json, inspection.json and the pictures")
    parser.add_argument("--targets", type=int, default=8, help="number of targets, with eight captures each")
    arguments = arguments_of(parser)
    record, config = machine_record(), load(ROOT)
    recordings = replace(config.recordings, enabled=True, **QUARTER)
    emulator = replace(config.emulate, model="exact", cutoff_hz=CUTOFF_HZ)
    with tempfile.TemporaryDirectory() as scratch:
        errors = list(measured(Path(scratch), arguments.targets, recordings, emulator))
        if arguments.write:
            draw_documentation(Path(scratch), recordings, emulator)
    squared = [one["squared_dolp"] for one in errors]
    figures = {
        "captures": 8 * len(errors),
        "start_error_frames_max": round(max(one["start_frames"] for one in errors), 3),
        "refined_error_ms_max": round(max(one["refined_ms"] for one in errors), 3),
        "dolp_rms": round(float(np.mean(squared)) ** 0.5, 5),
    }
    print(json.dumps(figures, indent=2))
    if arguments.write:
        write_section("recordings", "rig", figures, record)


if __name__ == "__main__":
    main()
