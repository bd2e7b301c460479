"""Methods on photographs, on measured scenes and on other sensors, in one table.

python -m studies.robustness --photographs FOLDER [--photographs-large FOLDER] --measured FOLDER ... --work FOLDER
    [--weights [NAME=]FILE ...] [--split test|val] [--conditions NAME ...] [--limit N] [--set KEY=VALUE ...] [--write]
python -m studies.robustness --photographs FOLDER [--photographs-large FOLDER] --work FOLDER --training FOLDER

- `photographs`: a split (`experiment=photographs`) of --photographs; `photographs_large`: of both folders together.
- `measured.SOURCE`: all measured scenes of a folder, or of one repo in its manifest.csv (columns file, repo).
- `sensors.NAME`: the scenes of `photographs` under each entry of SENSORS; `time.5ms`: with windows of 5 ms.
- `layers.two`, `layers.turning`: the same photographs where they do not move as one plane (`studies.layers`), scored
  with --layers alone.

`ours, 2x2 blocks` is the network on blocks of pixels, `ours, thresholds given` with the sensor's contrast thresholds.
--whole-file has `registered` in their place, the network over the whole recording; --layers too. --frames has it, and
for each entry of FRAMES_HZ the same with frames of the camera (`recover --frames`) and the frame nearest in time, held:
frames of 10 bits, exposed for 10 ms, with shot noise and the read noise of a DAVIS346. The complementary filter has
them too. `train_mean` is the mean DoLP of the training photographs, `constant_real` that of the measured scenes of all
other sources. --split val is for choices, --split test for figures. --limit takes the first N pictures of each set,
--sensor-limit of the sensors alone. Pictures are kept in --work. The second command fills --training with links to the
training photographs of both folders: a network trained on them (`ingest.root`) has seen none of --split val and test.
"""

import argparse
import functools
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from polarnet.benchmark.rows import Context, available, predictions_of
from polarnet.benchmark.score import FrameScore, scene_means, score_sequence, scored_windows
from polarnet.benchmark.sequences import TestSequence
from polarnet.config.pipeline import context_of
from polarnet.config.tree import Config
from polarnet.events.stream import Events, slice_time
from polarnet.methods import METHODS
from polarnet.methods.complementary_filter import FilterState, at_rest, integrate
from polarnet.methods.intensities import from_intensities
from polarnet.methods.method import Recoverer, State
from polarnet.metrics.reliability import Reliability, reliability
from polarnet.networks.weights import shipped_weights
from polarnet.runtime.files import sha256
from polarnet.runtime.machine import configure, generator_for
from polarnet.simulation.camera import grid
from polarnet.simulation.motion import frame_times_us
from polarnet.simulation.moving_sensor import emulate_motion
from polarnet.simulation.sets import motion_over
from polarnet.simulation.truth import frames_of, valid_frames
from polarnet.stokes import Prediction, StokesFrames, intensities_from_stokes, stokes_from_intensities
from polarnet.storage.scenes import SceneStore
from studies import layers
from studies.scored_pictures import ingested, link_training, mean_dolp, part_of, scenes_of, settings, sources_of
from studies.study import arguments_of, command_line, machine_record, write_section

OURS, WHOLE = "ours", "registered"
PAST, WHOLE_FILE, FRAMES, LAYERS = "", "whole_file", "frames", "layers"
MODES = {
    WHOLE_FILE: "the row `registered` beside `ours`",
    FRAMES: "the same, and with frames; needs measured scenes",
    LAYERS: "the conditions layers.*, and no others",
}
"""Modes, after which sections are named; in `PAST` the network sees events so far alone."""
CALIBRATED, BLOCKS = "ours, thresholds given", "ours, 2x2 blocks"
CONSTANT = "constant_real"
ROWS = ("zeros", "train_mean", "oracle_mean", "highpass+gain", "firenet_published+gain")
NO_TRUTH = ("zeros", "train_mean", CONSTANT, "highpass+gain", "firenet_published+gain")
"""Rows that need no truth, against which ours is compared on measured scenes."""
BESIDE = ("psnr", "corr", "offset", "no_offset_mse")
"""Scores in the tables beside the MSE; `polarnet.metrics.offset` defines the last two."""
FRAMES_HZ = (1, 5, 20)  # of the camera
BETWEEN_HZ, BETWEEN_FRAMES_HZ = 2000, 5  # rate of frames between windows (`recover --step`), and of the camera's
WITH_FRAMES = f"{WHOLE}, {BETWEEN_FRAMES_HZ} frames/s"
AT_RATE = f"{WITH_FRAMES}, at {BETWEEN_HZ} Hz"
BETWEEN_US = 12_500  # time between those that are scored, every 25th
EXPOSURE_US, EXPOSED = 10_000, 5  # length of a frame's exposure, and times in it at which light is rendered
FULL_WELL, READ_NOISE, DIGITS = 20_000, 10 ** (-55 / 20), 1023  # electrons; of white (55 dB); 10 bits
FILTER_HZ = 5.0  # cutoff of that filter, chosen by --frames --split val at 5 frames a second
SMALLEST_SHARE = 0.01  # of light behind a polarizer, of all
FRAME_RATE_HZ = 30.0  # of the windows that `benchmark.warmup_windows` counts
SENSORS: dict[str, tuple[str, ...]] = {
    "default": (),
    "noisy": ("sensor=noisy",),
    "noisy_300_hz": ("sensor=noisy", "emulate.cutoff_hz=300"),  # the default sensor's bandwidth
    "thresholds_0.1": ("emulate.contrast_threshold_on=0.1", "emulate.contrast_threshold_off=0.1"),
    "thresholds_0.4": ("emulate.contrast_threshold_on=0.4", "emulate.contrast_threshold_off=0.4"),
    "off_1.4_times_on": ("emulate.contrast_threshold_off=0.28",),
    "mismatch_0.06": ("emulate.contrast_threshold_sigma_on=0.06", "emulate.contrast_threshold_sigma_off=0.06"),
    "mismatch_half": ("emulate.contrast_threshold_sigma_on=0.1", "emulate.contrast_threshold_sigma_off=0.1"),
    "slow": ("synthesize.speed_min_px_s=10", "synthesize.speed_max_px_s=40"),
    "fast": (
        "synthesize.speed_min_px_s=160", "synthesize.speed_max_px_s=320", "synthesize.acceleration_max_px_s2=3200",
    ),
    "60_hz": ("synthesize.frame_rate_hz=60",),
    "260x346": ("synthesize.sensor_height=260", "synthesize.sensor_width=346"),
    "v2e": ("emulate.model=v2e",),
    "esim": ("emulate.model=esim",),
    "dvs_voltmeter": ("emulate.model=dvs_voltmeter",),
    "imperfect_polarizers": (
        "polarizers.extinction_ratio=[100,100,100,100]", "polarizers.angle_error_deg=[2,-2,-2,2]",
        "polarizers.transmission=[1,0.95,1,0.95]",
    ),
    "dofp": ("polarizers.layout=dofp", "synthesize.sensor_height=240", "synthesize.sensor_width=360"),
    "saturating_readout": ("readout.max_events_per_s=300000",),  # a sensor fires 500,000 a second on average
    "randomised": ("sensor=random",),
}  # fmt: skip
"""Overrides of params.yaml by name; the scenes are the same, at the same places where the sensor has the same size."""
Condition = list[tuple[Path, tuple[str, ...]]]
"""Folders of pictures, each with its overrides."""


class Scores(NamedTuple):
    """Scores of one condition."""

    rows: list[FrameScore]
    dolp: dict[str, float]
    """Mean true DoLP by scene."""
    reliability: dict[str, Reliability]
    """By row with expected errors."""

    def __add__(self, other: "Scores") -> "Scores":  # type: ignore[override]
        sums = {name: one + other.reliability[name] for name, one in self.reliability.items()}
        return Scores(self.rows + other.rows, self.dolp | other.dolp, sums)


def conditions_of(images: Mapping[str, Path], arguments: argparse.Namespace) -> dict[str, Condition]:
    """Pictures and overrides by condition; `images` are the ingested photographs."""
    work, limit = arguments.work, arguments.limit
    parts = {name: part_of(folder, work / name, arguments.split, limit) for name, folder in images.items()}
    conditions: dict[str, Condition] = {"photographs": [(parts["rgb"], ())]}
    if "more" in parts:
        conditions["photographs_large"] = [(part, ()) for part in parts.values()]
    for folder in arguments.measured:
        for name, root in sources_of(folder, work).items():
            all_test = ("ingest.source=polarization", "ingest.val_fraction=0", "ingest.test_fraction=1")
            measured = ingested(root, work / name, *all_test)
            conditions[f"measured.{name}"] = [(part_of(measured, work / name, "test", limit), ())]
    small = part_of(images["rgb"], work / "rgb", arguments.split, arguments.sensor_limit or limit)
    conditions |= {f"sensors.{name}": [(small, overrides)] for name, overrides in SENSORS.items()}
    conditions |= {f"layers.{kind}": [(small, ())] for kind in layers.KINDS}
    return conditions | {"time.5ms": [(small, ("synthesize.frame_rate_hz=200",))]}


def contexts_of(
    condition: str, overrides: Sequence[str], train_mean: float, given: argparse.Namespace
) -> dict[str, Context]:
    """Settings of each row of the network under a condition; blocks and known thresholds have the first weights."""
    config = settings(*given.set, *overrides)
    contexts = {row: context_of(config, [*ROWS, OURS, WHOLE], train_mean, file) for row, file in given.weights.items()}
    if given.mode != PAST:
        return contexts
    variants = {BLOCKS: "methods.ours.binning=2"}
    if condition.startswith("sensors.") and not config.emulate.randomise:
        thresholds = f"[{config.emulate.contrast_threshold_on},{config.emulate.contrast_threshold_off}]"
        variants[CALIBRATED] = f"methods.ours.thresholds={thresholds}"
    first = next(iter(given.weights.values()))
    for row, variant in variants.items():
        contexts[row] = context_of(settings(*given.set, *overrides, variant), [OURS], train_mean, first)
    return contexts


def scored_sequence(
    scenes: SceneStore,
    overrides: Sequence[str],
    contexts: Mapping[str, Context],
    constant: float,
    mode: str,
    kind: str,
    name: str,
) -> Scores:
    """Scores of all methods on one sequence, of a `kind` of layers unless empty, without the windows of the warm-up."""
    config = settings(*overrides)  # a worker gets the overrides, because settings cannot be pickled
    test = layers.layered(scenes, name, config, kind) if kind else simulated(scenes, name, config)
    first_context = next(iter(contexts.values()))
    rows, _ = available(ROWS, first_context)
    predictions = predictions_of(rows, test, first_context)
    predictions[CONSTANT] = Prediction(torch.full_like(test.dolp, constant))
    for row, context in contexts.items():
        predictions[row] = predictions_of([OURS], test, context)[OURS]
    if mode != PAST:
        predictions |= predictions_of([WHOLE], test, first_context)
    warmup, between = warmup_windows(config), []
    first = scored_windows(test, warmup).start
    if mode == FRAMES:
        of_frames, truth_between, at_rate = with_frames(scenes, test, first_context, config, first)
        predictions |= of_frames
        between = score_sequence(truth_between, at_rate, 0, None, torch.device("cpu"))
    scores = score_sequence(test, predictions, warmup, None, torch.device("cpu")) + between
    valid = None if test.valid is None else test.valid[first:]
    errors = {
        row: reliability(one.log_variance[first:], one.dolp[first:], test.dolp[first:], valid)
        for row, one in predictions.items()
        if one.log_variance is not None
    }
    truth = test.dolp[first:] if valid is None else test.dolp[first:][valid]
    return Scores(scores, {test.scene: float(truth.mean())}, errors)


def with_frames(
    scenes: SceneStore, test: TestSequence, context: Context, config: Config, first: int
) -> tuple[dict[str, Prediction], TestSequence, dict[str, Prediction]]:
    """`registered`, the nearest frame and the filter for each rate of FRAMES_HZ, and `between_windows`."""
    predictions, between = {}, None
    method, windows = METHODS[WHOLE], test.windows()
    for rate_hz in FRAMES_HZ:
        frames = camera_frames(scenes, test.name, int(test.t_us[-1]), rate_hz)
        recoverer = method.open(replace(context.setups[method.section], frames=frames))
        state, predictions[f"{WHOLE}, {rate_hz} frames/s"] = recoverer.step(
            recoverer.start(*test.dolp.shape[-2:]), windows
        )
        nearest = np.abs(frames.t_us - test.t_us[1:, None].numpy()).argmin(1)
        s1, s2 = frames.stokes[nearest].unbind(1)
        aolp = torch.remainder(torch.atan2(s2, s1) / 2, math.pi)
        predictions[f"nearest of {rate_hz} frames/s"] = Prediction(torch.hypot(s1, s2).clamp(max=1), aolp)
        predictions[f"cf, {rate_hz} frames/s"] = filtered_with(frames, test, config)
        if rate_hz == BETWEEN_FRAMES_HZ:
            between = between_windows(scenes, test, recoverer, state, first)
    assert between is not None
    return predictions, *between


def filtered_with(frames: StokesFrames, test: TestSequence, config: Config) -> Prediction:
    """The complementary filter with frames (Scheerlinck, Barnes, Mahony, ACCV 2018), with the sensor's thresholds.

    The filter is linear in log intensity and DoLP knows no common factor, so frames of s1 and s2 alone serve it.
    """
    on, off = config.emulate.contrast_threshold_on, config.emulate.contrast_threshold_off
    settings_of_filter = replace(config.methods.cf, cutoff_hz=FILTER_HZ, contrast_on=on, contrast_off=-off)
    s1_s2 = torch.where(frames.valid[:, None], frames.stokes, 0.0).double()
    light = intensities_from_stokes(torch.cat([torch.ones_like(s1_s2[:, :1]), s1_s2], dim=1))
    logs = light.clamp(min=SMALLEST_SHARE).log().numpy()
    state, shown, images = at_rest(4, *test.dolp.shape[-2:]), logs[0], []
    of_frames = [(int(t_us), number) for number, t_us in enumerate(frames.t_us)]
    for t_us, number in sorted([(int(t_us), -1) for t_us in test.t_us[1:]] + of_frames):
        new = [slice_time(events, state.t_us, t_us) for events in test.events]
        state = integrate(state, new, t_us, settings_of_filter)
        difference = state.log_intensity * np.exp(-settings_of_filter.rate_per_us * (t_us - state.updated_us))
        if number < 0:
            images.append(torch.from_numpy(np.exp(difference + shown)))
            continue
        after = difference + shown - logs[number] if number else np.zeros_like(difference)
        state, shown = FilterState(after, np.full_like(state.updated_us, t_us), t_us), logs[number]
    filtered = from_intensities(torch.stack(images))
    return filtered._replace(dolp=filtered.dolp.clamp(max=1))  # as of every method


def between_windows(
    scenes: SceneStore, test: TestSequence, recoverer: Recoverer, state: State, first: int
) -> tuple[TestSequence, dict[str, Prediction]]:
    """Maps at times between windows, from window `first` on, of the run that ended in `state`; with their truth."""
    windows = test.windows()
    t_us = np.arange(windows[first].start_us, windows[-1].stop_us, BETWEEN_US) // (10**6 // BETWEEN_HZ)
    t_us = t_us[1:] * (10**6 // BETWEEN_HZ)
    truth = sequence_at(scenes, test.name, test.events, torch.from_numpy(np.concatenate([[0], t_us])))
    assert recoverer.between is not None
    return truth, {AT_RATE: recoverer.between(state, t_us)}


def camera_frames(scenes: SceneStore, name: str, stop_us: int, rate_hz: float) -> StokesFrames:
    """Frames of a camera on the path of a stored sequence, from the middle of the first exposure on."""
    scene, trajectory, _ = motion_over(scenes, name)
    pixels = grid(scenes.attributes["layout"], scenes.sensor_height, scenes.sensor_width)
    t_us = np.arange(EXPOSURE_US // 2, stop_us, round(1e6 / rate_hz))
    exposed = (t_us[:, None] + np.linspace(-EXPOSURE_US / 2, EXPOSURE_US / 2, EXPOSED)).clip(0, stop_us).ravel()
    light = frames_of(scene, trajectory, exposed.round().astype(int).tolist(), *pixels)[0]
    light = light.unflatten(0, (len(t_us), EXPOSED)).mean(1)
    random = generator_for(0, name, "frames").standard_normal(light.shape, np.float32)
    noise = torch.from_numpy(random) * (light / FULL_WELL + READ_NOISE**2).sqrt()
    s0, s1, s2 = stokes_from_intensities(((light + noise).clamp(0, 1) * DIGITS).round()).unbind(1)
    stokes = torch.stack([s1, s2], dim=1) / s0.clamp(min=1)[:, None]
    return StokesFrames(t_us, stokes, s0 > 0)


def sequence_at(scenes: SceneStore, name: str, events: Sequence[Events], t_us: Int64[Tensor, " n"]) -> TestSequence:
    """Events of a stored sequence, with exact truth at the window boundaries `t_us`."""
    scene, trajectory, _ = motion_over(scenes, name)
    pixels = grid(scenes.attributes["layout"], scenes.sensor_height, scenes.sensor_width)
    intensity, dolp, aolp = (frames[1:] for frames in frames_of(scene, trajectory, t_us.tolist(), *pixels))
    mask, crosstalk = scenes.read(name).valid if scenes.masked else None, scenes.attributes.get("crosstalk", 0.0)
    valid = None if mask is None else valid_frames(mask, trajectory, t_us.tolist()[1:], pixels, crosstalk)
    s0 = intensity[:, 0] + intensity[:, 2]
    return TestSequence(name, scenes.scene_of[name], events, t_us, dolp, aolp, s0, valid)


def simulated(scenes: SceneStore, name: str, config: Config) -> TestSequence:
    """A stored scene with the events of the configured camera, which moves as when the scene was made."""
    scene, trajectory, _ = motion_over(scenes, name)
    t_us = torch.tensor(frame_times_us(config.synthesize))
    size = scenes.sensor_height, scenes.sensor_width
    events = emulate_motion(config.camera.drawn(config.seed, name), scene, trajectory, int(t_us[-1]), size, 1)
    return sequence_at(scenes, name, events, t_us)


def warmup_windows(config: Config) -> int:
    """Windows that are not scored: as much time as the benchmark's at 30 windows a second."""
    return round(config.benchmark.warmup_windows * config.synthesize.frame_rate_hz / FRAME_RATE_HZ)


def table_of(scores: Scores) -> dict[str, Any]:
    """Means over scenes of each row's scores, MSE and median MSE also relative to the oracle mean's."""
    means = {name: scene_means(scores.rows, name) for name in ("mse", *BESIDE)}
    errors = means["mse"]
    oracle = errors["oracle_mean"]
    table: dict[str, Any] = {"scenes": len(oracle), "mean_dolp": statistics.fmean(scores.dolp.values()), "rows": {}}
    for row, of_scene in errors.items():
        mse, median = statistics.fmean(of_scene.values()), statistics.median(of_scene.values())
        table["rows"][row] = {
            "mse": mse,
            "mse_over_oracle_mean": mse / statistics.fmean(oracle.values()),
            "median_over_oracle_mean": median / statistics.median(oracle.values()),
            **{name: statistics.fmean(means[name][row].values()) for name in BESIDE if row in means[name]},
        }
        if row in scores.reliability:
            table["rows"][row]["error_factor"] = float(np.exp(scores.reliability[row].log_error()))
    return table


def headlines(tables: Mapping[str, Any], row: str) -> dict[str, Any]:
    """Figures of one row that stand above the sections of docs/results/robustness.json."""
    own, to_mean = {name: table["rows"][row] for name, table in tables.items()}, "mse_over_oracle_mean"
    photographs = own.keys() & {"photographs", "photographs_large"}
    figures: dict[str, Any] = {name: {to_mean: own[name][to_mean]} for name in sorted(photographs)}
    if measured := own.get("measured"):
        rows = tables["measured"]["rows"]
        best = min(rows[name]["mse"] for name in NO_TRUTH if name in rows)
        ratios = {key: measured[key] for key in (to_mean, "median_over_oracle_mean")}
        figures["measured"] = {"mse_over_best_baseline": measured["mse"] / best, **ratios}
        figures["calibration"] = {"measured_factor": measured["error_factor"]}
    errors = {name: one["mse"] for name, one in own.items() if name.startswith("sensors.")}
    if "sensors.default" in errors:
        figures["sensors"] = {"worst_over_default": max(errors.values()) / errors["sensors.default"]}
    return figures


def tables_of(
    conditions: Mapping[str, Condition], means: Mapping[str, list[float]], train_mean: float, given: argparse.Namespace
) -> dict[str, Any]:
    """Score every condition; returns its table, and one of all measured scenes. `means` has the mean DoLP by source."""
    results: dict[str, Scores] = {}
    tables: dict[str, Any] = {}
    for name, parts in conditions.items():
        others = [mean for source, of_source in means.items() if source != name for mean in of_source]
        constant = statistics.fmean(others) if others else train_mean
        for images, overrides in parts:
            all_overrides = *given.set, *overrides
            config = settings(*all_overrides)
            contexts = contexts_of(name, overrides, train_mean, given)
            scenes = scenes_of(images, config)
            kind = name.partition(".")[2] if given.mode == LAYERS else ""
            task = functools.partial(scored_sequence, scenes, all_overrides, contexts, constant, given.mode, kind)
            one = functools.reduce(Scores.__add__, config.mapper("sequences")(task, list(scenes.sequences)))
            results[name] = results[name] + one if name in results else one
        tables[name] = table_of(results[name])
        ratios = {row: round(one["mse_over_oracle_mean"], 3) for row, one in tables[name]["rows"].items()}
        print(name, ratios, flush=True)
    if measured := [one for name, one in results.items() if name.startswith("measured.")]:
        tables["measured"] = table_of(functools.reduce(Scores.__add__, measured))
    return tables


def main() -> None:
    """Score, print and perhaps write."""
    parser = command_line(__doc__, "docs/results/robustness.json")
    parser.add_argument("--photographs", type=Path, required=True)
    parser.add_argument("--photographs-large", type=Path, help="further photographs")
    parser.add_argument("--measured", type=Path, nargs="+", default=[], help="as ingest.source=polarization takes them")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--weights", nargs="+", default=[], metavar="[NAME=]FILE", help="default: the shipped weights")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="values, rows with published weights")
    parser.add_argument("--training", type=Path, help="folder for links to the training photographs")
    parser.add_argument("--split", choices=("test", "val"), default="test", help="split of the photographs")
    parser.add_argument("--conditions", nargs="+", help="only these, such as photographs measured sensors.noisy")
    parser.add_argument("--limit", type=int, help="pictures of each set")
    parser.add_argument("--sensor-limit", type=int, help="pictures of each sensor; default: as --limit")
    for mode, about in MODES.items():
        parser.add_argument(f"--{mode.replace('_', '-')}", dest="mode", action="store_const", const=mode, help=about)
    parser.set_defaults(mode=PAST)
    arguments = arguments_of(parser)
    pairs = [given.rpartition("=") for given in arguments.weights]
    arguments.weights = {name or OURS: Path(file).resolve() for name, _, file in pairs} or {OURS: shipped_weights()}
    record = machine_record()
    config = settings(*arguments.set)
    configure(config.runtime, config.seed)
    arguments.work.mkdir(parents=True, exist_ok=True)
    given = {"rgb": arguments.photographs, "more": arguments.photographs_large}
    roots = {name: root for name, root in given.items() if root}
    images = {name: ingested(root, arguments.work / name) for name, root in roots.items()}
    if arguments.training:
        print(f"{link_training(roots, images, arguments.training)} photographs in {arguments.training}")
        return
    conditions = conditions_of(images, arguments)
    measured = {name: parts for name, parts in conditions.items() if name.startswith("measured.")}
    means = {name: [mean for part, _ in of for mean in mean_dolp(part, "test")] for name, of in measured.items()}
    train_mean = statistics.fmean(mean_dolp(images["rgb"], "train"))
    mode, wanted = arguments.mode, tuple(f"{name}." for name in arguments.conditions or conditions)
    conditions = {name: one for name, one in conditions.items() if f"{name}.".startswith(wanted)}
    conditions = {name: one for name, one in conditions.items() if name.startswith(LAYERS) == (mode == LAYERS)}
    tables = tables_of(conditions, means, train_mean, arguments)
    rows = {name: table["rows"] for name, table in tables.items()}
    if mode == FRAMES:
        ours, with_5, at_rate = (rows["measured"][row] for row in (OURS, WITH_FRAMES, AT_RATE))
        ratio, change = with_5["mse"] / ours["mse"], at_rate["psnr"] - with_5["psnr"]
        figures = {FRAMES: {"mse_over_events_only": ratio, f"psnr_change_at_{BETWEEN_HZ}_hz": change}}
    elif mode == LAYERS:
        figures = {LAYERS: {name: of[WHOLE]["mse"] / of[OURS]["mse"] for name, of in rows.items()}}
    elif mode == WHOLE_FILE:
        figures = {mode: headlines(tables, WHOLE)}
        if of := rows.get("measured"):
            figures["measured"] = {"offset_over_before": of[WHOLE]["offset"] / of[OURS]["offset"]}
    else:
        figures = headlines(tables, next(iter(arguments.weights)))
    print(json.dumps(figures, indent=1))
    weights = {row: sha256(file) for row, file in arguments.weights.items()}
    section = {"limit": arguments.limit, "sensor_limit": arguments.sensor_limit, "weights": weights, "tables": tables}
    part = f"{mode}_{arguments.split}" if mode else arguments.split
    (arguments.work / f"robustness_{part}.json").write_text(json.dumps(section, indent=2) + "\n")
    if arguments.write:
        write_section("robustness", part, section, record, figures if arguments.split == "test" else None)


if __name__ == "__main__":
    main()
