"""Tables of the results of studies/study.py, scenes.py and lpips.py: networks, scenes, events, LPIPS."""

import math
from collections.abc import Mapping, Sequence
from statistics import fmean, stdev
from typing import Any

from polarnet.methods import METHODS
from polarnet.reports.curves import PAPER_EVENTS_PER_PIXEL
from polarnet.reports.provenance import cores, measured_with, origin
from polarnet.reports.tables import LABELS, SET_TITLES, in_order


def seeds_of(results: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The entries of docs/results/network.json by training seed."""
    return {name.removeprefix("seed_"): found for name, found in results.items() if name.startswith("seed_")}


def over_seeds(seeds: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over the seeds of the comparisons of the two DoLP networks."""
    means = {key: fmean(found[key] for found in seeds) for key in _OF_NETWORKS}
    measured = fmean(found["measured"]["mse_over_best_baseline"] for found in seeds)
    return means | {"measured": {"mse_over_best_baseline": measured}}


def study_block(results: Mapping[str, Any]) -> str:
    """The two DoLP networks over all seeds, with the rows that they must beat, from studies/study.py.

    `results` is docs/results/network.json; every method is in the tables of benchmark.json.
    """
    seeds = seeds_of(results)
    first = next(iter(seeds.values()))
    lines = []
    for name in ("simulated", "measured"):
        lines += [f"**{SET_TITLES[name]}**", "", "| | " + " | ".join(label for _, label, _ in STUDY_COLUMNS) + " |"]
        lines.append("|---" + "|---:" * len(STUDY_COLUMNS) + "|")
        for row in ("oracle_mean", best_reconstruction(first["rows"][name])):
            lines.append(_row(LABELS[row], [first["rows"][name][row]]))
        for row in ("paper", "ours"):
            lines += [_row(f"{LABELS[row]}, seed {n}", [found["rows"][name][row]]) for n, found in seeds.items()]
            if len(seeds) > 1:
                label = f"{LABELS[row]}, mean of {len(seeds)} seeds ± standard deviation"
                lines.append(_row(label, [found["rows"][name][row] for found in seeds.values()]))
        if "shipped" in results:
            lines.append(_row("ours, shipped weights", [results["shipped"]["rows"][name]["ours"]]))
        lines.append("")
    lines += [f"Mean of {len(seeds)} seed(s): {_said(over_seeds([*seeds.values()]))}", ""]
    if "shipped" in results:
        lines += [f"Shipped weights: {_said(results['shipped'])}", ""]
    for seed, found in seeds.items():
        record, minutes = results["records"][f"seed_{seed}"], found["minutes_trained"]
        trained = ", ".join(f"{row} {value:.0f}" for row, value in minutes.items() if value is not None)
        lines += [
            f"Seed {seed}: minutes of training: {trained}; trained and scored on "
            f"{found['threads'] or record['cores']} core(s) ({measured_with(record)}).",
            "",
        ]
    return "\n".join(lines)


def expected_errors_block(results: Mapping[str, Any]) -> str:
    """Differences between the errors that our trained networks expect and the measured errors.

    `results` is docs/results/expected_errors.json, written by studies/study.py.
    """
    seeds = seeds_of(results)
    names = next(iter(seeds.values()))["sets"]
    titles = [f"{SET_TITLES[name]}: {column}" for name in names for column in ("MSE", "off by a factor of")]
    lines = ["| | " + " | ".join(titles) + " |", "|---" + "|---:" * len(titles) + "|"]
    for seed, found in seeds.items():
        cells = [f"{one['mse']:.4f} | {math.exp(one['log_error']):.2f}" for one in found["sets"].values()]
        lines.append(f"| ours, seed {seed} | {' | '.join(cells)} |")
    lines += ["", "Factors are means over pixels, of larger or smaller alike; 1 is calibrated."]
    for seed in seeds:
        lines += ["", f"Seed {seed}: {measured_with(results['records'][f'seed_{seed}'])}."]
    return "\n".join(lines)


def headline_block(results: Mapping[str, Any]) -> str:
    """Means over the seeds for the DoLP networks and the rows they must beat, and the speed of ours.

    `results` is docs/results/network.json.
    """
    seeds = [*seeds_of(results).values()]
    lines = ["| | " + " | ".join(f"{title}: MSE ↓ | PSNR ↑" for title in HEADLINE_SETS.values()) + " |"]
    lines.append("|---" + "|---:" * 2 * len(HEADLINE_SETS) + "|")
    for about, method in HEADLINE_ROWS.items():
        cells = []
        for name in HEADLINE_SETS:
            row = method or best_reconstruction(seeds[0]["rows"][name])
            scores = [found["rows"][name][row] for found in seeds if row in found["rows"][name]]
            cells += [f"{fmean(one['mse'] for one in scores):.4f}", f"{fmean(one['psnr'] for one in scores):.2f}"]
        lines.append(f"| {about} | " + " | ".join(cells) + " |")
    minutes = {
        row: [value for found in seeds if (value := found["minutes_trained"].get(row)) is not None]
        for row in ("ours", "paper")
    }
    taken = ", ".join(f"{LABELS[row]} {fmean(values):.0f}" for row, values in minutes.items() if values)
    lines += ["", f"Means of {len(seeds)} training(s); minutes that one took: {taken}."]
    if speed := results.get("throughput"):
        windows, record = results["ours"]["infer_windows_per_s"], results["records"]["throughput"]
        lines[-1] += (
            f" Ours recovers {windows:.0f} windows of {speed['height']} x {speed['width']} pixels a second with "
            f"{speed['threads']} threads ({speed['device']}, {record['machine']})."
        )
    return "\n".join(lines)


HEADLINE_SETS = {"simulated": "new photographs", "measured": "measured polarization"}
HEADLINE_ROWS = {
    "each frame's own mean, as if it were known": "oracle_mean",
    "the best reconstruction of intensities from events": None,
    "the paper's network": "paper",
    "ours: polarnet's network": "ours",
}
"""Method of each line; None: `best_reconstruction` of the set."""


def _said(found: Mapping[str, Any]) -> str:
    return (
        f"PSNR over the paper's network {found['gain_over_paper_db']:+.2f} dB, MSE over its "
        f"{found['mse_over_paper']:.2f}; over the oracle mean's {found['mse_over_oracle_mean']:.2f}; on measured "
        f"scenes over that of the best intensity reconstruction {found['measured']['mse_over_best_baseline']:.2f}."
    )


def _row(label: str, scores: Sequence[Mapping[str, float | None]]) -> str:
    """One line of a table; for several seeds, the mean and standard deviation."""
    cells = []
    for key, _, decimals in STUDY_COLUMNS:
        values = [value for one in scores if (value := one[key]) is not None]
        spread = f" ± {stdev(values):.{decimals}f}" if len(values) > 1 else ""
        cells.append(f"{fmean(values):.{decimals}f}{spread}" if values else "-")
    return f"| {label} | " + " | ".join(cells) + " |"


def best_reconstruction(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """The intensity reconstruction with the smallest MSE."""
    intensity = [row for row in rows if row in METHODS and METHODS[row].reconstructs]
    return min(intensity, key=lambda row: rows[row]["mse"])


STUDY_COLUMNS = (
    ("mse", "MSE ↓", 4),
    ("level_mse", "level ↓", 4),
    ("pattern_mse", "pattern ↓", 4),
    ("psnr", "PSNR ↑", 2),
    ("ssim", "SSIM ↑", 3),
    ("corr", "corr. ↑", 3),
    ("aolp_deg", "AoLP err. ↓", 1),
)
"""Key in network.json, heading, decimals."""
_OF_NETWORKS = ("gain_over_paper_db", "mse_over_paper", "mse_over_oracle_mean")


def ablation_block(results: Mapping[str, Any]) -> str:
    """The contribution of each part of the network and its training: below the whole, the worst loss first.

    `results` is docs/results/network.json; `python -m studies.measure ablation` writes the section.
    """
    found, record = results["ablation"], results["records"]["ablation"]
    rows = sorted(found["rows"].items(), key=lambda row: (row[0] != "nothing", -row[1]["mse"]))
    lines = ["| `ablation=` | | " + " | ".join(label for _, label, _ in STUDY_COLUMNS) + " |"]
    lines.append("|---|---" + "|---:" * len(STUDY_COLUMNS) + "|")
    lines += [_row(f"`{name}` | {scores['about']}", [scores]) for name, scores in rows]
    overrides = " ".join(f"`{override}`" for override in found["overrides"])
    return "\n".join([*lines, "", f"One training each, {overrides or 'without further overrides'}. {origin(record)}"])


def loss_sweep_block(results: Mapping[str, Any]) -> str:
    """Scores by the weights of Eq. 9, the smallest validation MSE first.

    `results` is docs/results/sweep.json, written by `python -m studies.measure sweep`.
    """
    about, record = results["loss_weights"], results["records"]["loss_weights"]
    lines = [
        "| `loss.mse` | `loss.ssim` | `loss.lpips` | seeds | " + " | ".join(h for *_, h, _ in SWEEP_COLUMNS) + " |"
    ]
    lines.append("|---:" * (4 + len(SWEEP_COLUMNS)) + "|")
    for point in results["points"]:
        weights = " | ".join(f"{point['weights'][name]:g}" for name in ("mse", "ssim", "lpips"))
        cells = []
        for split, key, _, decimals in SWEEP_COLUMNS:
            score = point[split].get(key) or {"mean": None, "std": None}
            spread = "" if score["std"] is None else f" ± {score['std']:.{decimals}f}"
            cells.append("-" if score["mean"] is None else f"{score['mean']:.{decimals}f}{spread}")
        lines.append(f"| {weights} | {len(point['seeds'])} | {' | '.join(cells)} |")
    notes = dict.fromkeys(note for point in results["points"] for note in point["notes"])
    overrides = " ".join(f"`{override}`" for override in about["overrides"])
    return "\n".join([
        *lines, "",
        "![Test scores by the weights of the three terms](pictures/loss_sweep.png)", "",
        "Lighter is better, bold the best of a score; the frame marks the smallest validation MSE.", "",
        f"Ranked by validation MSE; ± is the standard deviation over seeds. LPIPS has the backbone "
        f"`{about['lpips_backbone']}`. Further overrides: {overrides or 'none'}. {origin(record)}",
        *(["", f"Notes of the trainings: {'; '.join(notes)}."] if notes else []),
    ])  # fmt: skip


SWEEP_COLUMNS = (
    ("validation", "mse", "validation MSE ↓", 4),
    ("validation", "psnr", "validation PSNR ↑", 2),
    ("test", "mse", "test MSE ↓", 4),
    ("test", "psnr", "test PSNR ↑", 2),
    ("test", "ssim", "test SSIM ↑", 3),
    ("test", "lpips", "test LPIPS ↓", 3),
    ("test", "corr", "test corr. ↑", 3),
)
"""Split and key in sweep.json, heading, decimals."""


def designs_block(results: Mapping[str, Any]) -> str:
    """Designs tried before the present network, in chronological order, each compared with the oracle mean.

    `results` is docs/results/designs.json, collected by studies/designs.py.
    """
    lines = ["| | trainings | over the oracle mean ↓ | " + " | ".join(label for _, label, _ in STUDY_COLUMNS)]
    lines[0] += " | measured MSE ↓ | commit |"
    lines.append("|---|---:|---:" + "|---:" * len(STUDY_COLUMNS) + "|---:|---|")
    for row in results["rows"]["designs"]:
        trainings, ratio = len(row["seeds"]), fmean(row["mse_over_oracle_mean"])
        line = _row(f"{row['about']} | {trainings} | {ratio:.3f}", row["seeds"])
        lines.append(f"{line} {fmean(row['measured_mse']):.4f} | `{row['commit']}` |")
    return "\n".join(lines)


def choices_block(results: Mapping[str, Any]) -> str:
    """Choices of training scenes, compared without the test split by studies/scenes.py.

    `results` is docs/results/scenes.json.
    """
    rows, record = results["choices"]["rows"], results["records"]["choices"]
    lines = ["| | trainings | " + " | ".join(label for _, label, _ in STUDY_COLUMNS) + " |"]
    lines.append("|---|---:" + "|---:" * len(STUDY_COLUMNS) + "|")
    for name, row in rows.items():
        trainings = "-" if name == "oracle_mean" else len(row["seeds"])
        lines.append(_row(f"{row['about']} | {trainings}", row["seeds"]))
    overrides = " ".join(f"`{override}`" for override in results["choices"]["overrides"])
    said = f"Trained with {overrides}; of several trainings the mean ± standard deviation. {origin(record)}"
    return "\n".join([*lines, "", said])


def event_budget_block(results: Mapping[str, Any]) -> str:
    """Scores of ours and its rivals by events per pixel since the start, and a comparison with the paper's claim.

    `results` is docs/results/event_budget.json.
    """
    budget, record = results["budget"], results["records"]["budget"]
    rows = budget["since_start"]
    methods = in_order(rows)
    lines = [
        "| events per pixel | scenes | " + " | ".join(f"{LABELS[m]}: PSNR | corr." for m in methods) + " |",
        "|---" + "|---:" * (1 + 2 * len(methods)) + "|",
    ]
    for entries in zip(*(rows[method] for method in methods), strict=True):
        scores = " | ".join(f"{entry['psnr']:.2f} | {entry['corr']:.3f}" for entry in entries)
        lines.append(f"| {entries[0]['events_per_pixel']:.2f} | {entries[0]['scenes']} | {scores} |")
    ours = rows["ours"]
    claimed = next(e for e in ours if e["to"] is None or e["to"] > PAPER_EVENTS_PER_PIXEL)
    best = max(ours, key=lambda entry: entry["corr"])
    lines += [
        "",
        f"At {claimed['events_per_pixel']:.2f} events per pixel, the bin of the paper's {PAPER_EVENTS_PER_PIXEL}, ours "
        f"has {claimed['psnr']:.2f} dB and a correlation of {claimed['corr']:.3f}; the highest correlation, "
        f"{best['corr']:.3f} with {best['psnr']:.2f} dB, comes at {best['events_per_pixel']:.1f}.",
        "",
        f"{len(budget['sequences'])} sequences. {origin(record)}",
    ]
    return "\n".join(lines)


def lpips_block(results: Mapping[str, Any]) -> str:
    """Error of LPIPS for each backbone, and its cost in scoring and in training.

    `results` is docs/results/lpips.json as studies/lpips.py writes it.
    """
    cost, record = results["cost"], results["records"]["cost"]
    demo, paper = cost["demo"], cost["paper"]
    lines = [
        "| backbone | largest error | scoring, ms a frame | training step, ms | share of LPIPS |",
        "|---|---:|---:|---:|---:|",
        f"| without LPIPS | - | - | {demo['step_ms']['none']:.0f} | - |",
    ]
    lines += [
        f"| `{backbone}` | {results[f'{backbone}_error_max']:.1e} | {results['scoring_ms_per_frame'][backbone]:.1f} | "
        f"{demo['step_ms'][backbone]:.0f} | {100 * share:.0f} % |"
        for backbone, share in demo["share"].items()
    ]
    return "\n".join([
        *lines,
        "",
        f"Steps of `{demo['network']}` on {demo['frames']} frames in {demo['precision']}. A step of `experiment=paper` "
        f"on {paper['frames']} frames in {paper['precision']} takes {paper['step_ms']['vgg']:.0f} ms with VGG and "
        f"{paper['step_ms']['none']:.0f} ms without LPIPS: {100 * paper['share']['vgg']:.0f} % are LPIPS's.",
        "",
        f"{cost['threads']} thread(s) on {cores(record)} ({cost['device']}; {measured_with(record)}).",
    ])  # fmt: skip
