"""data/recordings -> data/calibrated: real targets on one clock, in the same stores as simulated sequences."""

import dataclasses
from pathlib import Path

from polarnet.captures.targets import calibrate_targets, start_over
from polarnet.config.tree import Config, hydra_stage, input_folder
from polarnet.reports.recordings import draw_calibration, draw_sequence
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore


@hydra_stage
def main(config: Config) -> None:
    """Find the start times, write both stores, and draw the start times' evidence and the paper's Fig. 8."""
    out = Path(config.paths.calibrated)
    if not config.recordings.enabled:
        start_over(out, enabled=False)
        print("recordings.enabled is false")
        return
    about = {"recordings": dataclasses.asdict(config.recordings)}
    root = input_folder("recordings.root", config.recordings.root)
    folders = sorted(path for path in root.iterdir() if path.is_dir())
    if not folders:
        raise SystemExit(f"{root}: expected a folder for each target with its eight captures, there is none")
    targets = calibrate_targets(folders, out, config.recordings, about)
    events, frames = EventStore.open(out / "events.zarr"), FrameStore.open(out / "frames.zarr")
    for target in targets:
        draw_calibration(target, config.recordings, out / f"{target.name}.png")
        draw_sequence(events.read(target.name), frames.frames(target.name), out / f"{target.name}_figure_8")
        print(f"{target.name}: {target.duration_us * 1e-6:.2f} s, hot pixels {sum(target.hot.values())}")


if __name__ == "__main__":
    main()
