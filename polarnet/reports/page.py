"""Self-contained HTML pages: the report of a pipeline run, and the page of one test set (`polarnet benchmark`)."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from polarnet.methods import METHODS
from polarnet.pictures.manifest import SPLITS
from polarnet.reports.artefacts import Artefacts, History, ReportPaths, Results, read_artefacts, read_results
from polarnet.reports.figures import comparison_figure, dolp_bar, training_curves, wheel_figure
from polarnet.reports.legend import (
    LABELS,
    NAMED_BY_NETWORK,
    Legend,
    glossary,
    legend_of,
    lpips_about,
    network_label,
)
from polarnet.reports.maps import encode_jpeg, png
from polarnet.reports.overview import overview_figure
from polarnet.reports.paper import write_paper_files
from polarnet.reports.provenance import Run
from polarnet.reports.tables import (
    COLUMNS,
    COSTS,
    ERROR_PARTS,
    SET_TITLES,
    Scores,
    paired_lines,
    paper_table,
    score_table,
    standing,
)
from polarnet.reports.tiles import (
    Tile,
    TileRow,
    chart,
    data_uri,
    distribution,
    event_tiles,
    panel_tiles,
    polarization_tiles,
    reliability_chart,
    template,
)

CARDS = {
    "psnr": "PSNR",
    "mse": "MSE",
    "ssim": "SSIM",
    "corr": "correlation",
    "ms_per_window": "time per window",
}
SOURCE_NAMES = {
    "photograph": "photographs",
    "dead_leaves": "generated dead leaves",
    "folder": "of your own",
    "polarization": "of measured polarization",
}
MAX_EVENT_ROWS = 2
SET_ABOUT = {
    "complex_motion": "The same held-out pictures while the camera turns, zooms and moves faster (section sets).",
    "measured": "Scenes whose polarization a camera measured, seen by a simulated event camera: real DoLP and AoLP, "
    "simulated events.",
    "recordings": "Captures of real targets (paper, section 4): real events, DoLP from pictures of the same camera.",
}


class Card(NamedTuple):
    """A score at the top of the page."""

    label: str
    value: str
    rivals: str


def write_report(paths: ReportPaths, baselines: Sequence[str], run: Run, folder: Path) -> Path:
    """Write index.html and, beside it, overview.png, comparison.png and the folder paper; `baselines` were trained.

    The folder holds the paper's Table 2 and figures 9 and 10 (`polarnet.reports.paper`). The page needs no other file
    and no network. FileNotFoundError names missing artefacts and the stage to run.
    """
    artefacts = read_artefacts(paths, baselines)
    legend = legend_of(artefacts.results.details["weights"])
    folder.mkdir(parents=True, exist_ok=True)
    write_paper_files(folder / "paper", [artefacts.results, *artefacts.sets], legend)
    overview = None
    if artefacts.overview is not None:
        overview = png(overview_figure(artefacts.overview))
        (folder / "overview.png").write_bytes(overview)
    context = _context(artefacts, legend) | {
        "run": run,
        "sections": _sections(run.parameters),
        "overview": None if overview is None else data_uri(overview, "png"),
    }
    return _write_page(folder, "page.html.jinja", artefacts.results, legend, context)


def write_set_page(folder: Path, title: str, command: str, notes: Sequence[str]) -> Path:
    """Write index.html and comparison.png beside the metrics.json, details.json and panels of one test set.

    `notes` are sentences for the reader of the table, such as the methods that did not run and the reasons.
    """
    results = read_results(folder)
    legend = legend_of(results.details["weights"])
    context = {"title": title, "command": command, "notes": notes, "labels": legend.labels}
    return _write_page(folder, "set.html.jinja", results, legend, _results_context(results, legend) | context)


def _write_page(folder: Path, name: str, results: Results, legend: Legend, context: Mapping[str, Any]) -> Path:
    """Fill a template into index.html, and write the panels as comparison.png; no such file without panels."""
    if results.panels:
        figure = comparison_figure(results.panels, results.panels[0].dolp, legend)
        (folder / "comparison.png").write_bytes(png(figure))
    path = folder / "index.html"
    path.write_text(template(name).render(context), encoding="utf-8")
    return path


def _results_context(results: Results, legend: Legend) -> dict[str, Any]:
    """Template values of the results on the test set."""
    metrics, details, labels = results.metrics, results.details, legend.labels
    return {
        "metrics": metrics,
        "details": details,
        "scores": score_table(metrics, labels=labels, warmup_windows=details["warmup_windows"]),
        "error_parts": score_table(metrics, columns=ERROR_PARTS, labels=labels),
        "costs": score_table(metrics, columns=COSTS, labels=labels),
        "standing": standing(metrics, labels),
        "paired": paired_lines(details.get("paired", {}), labels=labels),
        "rows": glossary(metrics, details["weights"]),
        "lpips_about": lpips_about(details["lpips"]),
        "paper_simulated": paper_table("simulated"),
        "paper_real": paper_table("real"),
        "distribution": distribution(details["scene_means"], legend),
        "reliability": reliability_chart(details, legend),
        "dolp_bar": chart(dolp_bar, "colour bar of DoLP from 0 to 1"),
        "wheel": chart(wheel_figure, "colour wheel: direction is AoLP, distance from the centre is DoLP"),
        "panels": [TileRow(panel.sequence, panel_tiles(panel, legend)) for panel in results.panels],
        "polarization": [TileRow(panel.sequence, polarization_tiles(panel, legend)) for panel in results.panels],
    }


def _context(artefacts: Artefacts, legend: Legend) -> dict[str, Any]:
    """Template values of a pipeline's data, trainings and results on all test sets."""
    manifest, results = artefacts.manifest, artefacts.results
    context = _results_context(results, legend)
    networks = [("ours: ", artefacts.ours, "DoLP")]
    networks += [_baseline(name, history) for name, history in artefacts.baselines.items()]
    return context | {
        "cards": _cards(results.metrics, legend),
        "overview_name": None if artefacts.overview is None else artefacts.overview.name,
        "sets": [_set(one, legend) for one in artefacts.sets],
        "panels": context["panels"]
        + [
            TileRow(f"{SET_TITLES.get(one.name, one.name)}: {panel.sequence}", panel_tiles(panel, legend))
            for one in artefacts.sets
            for panel in one.panels
        ],
        "events": [TileRow(panel.sequence, event_tiles(panel)) for panel in results.panels[:MAX_EVENT_ROWS]],
        "rates": artefacts.rates,
        "training": {
            f"{row}{network_label(history.network)}, events to {output}": _training(history, output)
            for row, history, output in networks
        },
        "ours": legend.labels["ours"],
        "ours_has_aolp": any("ours" in panel.aolp for panel in results.panels),
        "manifest": manifest,
        "source_names": SOURCE_NAMES,
        "sources": Counter(entry.source for entry in manifest.pictures),
        "splits": [_thumbnails(artefacts, split) for split in SPLITS],
    }


def _set(one: Results, legend: Legend) -> dict[str, Any]:
    """Template values of a test set other than the simulated one."""
    return {
        "title": SET_TITLES.get(one.name, one.name),
        "about": SET_ABOUT.get(one.name, ""),
        "scenes": len(one.details["scenes"]),
        "frames": one.details["frames"],
        "scores": score_table(one.metrics, labels=legend.labels, warmup_windows=one.details["warmup_windows"]),
    }


def _cards(metrics: Scores, legend: Legend) -> list[Card]:
    """The network's scores, each with those of its rivals."""
    if "ours" not in metrics:
        return []
    cards = []
    for key, label in CARDS.items():
        column = COLUMNS[key]
        others = [m for m in ("e2v", "oracle_mean" if column.ranked else "cf") if m in metrics]
        rivals = [f"{legend.label(m)} {column.printed(metrics[m][key])}" for m in others]
        cards.append(Card(label, column.printed(metrics["ours"][key]) + column.unit, ", ".join(rivals)))
    return cards


def _thumbnails(artefacts: Artefacts, split: str) -> TileRow:
    tiles = [Tile(data_uri(encode_jpeg(small), "jpeg"), name) for name, small in artefacts.thumbnails[split].items()]
    return TileRow(split, tiles, artefacts.manifest.counts[split] - len(tiles))


def _baseline(name: str, history: History) -> tuple[str, History, str]:
    """Row (if its label does not name the network), training and output of a trained baseline."""
    row = f"{LABELS[name]}: " if name in NAMED_BY_NETWORK else ""
    return row, history, "intensity" if METHODS[name].reconstructs else "polarization"


def _training(history: History, output: str) -> dict[str, Any]:
    psnr = history.validation["psnr"]
    curves = chart(
        lambda theme: training_curves(history.loss, psnr, f"validation PSNR of {output}, dB", theme),
        "training loss and validation PSNR over epochs",
    )
    return {
        "chart": curves,
        "epochs": len(psnr),
        "best_epoch": history.best_epoch + 1,
        "of": output,
        "best_psnr": psnr[history.best_epoch],
    }


def _sections(parameters: Mapping[str, Any]) -> dict[str, list[tuple[str, Any]]]:
    """Dotted keys and values by top-level section; single values are under general."""
    sections: dict[str, list[tuple[str, Any]]] = {"general": []}
    for key, value in _flat(parameters):
        section, dot, _ = key.partition(".")
        sections.setdefault(section if dot else "general", []).append((key, value))
    return sections


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
