"""data/report/index.html: one self-contained page with everything that a run showed."""

import base64
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import UInt8
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from polarnet.reports.artefacts import Artefacts, History, Panel, ReportPaths, read_artefacts
from polarnet.reports.figures import (
    DARK,
    LIGHT,
    PanelScene,
    Theme,
    comparison_panel,
    dolp_bar,
    png,
    score_distribution,
    score_line,
    training_curves,
)
from polarnet.reports.maps import (
    dolp_image,
    encode_jpeg,
    encode_png,
    event_full_scale,
    event_image,
    hue_wheel,
    intensity_image,
    polarization_hsv,
)
from polarnet.reports.overview import overview_figure
from polarnet.reports.provenance import Run
from polarnet.reports.tables import (
    COLUMNS,
    ERROR_PARTS,
    METHODS,
    PAPER_COMPARABILITY,
    PAPER_SOURCE,
    TRIVIAL,
    Scores,
    in_order,
    paper_table,
    score_table,
    standing,
)
from polarnet.simulation.pictures.manifest import SPLITS
from polarnet.stokes import POLARIZER_ANGLES_DEG

CARDS = {
    "psnr": "PSNR, ours",
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
MOST_EVENT_ROWS = 2
DISTRIBUTION_METRICS = ("mse", "psnr", "ssim", "corr")


class Card(NamedTuple):
    """A score at the top of the page."""

    label: str
    value: str
    rivals: str


class Tile(NamedTuple):
    """A picture with what stands below it."""

    source: str
    label: str
    detail: str = ""


class Chart(NamedTuple):
    """A figure drawn for a light and for a dark page."""

    light: str
    dark: str
    alt: str


class TileRow(NamedTuple):
    """Pictures of one scene or split."""

    name: str
    tiles: Sequence[Tile]
    more: int = 0
    """Pictures that are left out."""


def write_report(paths: ReportPaths, run: Run, folder: Path) -> Path:
    """Write index.html, and beside it the pictures worth keeping on their own: overview.png and comparison.png.

    The page needs no other file and no network. FileNotFoundError that names what is missing and the stage to run.
    """
    artefacts = read_artefacts(paths)
    folder.mkdir(parents=True, exist_ok=True)
    overview = None
    if artefacts.overview is not None:
        overview = png(overview_figure(artefacts.overview))
        (folder / "overview.png").write_bytes(overview)
    if artefacts.panels:
        rows = [PanelScene(panel.sequence, panel.events, panel.truth_dolp, panel.dolp) for panel in artefacts.panels]
        comparison_panel(rows, folder / "comparison.png")
    environment = Environment(
        loader=PackageLoader("polarnet.reports", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    page = environment.get_template("page.html.jinja").render(_context(artefacts, run, overview))
    path = folder / "index.html"
    path.write_text(page, encoding="utf-8")
    return path


def _context(artefacts: Artefacts, run: Run, overview: bytes | None) -> dict[str, Any]:
    metrics, details, manifest = artefacts.metrics, artefacts.details, artefacts.manifest
    return {
        "metrics": metrics,
        "cards": _cards(metrics),
        "details": details,
        "overview": None if overview is None else _data_uri(overview, "png"),
        "overview_name": None if artefacts.overview is None else artefacts.overview.name,
        "scores": score_table(metrics, artefacts.lpips_reason),
        "error_parts": score_table(metrics, columns=ERROR_PARTS),
        "paper_simulated": paper_table("simulated"),
        "paper_real": paper_table("real"),
        "paper_source": PAPER_SOURCE,
        "comparability": PAPER_COMPARABILITY,
        "standing": standing(metrics),
        "distribution": _distribution(details["scene_means"]),
        "dolp_bar": _chart(dolp_bar, "colour bar of DoLP from 0 to 1"),
        "wheel": _data_uri(encode_png(hue_wheel(192)), "png"),
        "panels": [TileRow(panel.sequence, _panel_tiles(panel)) for panel in artefacts.panels],
        "polarization": [TileRow(panel.sequence, _polarization_tiles(panel)) for panel in artefacts.panels],
        "events": [TileRow(panel.sequence, _event_tiles(panel)) for panel in artefacts.panels[:MOST_EVENT_ROWS]],
        "rates": artefacts.rates,
        "training": {
            "The DoLP network": _training(artefacts.ours),
            "E2V, events to intensity": _training(artefacts.e2v),
        },
        "ours_has_aolp": any("ours" in panel.aolp for panel in artefacts.panels),
        "manifest": manifest,
        "source_names": SOURCE_NAMES,
        "sources": Counter(entry.source for entry in manifest.pictures),
        "splits": [_thumbnails(artefacts, split) for split in SPLITS],
        "run": run,
        "sections": _sections(run.parameters),
    }


def _cards(metrics: Scores) -> list[Card]:
    """The network's scores, each with what it has to beat."""
    if "ours" not in metrics:
        return []
    cards = []
    for key, label in CARDS.items():
        column = COLUMNS[key]
        others = [m for m in ("e2vid", "firenet", "oracle_mean" if column.ranked else "cf") if m in metrics]
        rivals = [f"{METHODS[m]} {column.printed(metrics[m][key])}" for m in others]
        cards.append(Card(label, column.printed(metrics["ours"][key]) + column.unit, ", ".join(rivals)))
    return cards


def _panel_tiles(panel: Panel) -> list[Tile]:
    """Events, truth, and every method that is not a constant."""
    full_scale = event_full_scale(panel.events)
    tiles = [
        _tile(event_image(panel.events[0], full_scale), "events, 0°", f"{panel.t_us / 1000:.0f} ms"),
        _tile(dolp_image(panel.truth_dolp), "truth"),
    ]
    methods = [method for method in in_order(panel.dolp) if method not in TRIVIAL]
    return tiles + [
        _tile(
            dolp_image(panel.dolp[method]),
            METHODS.get(method, method),
            score_line(panel.dolp[method], panel.truth_dolp),
        )
        for method in methods
    ]


def _polarization_tiles(panel: Panel) -> list[Tile]:
    """The truth's S0, DoLP and AoLP, alone and as one colour picture; then every method that has AoLP, lit by S0."""
    ones, s0 = torch.ones_like(panel.truth_s0), panel.truth_s0
    tiles = [
        _tile(intensity_image(s0), "true S0"),
        _tile(dolp_image(panel.truth_dolp), "true DoLP"),
        _tile(polarization_hsv(ones, ones, panel.truth_aolp), "true AoLP"),
        _tile(polarization_hsv(s0, panel.truth_dolp, panel.truth_aolp), "truth"),
    ]
    return tiles + [
        _tile(polarization_hsv(s0, panel.dolp[method], panel.aolp[method]), METHODS.get(method, method), "with true S0")
        for method in in_order(panel.aolp)
    ]


def _event_tiles(panel: Panel) -> list[Tile]:
    full_scale = event_full_scale(panel.events)
    return [
        _tile(event_image(events, full_scale), f"{angle}°")
        for events, angle in zip(panel.events, POLARIZER_ANGLES_DEG, strict=True)
    ]


def _thumbnails(artefacts: Artefacts, split: str) -> TileRow:
    thumbnails = artefacts.thumbnails[split]
    tiles = [Tile(_data_uri(encode_jpeg(picture), "jpeg"), name) for name, picture in thumbnails]
    return TileRow(split, tiles, artefacts.manifest.counts[split] - len(tiles))


def _distribution(scene_means: Mapping[str, Mapping[str, Mapping[str, float]]]) -> Chart:
    shown = {
        metric: {method: list(scenes.values()) for method, scenes in scene_means[metric].items()}
        for metric in DISTRIBUTION_METRICS
        if metric in scene_means
    }
    return _chart(lambda theme: score_distribution(shown, theme), "scores of each method, a dot a scene")


def _training(history: History) -> dict[str, Any]:
    validation = [history.validation["psnr"]]
    chart = _chart(
        lambda theme: training_curves(history.loss, validation, "validation PSNR, dB", theme),
        "training loss and validation PSNR over epochs",
    )
    return {
        "chart": chart,
        "epochs": len(history.loss[0].epochs),
        "best_epoch": history.best_epoch + 1,
        "best_psnr": history.validation["psnr"].values[history.best_epoch],
    }


def _sections(parameters: Mapping[str, Any]) -> dict[str, list[tuple[str, Any]]]:
    """Dotted keys and values by the top-level section they belong to; single values together, under general."""
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


def _chart(draw: Callable[[Theme], Figure], alt: str) -> Chart:
    light, dark = (_data_uri(png(draw(theme)), "png") for theme in (LIGHT, DARK))
    return Chart(light, dark, alt)


def _tile(picture: UInt8[np.ndarray, "h w 3"], label: str, detail: str = "") -> Tile:
    return Tile(_data_uri(encode_png(picture), "png"), label, detail)


def _data_uri(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
