"""Accuracy of the calibration of a simulated rig: python -m studies.rig [--write] [--targets N] [--full]

Each target is another picture: photographs of scikit-image and dead leaves. Its eight captures are written as CeleX-5
files with random delays, sensor noise and hot pixels, and then imported and calibrated as in the stages. The study
prints errors of the start times from the landmark (in camera frames) and refined (in ms). The refined errors exclude
the part common to all eight captures, because the zero of their clock is a convention; `clock_zero_ms_max` is that
part. It also prints the RMS difference between the DoLP and the scene's own, the thresholds, and the benchmark's
table, with the networks that `--data` has in train.

The sensor is a quarter of a CeleX-5 in each direction (200 x 320 pixels, images of 30 x 45); with --full it is a whole
one (800 x 1280, images of 120 x 180). `--write` merges the figures into docs/results/recordings.json as section `rig`
or `rig_full`. `--docs` draws the pictures of docs/recordings.md and docs/recordings-dot.md instead.
"""

import json
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skimage import data

from polarnet.benchmark.rows import available
from polarnet.benchmark.run import run_benchmark
from polarnet.benchmark.score import FrameScore, summary
from polarnet.captures.dot import EVENT_CAPTURES, RecordingsConfig, read_event_capture
from polarnet.captures.imported import import_targets
from polarnet.captures.targets import Calibrated, calibrate_targets
from polarnet.config.pipeline import RECORDINGS, context_of, made_set, rows_of_set
from polarnet.config.tree import Config, load
from polarnet.events.stream import Events, slice_time
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.recordings.arrangements import shifted
from polarnet.recordings.inspection import findings, inspect_recording
from polarnet.recordings.recording import open_recording
from polarnet.reports.recordings import draw_calibration, draw_hot_pixels, recording_picture
from polarnet.reports.tables import as_plain, score_table
from polarnet.runtime.machine import generator_for
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.scene import PolarizationScene, scene_from_rgb
from polarnet.storage.exchange import write_hdf5
from polarnet.storage.frames import FrameStore
from studies.measure import BENCHMARK_KEYS, arguments_of, command_line, machine_record, write_section
from studies.simulated_rig import RigConfig, RigTruth, spread_us, true_dolp, write_rig
from studies.simulation_pictures import few_colours

ROOT = Path(__file__).resolve().parents[1]
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


def scene_of(k: int) -> PolarizationScene:
    """The picture of target `k`, its value in 0.1 to 0.95: a black pixel has no DoLP that could be measured."""
    if k % 2 == 0 and k // 2 < len(PHOTOGRAPHS):
        rgb = torch.from_numpy(PHOTOGRAPHS[k // 2]()).float() / 255
    else:
        rgb = torch.from_numpy(dead_leaves(generator_for(1, str(k), "picture"), 400, 600))
    return scene_from_rgb(0.1 + 0.85 * rgb.permute(2, 0, 1))


def measured(
    folder: Path, count: int, rig: RigConfig, recordings: RecordingsConfig, emulator: EmulatorConfig, pictures: Path
) -> Iterator[tuple[RigTruth, Calibrated, float]]:
    """Truth, calibration and squared DoLP error of each target; one at a time on disk, stores of all in `folder`."""
    for k in range(count):
        name = f"target-{k:02d}"
        raw, imported, out = folder / "raw", folder / "imported", folder / name
        truth = write_rig(raw / name, scene_of(k), rig, recordings, emulator, seed=1, threads=2)
        start = time.perf_counter()
        import_targets(raw, imported, recordings)
        (found,) = calibrate_targets(imported, out, recordings, {})
        seconds = time.perf_counter() - start
        draw_calibration(found, recordings, pictures / f"{name}.png")
        frames = FrameStore.open(out / "frames.zarr")
        expected = true_dolp(truth, frames.t_us(name).numpy() + round(clock_zero_us(truth, found)), recordings)
        squared = float((frames.dolp(name) - expected).pow(2).mean())
        for left in (raw, imported):
            shutil.rmtree(left)
        report(name, truth, found, rig, squared, seconds)
        yield truth, found, squared


def report(name: str, truth: RigTruth, found: Calibrated, rig: RigConfig, squared: float, seconds: float) -> None:
    """A line of figures."""
    assert found.alignment is not None
    refined_ms = np.abs(spread_us(found.start_us, truth.start_us)).max() / 1000
    thresholds = [f"{lag.thresholds.on:.3f}/{lag.thresholds.off:.3f}" for lag in found.alignment.lags]
    print(
        f"{name}: landmark {landmark_frames(truth, found, rig):.2f} pictures, refined {refined_ms:.2f} ms, "
        f"DoLP {squared**0.5:.4f}, thresholds {' '.join(thresholds)}, hot {list(found.hot.values())}, "
        f"imported and calibrated in {seconds:.1f} s",
        flush=True,
    )


def landmark_frames(truth: RigTruth, found: Calibrated, rig: RigConfig) -> float:
    """The largest error of the landmark's start times, in pictures."""
    errors = [abs(found.landmark_us[capture] - start) for capture, start in truth.start_us.items()]
    return max(errors) * 1e-6 * rig.picture_rate_hz


def clock_zero_us(truth: RigTruth, found: Calibrated) -> float:
    """How much later the captures' common clock begins than the landmark."""
    return float(np.mean([found.start_us[capture] - start for capture, start in truth.start_us.items()]))


def benchmarked(folder: Path, names: list[str], config: Config) -> dict[str, dict[str, Any]]:
    """The benchmark's scores over all targets, each in a store of its own, printed as a table."""
    context = context_of(config, train_mean=None)
    methods, absent = available(rows_of_set(RECORDINGS, config.benchmark.methods), context)
    benchmark = replace(config.benchmark, methods=methods, panel_scenes=0)
    rows: list[FrameScore] = []
    costs: dict[str, dict[str, Any]] = {}
    for name in names:
        one = run_benchmark(made_set(name, folder / name), context, benchmark, None)
        rows += one.rows
        costs = {method: asdict(cost) for method, cost in one.costs.items()}
    scores = {m: {**s, **costs[m]} for m, s in summary(rows, benchmark.bootstrap_samples, config.seed).items()}
    print(as_plain(score_table(scores)))
    for method, reason in absent.items():
        print(f"{method} is left out: {reason}")
    return {method: {key: scores[method].get(key) for key in BENCHMARK_KEYS} for method in scores}


def draw_documentation(
    scratch: Path, rig: RigConfig, recordings: RecordingsConfig, emulator: EmulatorConfig
) -> list[Path]:
    """The pictures of the pages on recordings and what `polarnet inspect` says, of one target; where they are."""
    name, pictures = "coffee", ROOT / "docs" / "pictures"
    truth = write_rig(scratch / "raw" / name, scene_of(0), rig, recordings, emulator, seed=1, threads=2)
    import_targets(scratch / "raw", scratch / "imported", recordings)
    (found,) = calibrate_targets(scratch / "imported", scratch / "calibrated", recordings, {})
    draw_calibration(found, recordings, pictures / "recordings_calibration.png")

    first = EVENT_CAPTURES[0]
    events = read_event_capture(scratch / "raw" / name / f"{first}.bin", recordings)
    capture = scratch / "events_0.h5"
    write_hdf5(capture, since_landmark(events, first, found), found.duration_us)
    assert recordings.hot_pixel_factor is not None
    inspection = inspect_recording(open_recording(capture), recordings.hot_pixel_factor)
    (pictures / "recordings_inspect.png").write_bytes(recording_picture(inspection))
    draw_hot_pixels(inspection.counts, inspection.hot, pictures / "recordings_hot_pixels.png")
    assert int(inspection.hot.sum()) == len(truth.hot)
    lines = [f"$ polarnet inspect {capture.name}", *findings(inspection), f"picture     {capture.name}.png"]
    (ROOT / "docs" / "results" / "inspection.json").write_text(json.dumps({"lines": lines}, indent=2) + "\n")

    drawn = sorted(pictures.glob("recordings_*.png"))
    for path in drawn:
        path.write_bytes(few_colours(path.read_bytes()))
    return drawn


def since_landmark(events: Events, capture: str, found: Calibrated) -> Events:
    """The events of a capture by the common clock, as long as all captures last."""
    start_us = found.start_us[capture]
    return shifted(slice_time(events, start_us, start_us + found.duration_us), start_us)


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/recordings.json")
    parser.add_argument("--targets", type=int, default=8, help="number of targets, with eight captures each")
    parser.add_argument("--full", action="store_true", help="the whole sensor")
    parser.add_argument(
        "--cutoff-hz", type=float, default=3000.0, help="cutoff of the photoreceptor; a low one adds a delay"
    )
    parser.add_argument("--data", type=Path, default=ROOT / "data", help="data folder with trained networks")
    parser.add_argument(
        "--pictures", type=Path, default=ROOT / "outputs" / "rig", help="folder for diagnostic pictures"
    )
    parser.add_argument("--docs", action="store_true", help="only draw the pictures of the pages on recordings")
    arguments = arguments_of(parser)
    config = load(ROOT, [f"paths.data={arguments.data.absolute()}"])
    recordings = replace(config.recordings, enabled=True, **({} if arguments.full else QUARTER))
    rig = FULL_RIG if arguments.full else RIG
    emulator = replace(config.emulate, model="exact", cutoff_hz=arguments.cutoff_hz)
    if arguments.docs:
        with tempfile.TemporaryDirectory() as scratch:
            for path in draw_documentation(Path(scratch), rig, recordings, emulator):
                print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1024:.0f} kB")
        return
    arguments.pictures.mkdir(parents=True, exist_ok=True)
    record: dict[str, Any] = machine_record(ROOT)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        results = list(measured(folder, arguments.targets, rig, recordings, emulator, arguments.pictures))
        scores = benchmarked(folder, [one.name for _, one, _ in results], config)
    figures = {
        "captures": 8 * len(results),
        "sensor": list(recordings.sensor),
        "photoreceptor_cutoff_hz": arguments.cutoff_hz,
        "start_error_frames_max": round(max(landmark_frames(truth, one, rig) for truth, one, _ in results), 3),
        "refined_error_ms_max": round(
            max(float(np.abs(spread_us(one.start_us, truth.start_us)).max()) for truth, one, _ in results) / 1000, 3
        ),
        "clock_zero_ms_max": round(max(abs(clock_zero_us(truth, one)) for truth, one, _ in results) / 1000, 3),
        "dolp_rms": round(float(np.mean([squared for _, _, squared in results])) ** 0.5, 5),
        "dolp_rms_max": round(max(squared for _, _, squared in results) ** 0.5, 5),
        "benchmark": scores,
    }
    print(json.dumps(figures, indent=2))
    if arguments.write:
        path = write_section(ROOT, "recordings", "rig_full" if arguments.full else "rig", figures, record)
        print(f"written to {path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
