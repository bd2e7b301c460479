"""data/report/index.html: one self-contained page with all results of a run."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from polarnet.methods import METHODS
from polarnet.pictures.manifest import SPLITS
from polarnet.reports.artefacts import Artefacts, History, ReportPaths, SetResults, read_artefacts
from polarnet.reports.figures import training_curves
from polarnet.reports.legend import LABELS, NAMED_BY_NETWORK, Legend, legend_of, network_label
from polarnet.reports.maps import encode_jpeg, png
from polarnet.reports.overview import overview_figure
from polarnet.reports.provenance import Run
from polarnet.reports.results import results_context, write_comparison
from polarnet.reports.tables import COLUMNS, SET_TITLES, Scores, score_table
from polarnet.reports.tiles import Tile, TileRow, chart, data_uri, event_tiles, panel_tiles, template

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
    """Write index.html and, beside it, overview.png and comparison.png; `baselines` are those trained for the run.

    The page needs no other file and no network. FileNotFoundError names missing artefacts and the stage to run.
    """
    artefacts = read_artefacts(paths, baselines)
    legend = legend_of(artefacts.details["weights"])
    folder.mkdir(parents=True, exist_ok=True)
    overview = None
    if artefacts.overview is not None:
        overview = png(overview_figure(artefacts.overview))
        (folder / "overview.png").write_bytes(overview)
    write_comparison(folder / "comparison.png", artefacts, legend)
    page = template("page.html.jinja").render(_context(artefacts, run, overview, legend))
    path = folder / "index.html"
    path.write_text(page, encoding="utf-8")
    return path


def _context(artefacts: Artefacts, run: Run, overview: bytes | None, legend: Legend) -> dict[str, Any]:
    manifest, context = artefacts.manifest, results_context(artefacts, legend)
    return {
        **context,
        "cards": _cards(artefacts.metrics, legend),
        "overview": None if overview is None else data_uri(overview, "png"),
        "overview_name": None if artefacts.overview is None else artefacts.overview.name,
        "sets": [_set(one, legend) for one in artefacts.sets],
        "panels": context["panels"]
        + [
            TileRow(f"{SET_TITLES.get(one.name, one.name)}: {panel.sequence}", panel_tiles(panel, legend))
            for one in artefacts.sets
            for panel in one.panels
        ],
        "events": [TileRow(panel.sequence, event_tiles(panel)) for panel in artefacts.panels[:MAX_EVENT_ROWS]],
        "rates": artefacts.rates,
        "training": {
            f"{row}{network_label(history.network)}, events to {of}": _training(history, of)
            for row, history, of in (
                ("ours: ", artefacts.ours, "DoLP"),
                *(_baseline(name, history) for name, history in artefacts.baselines.items()),
            )
        },
        "ours": legend.labels["ours"],
        "ours_has_aolp": any("ours" in panel.aolp for panel in artefacts.panels),
        "manifest": manifest,
        "source_names": SOURCE_NAMES,
        "sources": Counter(entry.source for entry in manifest.pictures),
        "splits": [_thumbnails(artefacts, split) for split in SPLITS],
        "run": run,
        "sections": _sections(run.parameters),
    }


def _set(one: SetResults, legend: Legend) -> dict[str, Any]:
    """Template values of a test set other than the simulated one."""
    return {
        "title": SET_TITLES.get(one.name, one.name),
        "about": SET_ABOUT.get(one.name, ""),
        "scenes": len(one.details["scenes"]),
        "frames": one.details["frames"],
        "scores": score_table(one.metrics, labels=legend.labels),
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
    thumbnails = artefacts.thumbnails[split]
    tiles = [Tile(data_uri(encode_jpeg(picture), "jpeg"), name) for name, picture in thumbnails]
    return TileRow(split, tiles, artefacts.manifest.counts[split] - len(tiles))


def _baseline(name: str, history: History) -> tuple[str, History, str]:
    """Row (if its label does not name the network), training and output of a trained baseline."""
    row = f"{LABELS[name]}: " if name in NAMED_BY_NETWORK else ""
    return row, history, "intensity" if METHODS[name].reconstructs else "polarization"


def _training(history: History, of: str) -> dict[str, Any]:
    validation = [history.validation["psnr"]]
    curves = chart(
        lambda theme: training_curves(history.loss, validation, f"validation PSNR of {of}, dB", theme),
        "training loss and validation PSNR over epochs",
    )
    return {
        "chart": curves,
        "epochs": len(history.loss[0].epochs),
        "best_epoch": history.best_epoch + 1,
        "of": of,
        "best_psnr": history.validation["psnr"].values[history.best_epoch],
    }


def _sections(parameters: Mapping[str, Any]) -> dict[str, list[tuple[str, Any]]]:
    """Dotted keys and values by top-level section; single values are under general."""
    sections: dict[str, list[tuple[str, Any]]] = {"general": []}
    for name, value in parameters.items():
        if isinstance(value, Mapping):
            sections[name] = list(_flat(value, name))
        else:
            sections["general"].append((name, value))
    return sections


def _flat(values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}.{name}")
        else:
            yield f"{prefix}.{name}", value
