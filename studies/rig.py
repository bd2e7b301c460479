"""Accuracy of the calibration of a simulated rig: python -m studies.rig [--write] [--targets N] [--full]

Each target is another picture: photographs of scikit-image and dead leaves. Its eight captures are written as CeleX-5
files with random delays, sensor noise and hot pixels, and then imported and calibrated as in the stages. The study
prints errors of the start times from the landmark (in camera frames) and refined (in ms). The refined errors exclude
the part common to all eight captures, because the zero of their clock is a convention; `clock_zero_ms_max` is that
part. It also prints the RMS difference between the DoLP and the scene's own.

The sensor is a quarter of a CeleX-5 in each direction (200 x 320 pixels, images of 30 x 45); with --full it is a whole
one. `--write` puts the figures into docs/results/recordings.json, what `polarnet inspect` says of a capture into
docs/results/inspection.json, and draws the pictures of docs/recordings.md and docs/recordings-dot.md.
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
from polarnet.captures.targets import Calibrated, calibrate_targets, import_targets
from polarnet.config.tree import load
from polarnet.events.stream import Events, slice_time
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
FULL_RIG = replace(RIG, speed_px_s=240.0, picture_rate_hz=100.0)
CUTOFF_HZ = 3000.0  # of the photoreceptor; a low one adds a delay


def scene_of(k: int) -> PolarizationScene:
    """The picture of target `k`, its value in 0.1 to 0.95: a black pixel has no DoLP that could be measured."""
    if k % 2 == 0 and k // 2 < len(PHOTOGRAPHS):
        rgb = torch.from_numpy(PHOTOGRAPHS[k // 2]()).float() / 255
    else:
        rgb = torch.from_numpy(dead_leaves(generator_for(1, str(k), "picture"), 400, 600))
    return scene_from_rgb(0.1 + 0.85 * rgb.permute(2, 0, 1))


def measured(
    folder: Path, count: int, rig: RigConfig, recordings: RecordingsConfig, emulator: EmulatorConfig
) -> Iterator[dict[str, float]]:
    """Errors of each target; one at a time on disk."""
    for k in range(count):
        name = f"target-{k:02d}"
        raw, imported, out = folder / "raw", folder / "imported", folder / name
        truth = write_rig(raw / name, scene_of(k), rig, recordings, emulator, seed=1, threads=2)
        import_targets(raw, imported, recordings)
        (found,) = calibrate_targets(imported, out, recordings, {})
        yield errors_of(name, truth, found, rig, recordings, out)
        for left in (raw, imported, out):
            shutil.rmtree(left)


def errors_of(
    name: str, truth: RigTruth, found: Calibrated, rig: RigConfig, recordings: RecordingsConfig, out: Path
) -> dict[str, float]:
    """Errors of a target's start times, and the squared error of its DoLP."""
    landmark_us = max(abs(found.landmark_us[capture] - start) for capture, start in truth.start_us.items())
    zero_us = float(np.mean([found.start_us[capture] - start for capture, start in truth.start_us.items()]))
    frames = FrameStore.open(out / "frames.zarr")
    expected = true_dolp(truth, frames.t_us(name).numpy() + round(zero_us), recordings)
    errors = {
        "start_frames": landmark_us * 1e-6 * rig.picture_rate_hz,
        "refined_ms": float(np.abs(spread_us(found.start_us, truth.start_us)).max()) / 1000,
        "zero_ms": abs(zero_us) / 1000,
        "squared_dolp": float((frames.dolp(name) - expected).pow(2).mean()),
    }
    print(name, {key: round(value, 4) for key, value in errors.items()}, flush=True)
    return errors


def draw_documentation(scratch: Path, recordings: RecordingsConfig, emulator: EmulatorConfig) -> None:
    """The pictures of the pages on recordings, and what `polarnet inspect` says, of one target."""
    name = "coffee"
    truth = write_rig(scratch / "raw" / name, scene_of(0), RIG, recordings, emulator, seed=1, threads=2)
    import_targets(scratch / "raw", scratch / "imported", recordings)
    (found,) = calibrate_targets(scratch / "imported", scratch / "calibrated", recordings, {})
    draw_calibration(found, recordings, PICTURES / "recordings_calibration.png")
    first = EVENT_CAPTURES[0]
    events = read_event_capture(scratch / "raw" / name / f"{first}.bin", recordings)
    capture = scratch / "events_0.h5"
    write_hdf5(capture, since_landmark(events, first, found), found.duration_us)
    assert recordings.hot_pixel_factor is not None
    inspection = inspect_recording(open_recording(capture), recordings.hot_pixel_factor)
    (PICTURES / "recordings_inspect.png").write_bytes(recording_picture(inspection))
    draw_hot_pixels(inspection.counts, inspection.hot, PICTURES / "recordings_hot_pixels.png")
    assert int(inspection.hot.sum()) == len(truth.hot)
    lines = [f"$ polarnet inspect {capture.name}", *findings(inspection), f"picture     {capture.name}.png"]
    (ROOT / "docs" / "results" / "inspection.json").write_text(json.dumps({"text": "\n".join(lines)}, indent=2) + "\n")
    for path in PICTURES.glob("recordings_*.png"):
        path.write_bytes(few_colours(path.read_bytes()))


def since_landmark(events: Events, capture: str, found: Calibrated) -> Events:
    """The events of a capture by the common clock, as long as all captures last."""
    start_us = found.start_us[capture]
    return shifted(slice_time(events, start_us, start_us + found.duration_us), start_us)


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/recordings.json, inspection.json and the pictures")
    parser.add_argument("--targets", type=int, default=8, help="number of targets, with eight captures each")
    parser.add_argument("--full", action="store_true", help="the whole sensor")
    arguments = arguments_of(parser)
    record, config = machine_record(), load(ROOT)
    quarter = replace(config.recordings, enabled=True, **QUARTER)
    recordings = replace(config.recordings, enabled=True) if arguments.full else quarter
    emulator = replace(config.emulate, model="exact", cutoff_hz=CUTOFF_HZ)
    with tempfile.TemporaryDirectory() as scratch:
        rig = FULL_RIG if arguments.full else RIG
        errors = list(measured(Path(scratch), arguments.targets, rig, recordings, emulator))
        if arguments.write:
            draw_documentation(Path(scratch), quarter, emulator)
    squared = [one["squared_dolp"] for one in errors]
    figures = {
        "captures": 8 * len(errors),
        "sensor": list(recordings.sensor),
        "start_error_frames_max": round(max(one["start_frames"] for one in errors), 3),
        "refined_error_ms_max": round(max(one["refined_ms"] for one in errors), 3),
        "clock_zero_ms_max": round(max(one["zero_ms"] for one in errors), 3),
        "dolp_rms": round(float(np.mean(squared)) ** 0.5, 5),
        "dolp_rms_max": round(max(squared) ** 0.5, 5),
    }
    print(json.dumps(figures, indent=2))
    if arguments.write:
        write_section("recordings", "rig_full" if arguments.full else "rig", figures, record)


if __name__ == "__main__":
    main()
