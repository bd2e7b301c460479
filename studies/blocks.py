"""The result blocks of README.md and docs/*.md: which file each one shows, its rows, columns and caption."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

from polarnet.methods import METHODS
from polarnet.reports.curves import PAPER_EVENTS_PER_PIXEL
from polarnet.reports.legend import LABELS, in_order
from polarnet.reports.tables import (
    COLUMNS,
    COSTS,
    ERROR_PARTS,
    paired_lines,
    score_table,
    standing,
)
from studies.designs import DESIGNS
from studies.measure import ABLATION_KEYS, ablation_about
from studies.rotating import CURVES
from studies.scenes import CHOICES
from studies.tables import Block, Columns, Results, Row, as_markdown, listed, origin

ROOT = Path(__file__).resolve().parents[1]
TRAINING_FLOPS = 3  # relative to a forward pass: backward multiplies once for the inputs and once for the weights
GOLDEN_CASES = 23  # 15 of v2e, 8 of ESIM


def score_columns(keys: Iterable[str] = ABLATION_KEYS, path: str = "{}", prefix: str = "") -> dict[str, str]:
    """Columns with the headings and decimals of the benchmark's table; `path` places a key inside a row."""
    known = {key: (COLUMNS | ERROR_PARTS)[key] for key in keys}
    return {f"{prefix}{c.heading}": f"{{{path.format(key)}:.{c.decimals}f}}" for key, c in known.items()}


RENAMED_ABLATIONS = {"mosaic": "panorama"}
"""Files of conf/ablation that had another name when docs/results/network.json was measured."""
SETS = {"simulated": "new photographs", "measured": "measured scenes"}
BENCHMARK_COLUMNS = {**COLUMNS, **COSTS}


def seeds_of(results: Results) -> dict[str, Any]:
    """The entries of docs/results/network.json or expected_errors.json by training seed."""
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


def _headline_rows(results: Results) -> Iterator[Row]:
    tables = [seed["rows"] for seed in seeds_of(results).values()]
    for method, label in HEADLINE_LABELS.items():
        row: dict[str, Any] = {"label": label}
        for name in SETS:
            chosen = method or best_reconstruction(tables[0][name])
            scores = pooled(table[name][chosen] for table in tables if chosen in table[name])
            row[name] = {key: fmean(scores[key]) for key in ("mse", "psnr")}
        yield row


HEADLINE_LABELS = {
    "oracle_mean": "mean DoLP of each frame, taken from the truth",
    "": "best intensity reconstruction",
    "paper": "the paper's network",
    "ours": "polarnet",
}
"""Rows of the README's table; "": the best reconstruction of the set."""


def _headline_lines(results: Results) -> list[str]:
    seeds = [*seeds_of(results).values()]
    minutes = pooled(seed["minutes_trained"] for seed in seeds)
    speed, windows = results["throughput"], results["ours"]["infer_windows_per_s"]
    return [
        f"Means of {len(seeds)} training(s) of each network on photographs. One training takes "
        f"{fmean(minutes['ours']):.0f} minutes (the paper's network: {fmean(minutes['paper']):.0f}). polarnet "
        f"processes {windows:.0f} windows of {speed['height']} x {speed['width']} pixels a second "
        f"({results['records']['throughput']['machine']}, {speed['threads']} threads)."
    ]


def _network_rows(name: str) -> Callable[[Results], Iterator[Row]]:
    def rows(results: Results) -> Iterator[Row]:
        seeds = seeds_of(results)
        first = next(iter(seeds.values()))["rows"][name]
        for row in ("oracle_mean", best_reconstruction(first)):
            yield {"label": LABELS[row], **first[row]}
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


def _design_rows(results: Results) -> Iterator[Row]:
    for row in results["rows"]["designs"]:
        about = next(design.about for design in DESIGNS if row["commit"].startswith(design.commit))
        yield {**row, **pooled(row["seeds"]), "about": about, "trainings": len(row["seeds"])}


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


ROTATING_COLUMNS = {
    "DoLP RMS": "{dolp_rms:.4f}", "bias": "{dolp_bias:+.4f}", "AoLP error, degrees": "{aolp_deg:.2f}",
    "expected RMS": "{expected_rms:.4f}", "errors within the expected": "{within_expected:.0%}",
    "within twice": "{within_twice_expected:.0%}",
}  # fmt: skip


def _rotating_curve_rows(results: Results) -> Iterator[Row]:
    for curve, points in results["rotating"]["curves"].items():
        label, _ = CURVES[curve]
        for score, about, form in (("dolp_rms", "DoLP RMS", "{:.3f}"), ("aolp_deg", "AoLP, degrees", "{:.1f}")):
            errors = ", ".join(f"{point['value']:g}: {form.format(point[score])}" for point in points)
            yield {"label": label, "about": about, "errors": errors}


def _formats(readers: Results) -> list[str]:
    """Names of polarnet's own readers; other libraries' entries are called LIBRARY_FORMAT."""
    return [name for name in readers if not any(name.endswith(f"_{other}") for other in readers)]


def _reader_rows(results: Results) -> Iterator[Row]:
    readers = results["readers"]
    for form in _formats(readers):
        others = {name.removesuffix(f"_{form}"): one for name, one in readers.items() if name.endswith(f"_{form}")}
        yield {"name": form, "polarnet": readers[form], **others}


def _reader_columns(results: Results) -> Columns:
    rows = list(_reader_rows(results))
    libraries = sorted({name for row in rows for name in row} - {"name", "polarnet"})
    sizes = dict.fromkeys(size for row in rows for size in row["polarnet"]["peak_mib"])
    speeds = {name: f"{{{name}[mevents_per_s]:.1f}}" for name in ("polarnet", *libraries)}
    return {"format": "`{name}`", **speeds, **{f"MiB at {size}": f"{{polarnet[peak_mib][{size}]}}" for size in sizes}}


def _recover_rows(results: Results) -> Iterator[Row]:
    for name, one in results["recover"]["methods"].items():
        label = "network `{network}`, {precision}".format_map(results["recover"]) if name == "network" else f"`{name}`"
        yield {"label": label, **one}


def _benchmark_lines(name: str) -> Callable[[Results], list[str]]:
    def lines(results: Results) -> list[str]:
        scores = results[name]
        solved = [row for row in scores if f"{row}+gain" in scores]
        gains = {LABELS[row]: scores[f"{row}+gain"]["psnr"] - scores[row]["psnr"] for row in solved}
        improvement = [f"Solved gains change PSNR by: {listed(gains, '{:+.2f} dB')}."] if gains else []
        return ["\n".join(f"- {line}" for line in [*paired_lines(results["paired"][name]), *improvement])]

    return lines


def _overrides(section: str) -> Callable[[Results], Iterator[str]]:
    def lines(results: Results) -> Iterator[str]:
        overrides = " ".join(f"`{one}`" for one in results[section]["overrides"])
        yield f"Overrides of the trainings: {overrides or 'none'}."
        notes = dict.fromkeys(note for point in results.get("points", []) for note in point["notes"])
        yield f"Notes of the trainings: {'; '.join(notes)}." if notes else ""

    return lines


def _benchmark(name: str) -> Block:
    caption = f"{{about[{name}][scenes]}} scenes, {{about[{name}][frames]}} frames. {{origin}}"
    return Block(
        "benchmark", name, "studies.study", lambda results: as_markdown(score_table(results[name], BENCHMARK_COLUMNS)),
        caption=caption, lines=_benchmark_lines(name),
    )  # fmt: skip


HOUSE_FIGURES = {
    "package_lines": "lines of Python in `polarnet/`",
    "top_level_modules": "modules at the top level of `polarnet/`",
    "dvc_yaml_lines": "lines of `dvc.yaml`",
    "body_median": "lines of a function body, median",
    "body_p90": "lines of a function body, 90th percentile",
    "retired_words": "uses of words that the glossary retires",
    "files_per_published_baseline": "files that a baseline with published weights touches",
    "files_per_trained_baseline": "files that a trained baseline touches",
    "test_minutes": "minutes of `make test`",
}
SEVERAL = "Several trainings: mean ± standard deviation."


ROBUSTNESS_ROWS = (
    "zeros",
    "train_mean",
    "constant_real",
    "highpass+gain",
    "firenet_published+gain",
    "ours",
    "ours, thresholds given",
)


def _robustness(key: str, form: str) -> Block:
    """One score of every method, relative to the oracle mean's, on every set of scenes and under every sensor."""
    return Block(
        "robustness", "test", "studies.robustness --write",
        lambda results: [
            {"name": name, **table, "value": {row: one[key] for row, one in table["rows"].items()}}
            for name, table in results["test"]["tables"].items()
        ],
        {"scenes": "`{name}`", "number": "{scenes}", "mean DoLP": "{mean_dolp:.3f}"}
        | {f"`{row}`": f"{{value[{row}]:{form}}}" for row in ROBUSTNESS_ROWS},
    )  # fmt: skip


def _sensor_fit(section: str, stimulus: str) -> Block:
    """Truth and estimate of each simulated sensor."""
    pairs = {
        "threshold ON": "contrast_threshold_on", "OFF": "contrast_threshold_off",
        "deviation ON": "threshold_deviation_on", "deviation OFF": "threshold_deviation_off",
        "bandwidth, Hz": "cutoff_hz", "leak, Hz": "leak_rate_hz", "shot noise, Hz": "shot_noise_rate_hz",
    }  # fmt: skip
    errors = ", ".join(
        f"{label} {{{section}[{key}]:.1%}}"
        for label, key in (
            ("thresholds", "threshold_error_max"), ("deviations", "deviation_error_max"),
            ("leak and shot noise", "noise_error_max"), ("bandwidth", "bandwidth_error_max"),
        )
    )  # fmt: skip
    return Block(
        "camera", section, "studies.sensor_fit",
        lambda results: [{"number": k + 1, **row} for k, row in enumerate(results[section]["sensors"])],
        {"sensor": "{number}"} | {
            heading: f"{{truth[{name}]:.3g}} / {{estimate[{name}]:.3g}}" for heading, name in pairs.items()
        },
        f"True value / estimate of simulated sensors, from {stimulus}; {{{section}[height]}} x {{{section}[width]}} "
        f"pixels. Largest errors: {errors}. {{origin}}",
    )  # fmt: skip


BLOCKS = {
    "headline": Block(
        "network", "seed_1", "studies.study", _headline_rows,
        {"": "{label}"} | {
            heading: form for name, title in SETS.items()
            for heading, form in score_columns(("mse", "psnr"), f"{name}[{{}}]", f"{title}: ").items()
        },
        caption="", lines=_headline_lines,
    ),
    "pipeline-scores": Block(
        "pipeline", "metrics", "studies.measure", lambda results: as_markdown(score_table(results["metrics"])),
        caption="Means over the test scenes; small figures are 95 % bootstrap intervals over scenes. {origin}",
        lines=lambda results: ["\n".join(f"- {line}" for line in standing(results["metrics"]))],
    ),
    "pipeline-minutes": Block(
        "pipeline", "test_minutes", "studies.measure",
        caption="In a fresh clone, the set-up takes {setup_minutes:.1f} minutes, `make repro` another "
        "{repro_minutes:.1f} and `make test` {test_minutes:.1f}. {origin}",
    ),
    "pipeline-stages": Block(
        "pipeline", "stage_minutes", "studies.measure", caption="",
        lines=lambda results: [f"Minutes by stage: {listed(results['stage_minutes'], '{:.1f}')}."],
    ),
    "benchmark-simulated": _benchmark("simulated"),
    "benchmark-measured": _benchmark("measured"),
    "emulation": Block(
        "emulation", "paper_set", "studies.emulation",
        lambda results: [{"name": name, **one} for name, one in results.items() if "seconds_1_thread" in str(one)],
        {
            "model": "`{name}`", "seconds, 1 thread": "{seconds_1_thread:.3f}", "2 threads": "{seconds_2_threads:.3f}",
            "Mpixel updates / s": "{mpixel_updates_per_s:,.0f}", "Mevents / s": "{mevents_per_s:,.1f}",
            "peak MiB": "{peak_mib:,.0f}", "timing error at 300 fps, ms": "{timing_error_ms_300fps:.3f}",
            "at 120 fps, ms": "{timing_error_ms_120fps:.3f}",
        },
        f"Reference cases of v2e and ESIM met: {{golden_cases_passed}} of {GOLDEN_CASES}. A set of "
        "{paper_set[sequences]} sequences, from pictures to the event store on disk, took {paper_set[minutes]:.1f} "
        "minutes (ingest {paper_set[stage_minutes][ingest]:.1f}, synthesize {paper_set[stage_minutes][synthesize]:.1f}"
        ", emulate {paper_set[stage_minutes][emulate]:.1f}) with at most {paper_set[peak_mib]:,} MiB of memory. "
        "{origin}",
    ),
    "readers": Block(
        "recordings", "readers", "studies.recordings", _reader_rows, _reader_columns,
        "Columns: millions of events a second, then the memory of polarnet's reader by number of events. {origin}",
    ),
    "fuzz": Block(
        "recordings", "fuzz", "studies.fuzz_recordings",
        lambda results: [
            {"name": name, "cases": one["cases"], "repaired": 0, **one["endings"]}
            for name, one in sorted(results["fuzz"]["readers"].items())
        ],
        {
            "reader": "`{name}`", "damaged files": "{cases:,}", "read": "{read:,}",
            "repaired, with a count": "{repaired:,}", "refused, with the reason": "{refused:,}",
        },
        "At least {fuzz[cases_per_reader]:,} damaged files for each reader; none ended otherwise. {origin}",
    ),
    "rig": Block(
        "recordings", "rig", "studies.rig", lambda results: as_markdown(score_table(results["rig"]["benchmark"])),
        caption="{rig[captures]} captures of a simulated sensor, {rig[sensor][1]} x {rig[sensor][0]} pixels. Start "
        "times found from the landmark are right within {rig[start_error_frames_max]:.2f} camera frames; refined "
        "ones agree within {rig[refined_error_ms_max]:.2f} ms. The zero of their common clock is a convention, up to "
        "{rig[clock_zero_ms_max]:.1f} ms from the landmark's. The DoLP of the truth differs from the scene's own by "
        "{rig[dolp_rms]:.4f} RMS, and by at most {rig[dolp_rms_max]:.4f} in a target. {origin}",
    ),
    "recover": Block(
        "recordings", "recover", "studies.recover", _recover_rows,
        {
            "method": "{label}", "speed relative to real time": "{realtime_factor:.2f}",
            "time of a step, ms": "{latency_ms:.1f}", "live: from event to frame, ms": "{live_latency_ms:.0f}",
        },
        "{recover[events]:,} events in {recover[seconds]:g} s. Runs from a file write Zarr, PNG and video; live runs "
        "write Zarr and video. {origin}",
    ),
    "inspection": Block(
        "inspection", "lines", "studies.rig", lambda results: "\n".join(["```", *results["lines"], "```"]), caption=""
    ),
    "networks-simulated": Block(
        "network", "seed_1", "studies.study", _network_rows("simulated"), {"": "{label}"} | score_columns(), caption=""
    ),
    "networks-measured": Block(
        "network", "seed_1", "studies.study", _network_rows("measured"), {"": "{label}"} | score_columns(), caption=""
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
    "designs": Block(
        "designs", "rows", "studies.designs", _design_rows,
        {"design": "{about}", "trainings": "{trainings}", "MSE relative to oracle mean ↓": "{mse_over_oracle_mean:.3f}"}
        | score_columns() | {"measured MSE ↓": "{measured_mse:.4f}", "commit": "`{commit}`"},
        SEVERAL,
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
    "rotating": Block(
        "camera", "rotating", "studies.rotating --write", lambda results: [results["rotating"]],
        {"turns/s": "{rate_hz:g}", "window, turns": "{window_turns:g}", **ROTATING_COLUMNS},
        "{rotating[scenes]} scenes. {origin}",
    ),
    "rotating-dolp": Block(
        "camera", "rotating", "studies.rotating --write", lambda results: results["rotating"]["by_dolp"],
        {"DoLP": "{low:g} to {high:g}", "pixels": "{pixels:,}", **ROTATING_COLUMNS}, caption="",
    ),
    "rotating-s0": Block(
        "camera", "rotating", "studies.rotating --write", lambda results: results["rotating"]["by_s0"],
        {"S0": "{low:g} to {high:g}", "pixels": "{pixels:,}", **ROTATING_COLUMNS}, caption="",
    ),
    "rotating-cases": Block(
        "camera", "rotating", "studies.rotating --write",
        lambda results: [{"name": name, **one} for name, one in results["rotating"]["cases"].items()],
        {"case": "{name}", **ROTATING_COLUMNS}, caption="",
    ),
    "rotating-curves": Block(
        "camera", "rotating", "studies.rotating --write", _rotating_curve_rows,
        {"setting": "{label}", "error": "{about}", "value: error": "{errors}"}, caption="",
    ),
    "house": Block(
        "house", "house", "studies.house --write",
        lambda results: [{"about": about, "value": results["house"][key]} for key, about in HOUSE_FIGURES.items()],
        {"figure": "{about}", "value": "{value:,}"},
    ),
    "house-folders": Block(
        "house", "house", "studies.house --write",
        lambda results: [{"name": name, **one} for name, one in results["house"]["folders"].items()],
        {"folder": "`{name}`", "files": "{files:,}", "lines": "{lines:,}"}, caption="",
    ),
    "polarizer-presets": Block(
        "camera", "polarizer_presets", "studies.polarizer_presets",
        lambda results: [
            {"name": name, **figures} for name, figures in results["polarizer_presets"]["presets"].items()
        ],
        {
            "`polarizers=`": "`{name}`", "DoLP of fully polarized light": "{dolp_of_full_polarization:.4f}",
            "its AoLP, RMS error": "{aolp_error_deg:.2f}°", "DoLP of the photograph, RMS error": "{scene_dolp_rms:.4f}",
        },
        "{polarizer_presets[number]} presets; fully polarized light at {polarizer_presets[angles]} angles, and "
        "`{polarizer_presets[scene]}`. {origin}",
    ),
    "robustness": _robustness("mse_over_oracle_mean", ".2f"),
    "robustness-median": _robustness("median_over_oracle_mean", ".2f"),
    "sensor-fit": _sensor_fit(
        "sensor_fit",
        "{sensor_fit[static_s]} s of constant light and {sensor_fit[moving_s]:g} s of drifting leaves with "
        "{sensor_fit[frame_rate_hz]} frames/s",
    ),
    "sensor-fit-flicker": _sensor_fit(
        "sensor_fit_flicker",
        "{sensor_fit_flicker[static_s]} s of constant light and lamps that flicker with contrast "
        "{sensor_fit_flicker[contrast]:g}",
    ),
}  # fmt: skip
"""Every block by the name that its markers have."""
