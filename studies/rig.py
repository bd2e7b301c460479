"""Pictures of the pages on recordings, and what `polarnet inspect` says, from a simulated rig: python -m studies.rig

The eight captures of a photograph are written as CeleX-5 files with random delays, sensor noise and hot pixels, then
calibrated as in the stage.
"""

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from skimage import data

from polarnet.captures.dot import EVENT_CAPTURES, read_event_capture
from polarnet.captures.targets import calibrate_targets
from polarnet.config.tree import load
from polarnet.events.stream import shifted, slice_time
from polarnet.recordings.inspection import findings, inspect_recording
from polarnet.recordings.recording import open_recording
from polarnet.recordings.writers import write_hdf5
from polarnet.reports.recordings import draw_calibration, recording_picture
from polarnet.simulation.scene import scene_from_rgb
from studies.pictures import few_colours
from studies.simulated_rig import RigConfig, write_rig
from studies.study import PICTURES, ROOT

RIG = RigConfig(
    speed_px_s=100.0,
    longest_delay_s=0.35,
    duration_s=0.55,
    picture_rate_hz=60.0,
    full_well_electrons=20000.0,
    read_noise=2.0,
    hot_pixels=5,
)
CUTOFF_HZ = 3000.0  # of the photoreceptor; a low one adds a delay


def main() -> None:
    """Draw the pictures into docs, and write docs/results/inspection.json."""
    config, name = load(ROOT), "coffee"
    recordings = replace(
        config.recordings, enabled=True, sensor=[200, 320], region=[45, 2], crop=[120, 180], size=[30, 45]
    )
    emulator = replace(config.emulate, model="exact", cutoff_hz=CUTOFF_HZ)
    rgb = torch.from_numpy(data.coffee()).permute(2, 0, 1) / 255
    scene = scene_from_rgb(0.1 + 0.85 * rgb)  # a black pixel has no DoLP that could be measured
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        write_rig(scratch / "raw" / name, scene, RIG, recordings, emulator, seed=1, threads=2)
        (found,) = calibrate_targets([scratch / "raw" / name], scratch / "calibrated", recordings, {})
        draw_calibration(found, recordings, PICTURES / "recordings_calibration.png")
        first = EVENT_CAPTURES[0]
        events = read_event_capture(scratch / "raw" / name / f"{first}.bin", recordings)
        start_us, capture = found.start_us[first], scratch / "events_0.h5"
        common = shifted(slice_time(events, start_us, start_us + found.duration_us), start_us)
        write_hdf5(capture, common)
        inspection = inspect_recording(open_recording(capture))
    (PICTURES / "recordings_inspect.png").write_bytes(recording_picture(inspection))
    lines = [f"$ polarnet inspect {capture.name}", *findings(inspection), f"picture     {capture.name}.png"]
    (ROOT / "docs" / "results" / "inspection.json").write_text(json.dumps({"text": "\n".join(lines)}, indent=2) + "\n")
    for path in PICTURES.glob("recordings_*.png"):
        path.write_bytes(few_colours(path.read_bytes()))


if __name__ == "__main__":
    main()
