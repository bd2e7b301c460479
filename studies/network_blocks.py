"""Result blocks on the networks: their scores, trainings and speed."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from polarnet.methods import METHODS
from polarnet.reports.curves import PAPER_EVENTS_PER_PIXEL
from polarnet.reports.legend import LABELS, in_order
from polarnet.reports.tables import COLUMNS, ERROR_PARTS
from studies.measure import ABLATION_KEYS, ablation_about
from studies.scenes import CHOICES
from studies.tables import Block, Columns, Results, Row, listed, origin

ROOT = Path(__file__).resolve().parents[1]
TRAINING_FLOPS = 3  # relative to a forward pass: backward multiplies once for the inputs and once for the weights


def score_columns(keys: Iterable[str] = ABLATION_KEYS, path: str = "{}", prefix: str = "") -> dict[str, str]:
    """Columns with the headings and decimals of the benchmark's table; `path` places a key inside a row."""
    known = {key: (COLUMNS | ERROR_PARTS)[key] for key in keys}
    return {f"{prefix}{c.heading}": f"{{{path.format(key)}:.{c.decimals}f}}" for key, c in known.items()}


RENAMED_ABLATIONS = {"mosaic": "panorama"}
"""Files of conf/ablation that had another name when docs/results/network.json was measured."""
SETS = {"simulated": "new photographs", "measured": "measured scenes"}


def seeds_of(results: Results) -> dict[str, Any]:
    """The entries of a file of docs/results by training seed."""
    return {name.removeprefix("seed_"): entry for name, entry in results.items() if name.startswith("seed_")}


def pooled(entries: Iterable[Row]) -> dict[str, list[Any]]:
    """Every key's values over several entries, without missing ones."""
    rows = list(entries)
    return {
        key: [row[key] for row in rows if row.get(key) is not None] for key in dict.fromkeys(k for r in rows for k in r)
    }


def best_reconstruction(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """The intensity reconstruction with the smallest MSE."""
    intensity = [row for row in rows if row in METHODS and METHODS[row].reconstructs]
    return min(intensity, key=lambda row: rows[row]["mse"])


def _network_rows(name: str) -> Callable[[Results], Iterator[Row]]:
    def rows(results: Results) -> Iterator[Row]:
        seeds, untrained = seeds_of(results), results["benchmark"][name]
        for row in ("oracle_mean", best_reconstruction(untrained)):
            yield {"label": LABELS[row], **untrained[row]}
        for row in ("paper", "ours"):
            scores = {number: seed["rows"][name][row] for number, seed in seeds.items()}
            yield from ({"label": f"{LABELS[row]}, seed {number}", **one} for number, one in scores.items())
            yield {"label": f"{LABELS[row]}, mean ± standard deviation", **pooled(scores.values())}
        if "shipped" in results:
            yield {"label": "shipped weights", **results["shipped"]["rows"][name]["ours"]}

    return rows


def _compared_rows(results: Results) -> Iterator[Row]:
    rows = [{**seed, **seed["measured"], **seed["minutes_trained"]} for seed in seeds_of(results).values()]
    yield from ({"label": f"seed {number}", **row} for number, row in zip(seeds_of(results), rows, strict=True))
    numbers = [{key: value for key, value in row.items() if isinstance(value, float)} for row in rows]
    yield {"label": "mean ± standard deviation", **pooled(numbers)}


def _seed_lines(results: Results) -> Iterator[str]:
    for number, seed in seeds_of(results).items():
        threads = f", {seed['threads']} thread(s)" if seed.get("threads") else ""
        yield f"Seed {number}{threads}: {origin(results['records'][f'seed_{number}'])}"


def _expected_error_rows(results: Results) -> Iterator[Row]:
    for number, seed in seeds_of(results).items():
        sets = {name: {**one, "factor": math.exp(one["log_error"])} for name, one in seed["sets"].items()}
        yield {"label": f"seed {number}", **sets}


def _ablation_rows(results: Results) -> list[Row]:
    rows = results["ablation"]["rows"]
    order = sorted(rows, key=lambda name: (name != "nothing", -rows[name]["mse"]))
    names = {name: RENAMED_ABLATIONS.get(name, name) for name in order}
    return [{**rows[old], "name": name, "about": ablation_about(ROOT, name)} for old, name in names.items()]


def _choice_rows(results: Results) -> Iterator[Row]:
    for name, row in results["choices"]["rows"].items():
        about, trainings = (CHOICES[name].about, len(row["seeds"])) if name in CHOICES else (LABELS[name], None)
        yield {"about": about, "trainings": trainings, **pooled(row["seeds"])}


def _budget_columns(results: Results) -> Columns:
    columns = {"events per pixel": "{events_per_pixel:.2f}", "scenes": "{scenes}"}
    for method in in_order(results["budget"]["since_start"]):
        columns |= score_columns(("psnr", "corr"), f"{method}[{{}}]", f"{LABELS[method]}: ")
    return columns


def _budget_rows(results: Results) -> Iterator[Row]:
    methods = results["budget"]["since_start"]
    for entries in zip(*methods.values(), strict=True):
        yield {**entries[0], **dict(zip(methods, entries, strict=True))}


def _budget_lines(results: Results) -> Iterator[str]:
    ours = results["budget"]["since_start"]["ours"]
    claimed = next(entry for entry in ours if entry["to"] is None or entry["to"] > PAPER_EVENTS_PER_PIXEL)
    best = max(ours, key=lambda entry: entry["corr"])
    yield (
        f"The paper reports good results from {PAPER_EVENTS_PER_PIXEL} events per pixel. In that range, at "
        f"{claimed['events_per_pixel']:.2f}, ours has {claimed['psnr']:.2f} dB and a correlation of "
        f"{claimed['corr']:.3f}. Its highest correlation, {best['corr']:.3f}, comes at "
        f"{best['events_per_pixel']:.1f} with {best['psnr']:.2f} dB."
    )
    yield f"Number of sequences: {len(results['budget']['sequences'])}."


def _throughput_rows(results: Results) -> Iterator[Row]:
    for name, settings in results["throughput"]["networks"].items():
        for setting in ("naive", "shipped"):
            row = settings[setting]
            peak = row["peak_gflop_per_s"] / row["gflop_per_window"]
            share = {
                "train": TRAINING_FLOPS * row["train_frames_per_s"] / peak,
                "infer": row["infer_windows_per_s"] / peak,
            }
            yield {**row, "name": name, "setting": setting, "share": share, "peak_windows": peak}
        if faster := settings["shipped_over_naive"]:
            yield {"name": name, "setting": "shipped relative to naive", **faster}


def _profile_rows(results: Results) -> Iterator[Row]:
    for row in _throughput_rows(results):
        for work in ("train", "infer"):
            if operations := {op: share for op, share in row.get(f"{work}_profile", {}).items() if share >= 1}:
                yield {**row, "work": work, "operations": listed(operations, "{:.0f}")}


def _lpips_rows(results: Results) -> Iterator[Row]:
    demo = results["cost"]["demo"]
    yield {"label": "without LPIPS", "step": demo["step_ms"]["none"]}
    for backbone, share in demo["share"].items():
        costs = {
            "scoring": results["scoring_ms_per_frame"][backbone],
            "step": demo["step_ms"][backbone],
            "share": share,
        }
        yield {"label": f"`{backbone}`", "error": results[f"{backbone}_error_max"], **costs}


def _overrides(section: str) -> Callable[[Results], Iterator[str]]:
    def lines(results: Results) -> Iterator[str]:
        overrides = " ".join(f"`{one}`" for one in results[section]["overrides"])
        yield f"Overrides of the trainings: {overrides or 'none'}."
        notes = dict.fromkeys(note for point in results.get("points", []) for note in point["notes"])
        yield f"Notes of the trainings: {'; '.join(notes)}." if notes else ""

    return lines


SEVERAL = "Several trainings: mean ± standard deviation."


def _retrained_rows(results: Results) -> Iterator[Row]:
    """The shipped weights, which have seed 1, each other seed of their recipe, and the mean."""
    seeds = seeds_of(results)
    yield {"label": "seed 1", **results["shipped"]}
    for name, row in seeds.items():
        yield {"label": f"seed {name}", **row}
    if seeds:
        yield {"label": f"mean of {results['networks']}", **results["mean"]}


NETWORK_BLOCKS = {
    "networks-simulated": Block(
        "network", "seed_1", "studies.study", _network_rows("simulated"), {"": "{label}"} | score_columns(), caption="",
        beside="benchmark",
    ),
    "networks-measured": Block(
        "network", "seed_1", "studies.study", _network_rows("measured"), {"": "{label}"} | score_columns(), caption="",
        beside="benchmark",
    ),
    "networks-compared": Block(
        "network", "seed_1", "studies.study", _compared_rows,
        {
            "": "{label}", "PSNR minus that of the paper's network, dB": "{gain_over_paper_db:+.2f}",
            "MSE relative to the paper's network": "{mse_over_paper:.2f}",
            "MSE relative to the oracle mean": "{mse_over_oracle_mean:.2f}",
            "measured scenes: MSE relative to the best intensity reconstruction": "{mse_over_best_baseline:.2f}",
            "training, minutes": "{ours:.0f}", "training of the paper's network, minutes": "{paper:.0f}",
        },
        caption="", lines=_seed_lines,
    ),
    "expected_errors": Block(
        "expected_errors", "seed_1", "studies.study", _expected_error_rows,
        {"": "{label}"} | {
            f"{title}: {heading}": f"{{{name}{form}}}" for name, title in SETS.items()
            for heading, form in (("MSE ↓", "[mse]:.4f"), ("off by a factor of", "[factor]:.2f"))
        },
        "Factors are means over pixels, of too large and too small expectations alike; a calibrated network has 1.",
        _seed_lines,
    ),
    "ablation": Block(
        "network", "ablation", "studies.measure ablation", _ablation_rows,
        {"`ablation=`": "`{name}`", "change": "{about}"} | score_columns(), "One training each. {origin}",
        _overrides("ablation"),
    ),
    "choices": Block(
        "scenes", "choices", "studies.scenes", _choice_rows,
        {"training scenes": "{about}", "trainings": "{trainings}"} | score_columns(), f"{SEVERAL} {{origin}}",
        _overrides("choices"),
    ),
    "retrained": Block(
        "seeds", "shipped", "studies.seeds", _retrained_rows,
        {"": "{label}"} | {
            f"{title}: {heading}": f"{{{name}[{key}]:.2f}}"
            for name, title in (
                ("photographs", "photographs"), ("photographs_large", "larger set"), ("measured", "measured scenes")
            )
            for heading, key in (("MSE ↓", "mse_over_oracle_mean"), ("median ↓", "median_over_oracle_mean"))
        },
        "MSE and median MSE relative to the oracle mean's, on {scenes[photographs]}, {scenes[photographs_large]} and "
        "{scenes[measured]} scenes. {origin}",
    ),
    "data-curve": Block(
        "data_curve", "curve", "studies.data_curve", lambda results: results["curve"]["rows"],
        {"photographs": "{photographs}", "sequences": "{sequences}", "visits to each": "{visits}"} | {
            f"{title}: {heading}": f"{{{name}[{key}]{form}}}"
            for name, title in (("photographs_large", "photographs"), ("measured", "measured scenes"))
            for heading, key, form in (
                ("MSE ↓", "mse", ":.4f"), ("level ↓", "level_mse", ":.4f"), ("PSNR ↑", "psnr", ":.2f"),
                ("corr. ↑", "corr", ":.3f"), ("over the oracle mean ↓", "mse_over_oracle_mean", ":.2f"),
            )
        },
        "One training each, scored on {curve[scenes][photographs_large]} photographs and "
        "{curve[scenes][measured]} measured scenes. {origin}",
        _overrides("curve"),
    ),
    "event_budget": Block(
        "event_budget", "budget", "studies.study", _budget_rows, _budget_columns, lines=_budget_lines
    ),
    "throughput": Block(
        "network", "throughput", "studies.training", _throughput_rows,
        {
            "network": "`{name}`", "setting": "{setting}", "precision": "{precision}",
            "training, frames/s": "{train_frames_per_s:.2f}", "inference, windows/s": "{infer_windows_per_s:.2f}",
            "GFLOP a window": "{gflop_per_window:.2f}", "share of the peak in training": "{share[train]:.0%}",
            "in inference": "{share[infer]:.0%}", "inference at the peak, windows/s": "{peak_windows:.0f}",
        },
        "Device {throughput[device]}, {throughput[threads]} thread(s). {origin}",
    ),
    "profile": Block(
        "network", "throughput", "studies.training", _profile_rows,
        {"run": "`{name}`, {setting}, {work}", "percent of torch's time in each operation": "{operations}"},
        "Operations below one percent are left out.",
    ),
    "lpips": Block(
        "lpips", "cost", "studies.lpips", _lpips_rows,
        {
            "backbone": "{label}", "largest error": "{error:.1e}", "scoring, ms a frame": "{scoring:.1f}",
            "training step, ms": "{step:.0f}", "share of LPIPS": "{share:.0%}",
        },
        "Steps of `{cost[demo][network]}` on {cost[demo][frames]} frames in {cost[demo][precision]}. A step of "
        "`experiment=paper` on {cost[paper][frames]} frames in {cost[paper][precision]} takes "
        "{cost[paper][step_ms][vgg]:.0f} ms with VGG and {cost[paper][step_ms][none]:.0f} ms without LPIPS: LPIPS "
        "takes {cost[paper][share][vgg]:.0%}. Device {cost[device]}, {cost[threads]} thread(s). {origin}",
    ),
    "sweep": Block(
        "sweep", "loss_weights", "studies.measure sweep",
        lambda results: [{**point, "trainings": len(point["seeds"])} for point in results["points"]],
        {f"`loss.{name}`": f"{{weights[{name}]:g}}" for name in ("mse", "ssim", "lpips")}
        | {"trainings": "{trainings}"}
        | score_columns(("mse", "psnr"), "validation[{}]", "validation ")
        | score_columns(("mse", "psnr", "ssim", "lpips", "corr"), "test[{}]", "test "),
        "![Test scores by the weights of the three terms](pictures/loss_sweep.png)\n\n"
        "Lighter is better; the best value of a score is bold; the frame marks the smallest validation MSE.\n\n"
        "Rows are in the order of validation MSE; ± is the standard deviation over seeds. LPIPS has the backbone "
        "`{loss_weights[lpips_backbone]}`. {origin}",
        _overrides("loss_weights"),
    ),
}  # fmt: skip
