"""Self-contained HTML pages: the report of a pipeline run, and the page of one test set (`polarnet benchmark`)."""

import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup
from ruamel.yaml import YAML

from polarnet.methods import METHODS, is_rotating
from polarnet.reports.artefacts import Artefacts, History, ReportPaths, Results, read_artefacts, read_results
from polarnet.reports.charts import (
    budget_chart,
    loss_chart,
    psnr_chart,
    reliability_chart,
    scatter_chart,
    score_chart,
    sets_chart,
    spread_chart,
)
from polarnet.reports.figures import comparison_figure
from polarnet.reports.html import embedded_json, script, svg, template
from polarnet.reports.legend import (
    LABELS,
    NAMED_BY_NETWORK,
    Legend,
    glossary,
    in_order,
    legend_of,
    lpips_about,
    network_label,
    with_structure,
)
from polarnet.reports.maps import data_uri, encode_jpeg, png
from polarnet.reports.overview import overview_figure
from polarnet.reports.paper import write_paper_files
from polarnet.reports.player import Film, panel_film, player_data
from polarnet.reports.provenance import Run
from polarnet.reports.tables import COLUMNS, COSTS, ERROR_PARTS, SET_TITLES, Scores, Table, paper_table, score_table
from polarnet.runtime.splits import SPLITS

HEADINGS = {
    "mse": "MSE",
    "psnr": "PSNR, dB",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "corr": "Correlation",
    "aolp_deg": "AoLP error, °",
    "ms_per_window": "Time, ms",
}
"""Columns of the first table; all others are one click away."""
PAGE_COLUMNS = {key: replace(COLUMNS[key], label=heading) for key, heading in HEADINGS.items()}
SCENES_AT_EACH_END = 3
MAX_FIGURE_PANELS = 4
SOURCE_NAMES = {
    "photograph": "photographs",
    "dead_leaves": "generated dead leaves",
    "folder": "of your own",
    "polarization": "of measured polarization",
}
SET_ABOUT = {
    "complex_motion": "The same held-out pictures while the camera turns, zooms and moves faster (section sets).",
    "measured": "Scenes whose polarization a camera measured, seen by a simulated event camera: real DoLP and AoLP, "
    "simulated events.",
    "recordings": "Captures of real targets (paper, section 4): real events, DoLP from pictures of the same camera.",
}


class SceneScore(NamedTuple):
    """A scene among the best or worst of a method."""

    scene: str
    mse: float
    rival: str
    """Label of the best other method there."""
    rival_mse: float | None
    film: str | None
    """Name of the scene in the player; None if it is not there."""


def write_report(paths: ReportPaths, baselines: Sequence[str], run: Run, folder: Path) -> Path:
    """Write index.html and, beside it, overview.png, comparison.png and the folder paper; `baselines` were trained.

    The folder holds the paper's Table 2 and figures 9 and 10 (`polarnet.reports.paper`). The page needs no other file
    and no network. FileNotFoundError names missing artefacts and the stage to run.
    """
    artefacts = read_artefacts(paths, baselines)
    results, legend = artefacts.results, legend_of(artefacts.results.details["weights"])
    folder.mkdir(parents=True, exist_ok=True)
    overview = None
    if artefacts.overview is not None:
        overview = png(overview_figure(artefacts.overview))
        (folder / "overview.png").write_bytes(overview)
    sets = [results, *artefacts.sets]
    write_paper_files(folder / "paper", sets, legend)
    budget = [point for point in artefacts.budget if not is_rotating(point.method)]  # that camera has other events
    charts = {"budget": svg(budget_chart(budget, legend))}
    if len(sets) > 1:
        charts["sets"] = svg(sets_chart(sets, SET_TITLES, legend))
    context = {
        "title": "polarnet report",
        "command": run.command,
        "facts": run.facts,
        "parameters": _as_yaml(run.parameters),
        "overview": None if overview is None else data_uri(overview, "png"),
        "sets": [_set(one, legend) for one in artefacts.sets],
        "trainings": _trainings(artefacts),
        "data": _data(artefacts),
    }
    return _write_page(folder, sets, legend, context, charts)


def write_set_page(folder: Path, title: str, command: str, notes: Sequence[str]) -> Path:
    """Write index.html and comparison.png beside the metrics.json, details.json and panels of one test set.

    `notes` are sentences for the reader of the table, such as the methods that did not run and the reasons.
    """
    results = read_results(folder)
    legend, weights = legend_of(results.details["weights"]), results.details["weights"]
    facts = {legend.label(row): f"{file['file']} (sha256 {file['sha256'][:16]})" for row, file in weights.items()}
    context = {"title": f"polarnet benchmark: {title}", "command": command, "notes": notes, "facts": facts}
    return _write_page(folder, [results], legend, context, {})


def _write_page(
    folder: Path, sets: Sequence[Results], legend: Legend, context: Mapping[str, Any], charts: Mapping[str, Markup]
) -> Path:
    """Fill the template into index.html, and write the panels as comparison.png; no such file without panels."""
    results = sets[0]
    if results.panels:
        figure = comparison_figure(results.panels[:MAX_FIGURE_PANELS], results.panels[0].predictions, legend)
        (folder / "comparison.png").write_bytes(png(figure))
    films = [
        panel_film(panel, legend, "" if one is results else SET_TITLES.get(one.name, one.name))
        for one in sets
        for panel in one.panels
    ]
    values = _results_context(results, legend, films) | dict(context)
    values |= {
        "charts": {**_result_charts(results, legend), **charts},
        "player_json": embedded_json(player_data(films)) if films else None,
        "script": script,
    }
    path = folder / "index.html"
    path.write_text(template("page.html.jinja").render(values), encoding="utf-8")
    return path


def _results_context(results: Results, legend: Legend, films: Sequence[Film]) -> dict[str, Any]:
    """Template values of the results on the test set; empty for the parts that only a pipeline's report has."""
    metrics, details = results.metrics, results.details
    return {
        "details": details,
        "verdict": verdict(metrics, details, legend),
        "scores": _page_table(results, legend),
        "all_scores": score_table(metrics, labels=legend.labels),
        "error_parts": score_table(metrics, columns=ERROR_PARTS, labels=legend.labels),
        "costs": score_table(metrics, columns=COSTS, labels=legend.labels),
        "extremes": extremes(results, legend, {film.name for film in films}),
        "ours": _spoken("ours" if "ours" in metrics else _best_method(metrics), legend),
        "glossary": glossary(metrics, details["weights"]),
        "lpips_about": lpips_about(details["lpips"]),
        "published": {experiment: paper_table(experiment) for experiment in ("simulated", "real")},
        "notes": [],
        "parameters": None,
        "overview": None,
        "sets": [],
        "trainings": [],
        "data": None,
    }


def _page_table(results: Results, legend: Legend) -> Table:
    return score_table(results.metrics, PAGE_COLUMNS, legend.labels, results.details["warmup_windows"])


def _result_charts(results: Results, legend: Legend) -> dict[str, Any]:
    """Charts of the results on a test set: a list or None where there may be several or none."""
    means, metrics = results.details["scene_means"].get("mse", {}), results.metrics
    shown = [key for key in PAGE_COLUMNS if any(row.get(key) is not None for row in metrics.values())]
    rivals = sorted((row for row in with_structure(means) if row != "ours"), key=lambda row: metrics[row]["mse"])
    groups = {row: entry["curve"] for row, entry in results.details.get("reliability", {}).items()}
    curves = {row: known for row, curve in groups.items() if (known := [one for one in curve if min(one[:2]) > 0])}
    return {
        "scores": [svg(score_chart(metrics, key, PAGE_COLUMNS[key], legend)) for key in shown],
        "spread": svg(spread_chart(means, legend)),
        "scatter": [svg(scatter_chart(means, row, legend)) for row in rivals] if "ours" in means else [],
        "reliability": svg(reliability_chart(curves, legend)) if curves else None,
        "sets": None,
    }


def verdict(metrics: Scores, details: Mapping[str, Any], legend: Legend) -> str:
    """One sentence: the error of ours, beside the best other method and the best constant."""
    method = "ours" if "ours" in metrics else _best_method(metrics)
    mse, scenes = metrics[method]["mse"], len(details["scenes"])
    plural = "" if scenes == 1 else "s"
    start = f"{_spoken(method, legend)} recovers DoLP with a mean squared error of {mse:.4f} on {scenes} scene{plural}"
    rivals = {row: metrics[row]["mse"] for row in with_structure(metrics) if row != method and not is_rotating(row)}
    parts = []
    if rivals:
        best = min(rivals, key=lambda row: rivals[row])
        parts.append(f"{_against(mse, rivals[best])} the best other method ({legend.label(best)})")
    if (constant := metrics.get("oracle_mean", {}).get("mse")) and method != "oracle_mean":
        parts.append(f"{_against(mse, constant)} the best constant")
    return start + (f": {' and '.join(parts)}." if parts else ".")


def _spoken(method: str, legend: Legend) -> str:
    """Label for a sentence, with a capital and without the row's key."""
    label = legend.label(method).removeprefix("ours: ")
    return label[:1].upper() + label[1:]


def _against(mse: float, other: float) -> str:
    change = round(100 * (mse / other - 1)) if other else 0
    return f"{abs(change)}\N{NO-BREAK SPACE}% {'lower' if change < 0 else 'higher'} than" if change else "the same as"


def _best_method(metrics: Scores) -> str:
    """The method with the lowest MSE; among the references if no method was run."""
    return min(with_structure(metrics) or in_order(metrics), key=lambda row: metrics[row]["mse"])


def extremes(results: Results, legend: Legend, films: set[str]) -> list[tuple[str, list[SceneScore]]]:
    """The worst and the best scenes of ours (without it: of the best method), by MSE."""
    means = results.details["scene_means"].get("mse", {})
    method = "ours" if "ours" in means else _best_method(results.metrics)
    others = [row for row in with_structure(means) if row != method and not is_rotating(row)]
    sequences = {scene: name for name in films for scene in means[method] if name.startswith(scene)}
    scores = []
    for scene, mse in sorted(means[method].items(), key=lambda item: -item[1]):
        known = {row: means[row][scene] for row in others if scene in means[row]}
        best = min(known, key=lambda row: known[row], default=None)
        label = "" if best is None else legend.label(best)
        scores.append(SceneScore(scene, mse, label, known.get(best or ""), sequences.get(scene)))
    count = min(SCENES_AT_EACH_END, (len(scores) + 1) // 2)
    return [("Worst scenes", scores[:count]), ("Best scenes", scores[count:][-SCENES_AT_EACH_END:][::-1])]


def _set(one: Results, legend: Legend) -> dict[str, Any]:
    """Template values of a test set other than the simulated one."""
    return {
        "title": SET_TITLES.get(one.name, one.name),
        "about": SET_ABOUT.get(one.name, ""),
        "scenes": len(one.details["scenes"]),
        "frames": one.details["frames"],
        "scores": _page_table(one, legend),
    }


def _data(artefacts: Artefacts) -> dict[str, Any]:
    """Template values of the pictures: counts, thumbnails by split, licences."""
    manifest = artefacts.manifest
    sources = Counter(entry.source for entry in manifest.pictures)
    return {
        "manifest": manifest,
        "sources": ", ".join(f"{count} {SOURCE_NAMES.get(source, source)}" for source, count in sources.items()),
        "thumbnails": {
            split: {name: data_uri(encode_jpeg(small), "jpeg") for name, small in artefacts.thumbnails[split].items()}
            for split in SPLITS
        },
        "skipped": [(one.file, one.reason) for one in manifest.skipped],
        "licences": [
            (one.name, one.split, one.origin, one.author or "not stated", one.licence or "not stated")
            for one in manifest.pictures
        ],
    }


def _trainings(artefacts: Artefacts) -> list[dict[str, Any]]:
    """Template values of each training."""
    histories = [("ours: ", artefacts.ours, "DoLP")]
    histories += [_baseline(name, history) for name, history in artefacts.baselines.items()]
    return [
        {
            "title": f"{row}{network_label(history.network)}, events to {output}",
            "charts": [svg(loss_chart(history)), svg(psnr_chart(history, output))],
            "epochs": len(history.validation["psnr"]),
            "best_epoch": history.best_epoch + 1,
            "best_psnr": history.validation["psnr"][history.best_epoch],
        }
        for row, history, output in histories
    ]


def _baseline(name: str, history: History) -> tuple[str, History, str]:
    """Row (if its label does not name the network), training and output of a trained baseline."""
    row = f"{LABELS[name]}: " if name in NAMED_BY_NETWORK else ""
    return row, history, "intensity" if METHODS[name].reconstructs else "polarization"


def _as_yaml(values: Mapping[str, Any]) -> str:
    """Parameters as they stand in params.yaml."""
    text, yaml = io.StringIO(), YAML()
    yaml.default_flow_style = False
    yaml.dump(dict(values), text)
    return text.getvalue()
