"""Methods on photographs, on measured scenes and on other sensors, in one table.

python -m studies.robustness --photographs FOLDER [--photographs-large FOLDER] --measured FOLDER ... --work FOLDER
    [--weights [NAME=]FILE ...] [--firenet FILE] [--split test|val|train] [--conditions NAME ...] [--limit N] [--write]
python -m studies.robustness --photographs FOLDER [--photographs-large FOLDER] --work FOLDER --training FOLDER

- `photographs`: a split of the pipeline's (`experiment=photographs`) of the folder --photographs.
- `photographs_large`: the same splits of --photographs and of --photographs-large together.
- `measured.SOURCE`: all measured scenes of one source. A folder with a manifest.csv (columns file, repo) has one source
  for each repo; any other folder is one source.
- `sensors.NAME`: the scenes of `photographs` under each entry of SENSORS (`studies.conditions`).
  `ours, thresholds given` is told the contrast thresholds of the sensor (`methods.ours.thresholds`).
- `time.5ms`: the scenes of the sensors with windows of 5 ms.
- `time.2000hz.photographs`, `time.2000hz.measured`: frames between windows (`polarnet recover --rate 2000`), on the
  pictures of the sensors and on all measured scenes, at 16 times between the ends of two windows (`studies.rate`).

Under each condition but the last two, `ours, 2x2 blocks` is the network on blocks of pixels (`methods.ours.binning=2`).

Nothing is trained, except the constants: `train_mean` is the mean DoLP of the training photographs, and `constant_real`
the mean DoLP of the measured scenes of all sources but the one that is scored. --split val is for choices and --split
test for figures; --split train shows how well a network knows the photographs that it was trained on. --limit takes the
first N pictures of each set; --sensor-limit of the sensors alone. Events are simulated in memory, and pictures are kept
in --work. --write puts the scores into docs/results/robustness.json, and those of the test split also into
docs/pictures.

The second command scores nothing. It fills --training with links to the training photographs of both folders. A
network trained on them (`ingest.root`) has seen no photograph of --split val and --split test.
"""

import argparse
import functools
import json
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from polarnet.analysis.resimulate import resimulated
from polarnet.benchmark.rows import Context, available, predictions_of
from polarnet.benchmark.score import FrameScore, scene_means, score_sequence, scored_windows
from polarnet.config.pipeline import context_of
from polarnet.config.tree import Config
from polarnet.metrics.reliability import Reliability, reliability
from polarnet.networks.weights import shipped_weights
from polarnet.reports.figures import LIGHT
from polarnet.reports.maps import png
from polarnet.runtime.files import sha256
from polarnet.runtime.machine import configure
from polarnet.simulation.camera import Camera
from polarnet.simulation.motion import SynthesizeConfig
from polarnet.stokes import Prediction
from polarnet.storage.scenes import SceneStore
from studies.conditions import BINNING, conditions_of, selected
from studies.figures import robustness_figure
from studies.measure import arguments_of, command_line, machine_record, write_section
from studies.rate import (
    ENDS,
    FRAME_RATE_HZ,
    OURS,
    RATE_HZ,
    RATED,
    rated_scores,
)
from studies.scored_pictures import ingested, link_training, mean_dolp, scenes_of, settings

ROOT = Path(__file__).resolve().parents[1]
CALIBRATED = "ours, thresholds given"
BLOCKS = "ours, 2x2 blocks"
CONSTANT = "constant_real"
METHODS = ("zeros", "train_mean", "oracle_mean", "highpass+gain", "firenet_published+gain")
NO_TRUTH = ("zeros", "train_mean", CONSTANT, "highpass+gain", "firenet_published+gain")
"""Rows that need no truth, against which ours is compared on measured scenes."""
BANDS = {"below_0.06": (0.0, 0.06), "0.06_to_0.2": (0.06, 0.2), "above_0.2": (0.2, 1.0)}
"""Mean DoLP of a scene."""


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


def scored_sequence(
    name: str,
    scenes: SceneStore,
    motion: SynthesizeConfig,
    camera: Camera,
    seed: int,
    warmup: int,
    contexts: Mapping[str, Context],
    constant: float,
) -> Scores:
    """Scores of all methods on one sequence; the first `warmup` windows are not scored."""
    test = resimulated(scenes, name, motion, [camera] * 4, seed)
    baselines, _ = available(METHODS, next(iter(contexts.values())))
    predictions = predictions_of(baselines, test, next(iter(contexts.values())))
    predictions[CONSTANT] = Prediction(torch.full_like(test.dolp, constant))
    for row, context in contexts.items():
        predictions[row] = predictions_of([OURS], test, context)[OURS]
    rows = score_sequence(test, predictions, warmup, None, torch.device("cpu"))
    first = scored_windows(test, warmup).start
    valid = None if test.valid is None else test.valid[first:]
    errors = {
        row: reliability(one.log_variance[first:], one.dolp[first:], test.dolp[first:], valid)
        for row, one in predictions.items()
        if one.log_variance is not None
    }
    truth = test.dolp[first:] if valid is None else test.dolp[first:][valid]
    return Scores(rows, {test.scene: float(truth.mean())}, errors)


def rated_sequence(name: str, **settings: Any) -> Scores:
    """Scores of the frames between the windows of one sequence (`studies.rate.rated_scores`)."""
    rows, degree = rated_scores(name, **settings)
    return Scores(rows, {rows[0].scene: degree}, {})


def scored(
    images: Path, config: Config, contexts: Mapping[str, Context], constant: float, rated: bool = False
) -> Scores:
    """Scores of all methods on the pictures of a folder under one condition; `rated`: of frames between windows."""
    scenes = scenes_of(images, config)
    warmup = round(config.benchmark.warmup_windows * config.synthesize.frame_rate_hz / FRAME_RATE_HZ)
    common: dict[str, Any] = {
        "scenes": scenes, "motion": config.synthesize, "camera": config.camera, "seed": config.seed,
        "warmup": warmup, "contexts": contexts,
    }  # fmt: skip
    task: Callable[[str], Scores] = functools.partial(scored_sequence, **common, constant=constant)
    if rated:
        task = functools.partial(rated_sequence, **common, between=config.between)
    results = config.mapper("sequences")(task, list(scenes.sequences))
    return functools.reduce(Scores.__add__, results)


def table_of(scores: Scores) -> dict[str, Any]:
    """Mean and median over scenes of each row's errors, also relative to the oracle mean's, and by mean DoLP."""
    errors, psnr, level, corr = (scene_means(scores.rows, metric) for metric in ("mse", "psnr", "level_mse", "corr"))
    oracle = errors["oracle_mean"]
    counts = {name: sum(low <= mean < high for mean in scores.dolp.values()) for name, (low, high) in BANDS.items()}
    mean = statistics.fmean(scores.dolp.values())
    table: dict[str, Any] = {"scenes": len(oracle), "scenes_by_dolp": counts, "mean_dolp": mean, "rows": {}}
    for row, of_scene in errors.items():
        mse, median = statistics.fmean(of_scene.values()), statistics.median(of_scene.values())
        bands = {
            name: statistics.fmean(inside)
            for name, (low, high) in BANDS.items()
            if (inside := [of_scene[scene] for scene, mean in scores.dolp.items() if low <= mean < high])
        }
        table["rows"][row] = {
            "mse": mse,
            "median_mse": median,
            "mse_over_oracle_mean": mse / statistics.fmean(oracle.values()),
            "median_over_oracle_mean": median / statistics.median(oracle.values()),
            "level_mse": statistics.fmean(level[row].values()),
            "psnr": statistics.fmean(psnr[row].values()),
            "corr": statistics.fmean(corr[row].values()),
            "mse_by_dolp": bands,
        }
        if row in scores.reliability:
            table["rows"][row]["error_factor"] = float(np.exp(scores.reliability[row].log_error()))
    return table


def headlines(tables: Mapping[str, Any], row: str) -> dict[str, Any]:
    """Figures of one row that stand above the sections of docs/results/robustness.json."""
    figures: dict[str, Any] = {}
    for name in ("photographs", "photographs_large"):
        if name in tables:
            figures[name] = {"mse_over_oracle_mean": tables[name]["rows"][row]["mse_over_oracle_mean"]}
    if "measured" in tables:
        rows = tables["measured"]["rows"]
        best = min(rows[name]["mse"] for name in NO_TRUTH if name in rows)
        figures["measured"] = {
            "mse_over_best_baseline": rows[row]["mse"] / best,
            "mse_over_oracle_mean": rows[row]["mse_over_oracle_mean"],
            "median_over_oracle_mean": rows[row]["median_over_oracle_mean"],
        }
        figures["calibration"] = {"measured_factor": rows[row]["error_factor"]}
    if "sensors.default" in tables:
        default = tables["sensors.default"]["rows"][row]["mse"]
        of_sensor = {
            name.removeprefix("sensors."): {
                "mse_over_default": table["rows"][row]["mse"] / default,
                "mse_over_oracle_mean": table["rows"][row]["mse_over_oracle_mean"],
            }
            for name, table in tables.items()
            if name.startswith("sensors.")
        }
        worst = max(one["mse_over_default"] for one in of_sensor.values())
        figures["sensors"] = {**of_sensor, "worst_over_default": worst}
        if "time.5ms" in tables:
            psnr = [tables[name]["rows"][row]["psnr"] for name in ("sensors.default", "time.5ms")]
            figures["time"] = {"db_lost_5ms": psnr[0] - psnr[1]}
    rated = [table["rows"] for name, table in tables.items() if name.startswith(RATED)]
    if rated:
        lost = max(rows[row + ENDS]["psnr"] - rows[row]["psnr"] for rows in rated)
        figures["time"] = figures.get("time", {}) | {f"db_lost_{RATE_HZ}hz": lost}
    return figures


def printed(tables: Mapping[str, Any], key: str) -> str:
    """The table of one figure: a row for each method, a column for each condition."""
    rows = list(dict.fromkeys(row for table in tables.values() for row in table["rows"]))
    lines = [f"{key}", "condition," + ",".join(rows) + ",scenes,mean DoLP"]
    for name, table in tables.items():
        values = [table["rows"].get(row, {}).get(key) for row in rows]
        cells = ["-" if value is None else f"{value:.4g}" for value in values]
        lines.append(",".join([name, *cells, str(table["scenes"]), f"{table['mean_dolp']:.3f}"]))
    return "\n".join(lines)


def parsed() -> argparse.Namespace:
    """The command line, with paths as every working directory understands them."""
    parser = command_line(__doc__, "docs/results/robustness.json")
    parser.add_argument("--photographs", type=Path, required=True)
    parser.add_argument("--photographs-large", type=Path, help="further photographs")
    parser.add_argument("--measured", type=Path, nargs="+", default=[], help="as ingest.source=polarization takes them")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument(
        "--weights", nargs="+", default=[], metavar="[NAME=]FILE", help="checkpoints; default: the shipped one"
    )
    parser.add_argument("--training", type=Path, help="folder for links to the training photographs")
    parser.add_argument("--firenet", type=Path, help="published weights of FireNet")
    parser.add_argument("--split", choices=("test", "val", "train"), default="test", help="split of the photographs")
    parser.add_argument("--section", help="name of the figures of --split val or train in the file; default: the split")
    parser.add_argument("--conditions", nargs="+", help="only these, such as photographs measured sensors.noisy")
    parser.add_argument("--limit", type=int, help="pictures of each set")
    parser.add_argument("--sensor-limit", type=int, help="pictures of each sensor; default: as --limit")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1, help="processes that share the sequences")
    arguments = arguments_of(parser)
    for name in ("photographs", "photographs_large", "work", "firenet", "training"):
        if path := getattr(arguments, name):
            setattr(arguments, name, path.resolve())
    arguments.measured = [folder.resolve() for folder in arguments.measured]
    pairs = [given.rpartition("=") for given in arguments.weights]
    arguments.weights = {name or OURS: Path(file).resolve() for name, _, file in pairs} or {OURS: shipped_weights()}
    return arguments


def contexts_of(
    condition: str, overrides: Sequence[str], train_mean: float, weights: Mapping[str, Path]
) -> dict[str, Context]:
    """Settings of each row of the network under a condition; blocks and known thresholds have the first weights."""
    config = settings(*overrides)
    contexts = {row: context_of(config, train_mean, file) for row, file in weights.items()}
    variants = {} if condition.startswith(RATED) else {BLOCKS: f"methods.ours.binning={BINNING}"}
    if condition.startswith("sensors.") and not config.emulate.randomise:
        thresholds = f"[{config.emulate.contrast_threshold_on},{config.emulate.contrast_threshold_off}]"
        variants[CALIBRATED] = f"methods.ours.thresholds={thresholds}"
    first = next(iter(weights.values()))
    return contexts | {
        row: context_of(settings(*overrides, variant), train_mean, first) for row, variant in variants.items()
    }


def tables_of(
    conditions: Mapping[str, list[tuple[Path, tuple[str, ...]]]],
    means: Mapping[str, list[float]],
    train_mean: float,
    weights: Mapping[str, Path],
    common: Sequence[str],
) -> dict[str, Any]:
    """Score every condition; returns its table, and one of all measured scenes. `means` has the mean DoLP by source."""
    results: dict[str, Scores] = {}
    tables: dict[str, Any] = {}
    for name, parts in conditions.items():
        others = [mean for source, of_source in means.items() if source != name for mean in of_source]
        constant = statistics.fmean(others) if others else train_mean
        for part, overrides in parts:
            given = (*common, *overrides)
            contexts = contexts_of(name, given, train_mean, weights)
            one = scored(part, settings(*given), contexts, constant, rated=name.startswith(RATED))
            results[name] = results[name] + one if name in results else one
        tables[name] = table_of(results[name])
        ratios = {row: round(one["mse_over_oracle_mean"], 3) for row, one in tables[name]["rows"].items()}
        print(name, ratios, flush=True)
    if measured := [one for name, one in results.items() if name.startswith("measured.")]:
        tables["measured"] = table_of(functools.reduce(Scores.__add__, measured))
    return tables


def write_tables(tables: Mapping[str, Any], arguments: argparse.Namespace, record: Mapping[str, Any]) -> None:
    """Print the tables and keep them in --work; with --write also in docs."""
    for key in ("mse", "median_mse", "mse_over_oracle_mean", "median_over_oracle_mean", "level_mse", "psnr", "corr"):
        print(printed(tables, key), end="\n\n")
    figures = headlines(tables, next(iter(arguments.weights)))
    print(json.dumps(figures, indent=1))
    section = {
        "split": arguments.split, "limit": arguments.limit, "sensor_limit": arguments.sensor_limit,
        "weights": {row: sha256(file) for row, file in arguments.weights.items()}, "tables": tables,
    }  # fmt: skip
    (arguments.work / f"robustness_{arguments.split}.json").write_text(json.dumps(section, indent=2) + "\n")
    if arguments.write:
        of_test = arguments.split == "test"
        name = arguments.split if of_test else arguments.section or arguments.split
        print(write_section(ROOT, "robustness", name, section, record, figures if of_test else None))
        if of_test:
            picture = ROOT / "docs" / "pictures" / "robustness_test.png"
            picture.write_bytes(png(robustness_figure(tables, LIGHT)))


def main() -> None:
    """Score, print and perhaps write."""
    arguments = parsed()
    record = machine_record(ROOT)
    common = [f"runtime.threads={arguments.threads}", f"runtime.workers={arguments.workers}"]
    if arguments.firenet:
        common.append(f"methods.firenet_published.weights={arguments.firenet}")
    config = settings(*common)
    configure(config.runtime, config.seed)
    arguments.work.mkdir(parents=True, exist_ok=True)
    given = {"rgb": arguments.photographs, "more": arguments.photographs_large}
    roots = {name: root for name, root in given.items() if root}
    images = {name: ingested(root, arguments.work / name) for name, root in roots.items()}
    if arguments.training:
        print(f"{link_training(roots, images, arguments.training)} photographs in {arguments.training}")
        return
    conditions = conditions_of(images, arguments)
    means = {
        name: [mean for part, _ in parts for mean in mean_dolp(part, "test")]
        for name, parts in conditions.items()
        if name.startswith("measured.")
    }
    train_mean = statistics.fmean(mean_dolp(images["rgb"], "train"))
    chosen = selected(conditions, arguments.conditions)
    write_tables(tables_of(chosen, means, train_mean, arguments.weights, common), arguments, record)


if __name__ == "__main__":
    main()
