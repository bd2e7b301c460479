"""Self-contained HTML pages: the report of a pipeline run, and the page of one test set (`polarnet benchmark`)."""

import io
import json
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup
from ruamel.yaml import YAML

from polarnet.methods import is_rotating
from polarnet.pictures.manifest import read_manifest
from polarnet.reports.artefacts import SIMULATED, ReportPaths, Results, Run, read_results
from polarnet.reports.figures import comparison_figure, error_chart, reliability_chart, svg
from polarnet.reports.legend import LABELS, Legend, glossary, in_order, network_label, with_structure
from polarnet.reports.maps import write_figure
from polarnet.reports.player import panel_film, player_data, template
from polarnet.reports.tables import PARTS_AND_COSTS, Scores, score_table
from polarnet.runtime.files import check_name
from polarnet.storage.scenes import SceneStore
from polarnet.training.engine.recorder import best_row, read_history

OURS = "ours"
OWN = (OURS, "registered")  # the same network, over the past and over the whole recording
WORST_SCENES = 5
MAX_FIGURE_PANELS = 4
GENERATED = "dead_leaves"
SOURCE_NAMES = {
    "photograph": "photographs",
    GENERATED: "generated dead leaves",
    "folder": "of your own",
    "polarization": "of measured polarization",
}


def write_report(paths: ReportPaths, baselines: Sequence[str], run: Run, folder: Path) -> Path:
    """Write index.html and, beside it, a comparison of the methods on each set; `baselines` were trained.

    The page needs no other file and no network. FileNotFoundError names missing artefacts and the stage to run.
    """
    manifest, results = read_manifest(paths.images), read_results(paths.simulated)
    generated = {entry.name for entry in manifest.pictures if entry.source == GENERATED}
    scene_of, sources = SceneStore.open(paths.scenes).scene_of, Counter(one.source for one in manifest.pictures)
    panels = sorted(results.panels, key=lambda p: (scene_of[p.sequence] in generated, -float(p.truth.dolp.std())))
    others = [read_results(one) for one in sorted(paths.benchmark.glob("sets/*")) if one.name != SIMULATED]
    sets = [results._replace(panels=panels), *others]
    content = {
        "title": "polarnet report",
        "scenes": _in_words(results.details["scenes"], "simulated scene", generated),
        "command": run.command,
        "facts": run.facts,
        "parameters": _as_yaml(run.parameters),
        "trainings": [_training(paths.train, name) for name in (OURS, *baselines)],
        "manifest": manifest,
        "sources": ", ".join(f"{count} {SOURCE_NAMES.get(source, source)}" for source, count in sources.items()),
    }
    return _write_page(folder, sets, content)


def write_set_page(folder: Path, title: str, command: str, notes: Sequence[str]) -> Path:
    """Write index.html and a comparison of the methods beside metrics.json, details.json and panels of a test set.

    `notes` are sentences for the reader of the table, such as the methods that did not run and the reasons.
    """
    results = read_results(folder)
    content = {
        "title": f"polarnet benchmark: {title}",
        "scenes": _in_words(results.details["scenes"], "scene"),
        "command": command,
        "facts": {
            results.legend.label(row): f"{file['file']} (sha256 {file['sha256'][:16]})"
            for row, file in results.details["weights"].items()
        },
        "notes": notes,
    }
    return _write_page(folder, [results], content)


def _write_page(folder: Path, sets: Sequence[Results], content: Mapping[str, Any]) -> Path:
    """Fill the template into index.html, and draw the first panels of each set as comparison_SET.png and .pdf."""
    results, *others = sets
    metrics, details = results.metrics, results.details
    legend, method = results.legend, _judged(metrics)
    folder.mkdir(parents=True, exist_ok=True)
    for one in (one for one in sets if one.panels):
        figure = comparison_figure(one.panels[:MAX_FIGURE_PANELS], legend)
        write_figure(figure, folder / f"comparison_{check_name(one.name)}")
    films = [panel_film(panel, legend) for panel in results.panels]
    films += [panel_film(panel, legend, one.title) for one in others for panel in one.panels]
    names, means = [film.name for film in films], details["scene_means"].get("mse", {}).get(method, {})
    worst = sorted(means.items(), key=lambda item: -item[1])[:WORST_SCENES]
    values = {
        "notes": [],
        "parameters": None,
        "manifest": None,
        "details": details,
        "verdict": verdict(metrics, content["scenes"], legend),
        "scores": results.table,
        "parts_and_costs": score_table(metrics, PARTS_AND_COSTS, legend.labels),
        "worst": [(scene, mse, next((name for name in names if name.startswith(scene)), None)) for scene, mse in worst],
        "ours": _spoken(method, legend),
        "glossary": glossary(metrics, legend),
        "sets": others,
        "errors": svg(error_chart(metrics, legend)),
        "reliability": _reliability(details, legend),
        "player": player_data(films) if films else None,
    }
    path = folder / "index.html"
    path.write_text(template("page.html.jinja").render(values | dict(content)), encoding="utf-8")
    return path


def _reliability(details: Mapping[str, Any], legend: Legend) -> Markup | None:
    """Chart of the expected errors on a test set; None if no method predicts them."""
    groups = {row: entry["curve"] for row, entry in details.get("reliability", {}).items()}
    curves = {row: known for row, curve in groups.items() if (known := [one for one in curve if min(one[:2]) > 0])}
    return svg(reliability_chart(curves, legend)) if curves else None


def verdict(metrics: Scores, scenes: str, legend: Legend) -> str:
    """One sentence: the error of ours on `scenes`, beside the best other method of its camera and the oracle mean."""
    method = _judged(metrics)
    mse = metrics[method]["mse"]
    start = f"{_spoken(method, legend)} recovers DoLP with a mean squared error of {mse:.4f} on {scenes}"
    parts = []
    own = OWN if method in OWN else (method,)
    rivals = [row for row in with_structure(metrics) if row not in own and not is_rotating(row)]
    if rival := min(rivals, key=lambda row: metrics[row]["mse"], default=None):
        parts.append(
            f"{_against(mse, metrics[rival]['mse'])} the best other method of this camera ({legend.label(rival)})"
        )
    if (oracle := metrics.get("oracle_mean", {}).get("mse")) and method != "oracle_mean":
        parts.append(f"{_against(mse, oracle)} the oracle mean, which needs the truth")
    return start + (f": {' and '.join(parts)}." if parts else ".")


def _in_words(scenes: Sequence[str], noun: str, generated: Collection[str] = ()) -> str:
    """Number of scenes, and of those that no camera took."""
    count, made = len(scenes), len({*scenes} & {*generated})
    return f"{count} {noun}{'' if count == 1 else 's'}" + (f", {made} of them generated" if made else "")


def _spoken(method: str, legend: Legend) -> str:
    """Label for a sentence, with a capital and without the row's key."""
    label = legend.label(method).removeprefix("ours: ")
    return label[:1].upper() + label[1:]


def _against(mse: float, other: float) -> str:
    change = round(100 * (mse / other - 1)) if other else 0
    return f"{abs(change)}\N{NO-BREAK SPACE}% {'lower' if change < 0 else 'higher'} than" if change else "the same as"


def _judged(metrics: Scores) -> str:
    """Ours, else the method with the lowest MSE, else the best reference."""
    rows = [OURS] if OURS in metrics else with_structure(metrics) or in_order(metrics)
    return min(rows, key=lambda row: metrics[row]["mse"])


def _training(folder: Path, name: str) -> tuple[str, str, int, int, str]:
    """Row of the table of trainings: the row of the benchmark, network, epochs, and best epoch with its PSNR."""
    rows, network = read_history(folder / name), json.loads((folder / name / "best.json").read_text())["network"]
    best = best_row(rows)
    return LABELS[name], network_label(network), len(rows), rows.index(best) + 1, f"{best['val']['psnr']:.2f}"


def _as_yaml(values: Mapping[str, Any]) -> str:
    """Parameters as they stand in params.yaml."""
    text, yaml = io.StringIO(), YAML()
    yaml.default_flow_style = False
    yaml.dump(dict(values), text)
    return text.getvalue()
