"""Pictures of a page: benchmark panels as rows of tiles, and figures for light and dark themes."""

import base64
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import UInt8
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from matplotlib.figure import Figure

from polarnet.reports.artefacts import Panel
from polarnet.reports.figures import DARK, LIGHT, Theme, reliability_figure, score_distribution, score_line
from polarnet.reports.legend import Legend, in_order, with_structure
from polarnet.reports.maps import (
    dolp_image,
    encode_png,
    event_full_scale,
    event_image,
    intensity_image,
    paper_map,
    png,
    polarization_hsv,
)
from polarnet.stokes import POLARIZER_ANGLES_DEG

DISTRIBUTION_METRICS = ("mse", "psnr", "ssim", "corr")


class Tile(NamedTuple):
    """A picture with the text below it."""

    source: str
    label: str
    detail: str = ""


class Chart(NamedTuple):
    """A figure in two versions, for a light and a dark page."""

    light: str
    dark: str
    alt: str


class TileRow(NamedTuple):
    """Pictures of one scene or split."""

    name: str
    tiles: Sequence[Tile]
    more: int = 0
    """Number of pictures left out."""


def panel_tiles(panel: Panel, legend: Legend) -> list[Tile]:
    """Tiles of the events, the truth, and every method that is not a constant."""
    full_scale = event_full_scale(panel.events)
    tiles = [
        tile(event_image(panel.events[0], full_scale), "events, 0°", f"{panel.t_us / 1000:.0f} ms"),
        tile(dolp_image(panel.truth_dolp), "truth"),
    ]
    methods = with_structure(panel.dolp)
    return tiles + [
        tile(
            dolp_image(panel.dolp[method]),
            legend.label(method),
            score_line(panel.dolp[method], panel.truth_dolp),
        )
        for method in methods
    ]


def polarization_tiles(panel: Panel, legend: Legend) -> list[Tile]:
    """Tiles of the true S0, DoLP and AoLP, alone and in the two colour maps; then methods with AoLP, at the true S0."""
    ones, s0 = torch.ones_like(panel.truth_s0), panel.truth_s0
    tiles = [
        tile(intensity_image(s0), "true S0"),
        tile(dolp_image(panel.truth_dolp), "true DoLP"),
        tile(polarization_hsv(ones, ones, panel.truth_aolp), "true AoLP"),
        tile(paper_map(panel.truth_dolp, panel.truth_aolp), "truth, S = 1", "as the paper's Fig. 3"),
        tile(polarization_hsv(s0, panel.truth_dolp, panel.truth_aolp), "truth"),
    ]
    return tiles + [
        tile(polarization_hsv(s0, panel.dolp[method], panel.aolp[method]), legend.label(method), "with true S0")
        for method in in_order(panel.aolp)
    ]


def event_tiles(panel: Panel) -> list[Tile]:
    """Tiles of the window's events in each channel, on one scale."""
    full_scale = event_full_scale(panel.events)
    return [
        tile(event_image(events, full_scale), f"{angle}°")
        for events, angle in zip(panel.events, POLARIZER_ANGLES_DEG, strict=True)
    ]


def reliability_chart(details: Mapping[str, Any], legend: Legend) -> Chart | None:
    """Reliability of the methods in details.json that predict their error; None if there are none."""
    curves = {
        method: [(predicted, measured, pixels) for predicted, measured, pixels in entry["curve"]]
        for method, entry in details.get("reliability", {}).items()
    }
    if not curves:
        return None
    return chart(
        lambda theme: reliability_figure(curves, theme, legend), "measured against predicted squared error of DoLP"
    )


def distribution(scene_means: Mapping[str, Mapping[str, Mapping[str, float]]], legend: Legend) -> Chart:
    """Scores of every scene in a test set; `scene_means` is metric, then method, then scene."""
    scores = {
        metric: {method: list(scenes.values()) for method, scenes in scene_means[metric].items()}
        for metric in DISTRIBUTION_METRICS
        if metric in scene_means
    }
    return chart(lambda theme: score_distribution(scores, theme, legend), "scores of each method, a dot a scene")


def chart(draw: Callable[[Theme], Figure], alt: str) -> Chart:
    """Draw a figure for both themes, embedded in the page."""
    light, dark = (data_uri(png(draw(theme)), "png") for theme in (LIGHT, DARK))
    return Chart(light, dark, alt)


def tile(picture: UInt8[np.ndarray, "h w 3"], label: str, detail: str = "") -> Tile:
    """A tile with its picture embedded in the page."""
    return Tile(data_uri(encode_png(picture), "png"), label, detail)


def data_uri(content: bytes, kind: str) -> str:
    """Encode a picture file's content as a data URI."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def template(name: str) -> Template:
    """Load a page template of this package: every value is escaped, and a missing value is an error."""
    environment = Environment(
        loader=PackageLoader("polarnet.reports", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template(name)
