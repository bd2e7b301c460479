"""Panels of the benchmark: one window of a test sequence and a film of others, as a file SEQUENCE.npz.

A film is for a page to play, so it holds bytes: fractions, angles and signed event counts.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

NO_EVENTS = 128
"""Byte of a pixel with as many ON as OFF events."""


class Shown(NamedTuple):
    """DoLP and AoLP of the truth or of a row, at the window of a panel and over its film."""

    dolp: Float[Tensor, "h w"]
    aolp: Float[Tensor, "h w"] | None
    """None if the row predicts no angle; `film_aolp` likewise."""
    film_dolp: UInt8[Tensor, "n h w"]
    film_aolp: UInt8[Tensor, "n h w"] | None


@dataclass(frozen=True)
class Panel:
    """One window of one sequence, and a film of windows spread over its scored ones."""

    sequence: str
    window: int
    t_us: int
    """End of the window."""
    events: Float[Tensor, "4 h w"]
    """Event tensors (Eq. 5) of the window."""
    s0: Float[Tensor, "h w"]
    film_t_us: Int64[Tensor, " n"]
    film_events: UInt8[Tensor, "n h w"]
    """ON minus OFF events of the four channels (`signed_bytes`)."""
    film_s0: UInt8[Tensor, "n h w"]
    truth: Shown
    predictions: Mapping[str, Shown]
    """Prediction by row."""


MAPS = ("events", "s0", "film_t_us", "film_events", "film_s0")


def write_panel(folder: Path, panel: Panel) -> None:
    """Write the panel as SEQUENCE.npz."""
    shown = [panel.truth, *panel.predictions.values()]
    arrays: dict[str, Any] = {}
    for name, maps in zip(Shown._fields, zip(*shown, strict=True), strict=True):
        arrays[name] = torch.stack([one for one in maps if one is not None]).numpy()
    np.savez_compressed(
        folder / f"{panel.sequence}.npz",
        window=np.int64(panel.window),
        t_us=np.int64(panel.t_us),
        rows=np.array([*panel.predictions], dtype=np.str_),
        with_aolp=np.array([one.aolp is not None for one in shown]),
        **arrays,
        **{name: getattr(panel, name).numpy() for name in MAPS},
    )


def read_panel(path: Path) -> Panel:
    """Read a file of `write_panel`."""
    with np.load(path) as file:
        names, with_aolp = file["rows"].tolist(), file["with_aolp"].tolist()
        maps = {name: torch.from_numpy(file[name]) for name in ("window", "t_us", *Shown._fields, *MAPS)}
    aolp, film_aolp = iter(maps["aolp"]), iter(maps["film_aolp"])
    truth, *predictions = (
        Shown(dolp, next(aolp) if angled else None, film_dolp, next(film_aolp) if angled else None)
        for dolp, film_dolp, angled in zip(maps["dolp"], maps["film_dolp"], with_aolp, strict=True)
    )
    window, t_us, by_row = int(maps["window"]), int(maps["t_us"]), dict(zip(names, predictions, strict=True))
    return Panel(path.stem, window, t_us, **{name: maps[name] for name in MAPS}, truth=truth, predictions=by_row)


def fraction_bytes(fraction: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """DoLP or intensity in steps of 1/255; values outside 0 to 1 are clamped."""
    return (fraction.clamp(0, 1) * 255).round().to(torch.uint8)


def angle_bytes(aolp: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """AoLP in radians, period pi, in steps of pi/256."""
    return (aolp * (256 / math.pi)).round().remainder(256).to(torch.uint8)


def signed_bytes(counts: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """ON minus OFF events, clamped to -127 .. 127, plus `NO_EVENTS`."""
    return (counts.round().clamp(-127, 127) + NO_EVENTS).to(torch.uint8)
