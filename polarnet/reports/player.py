"""The player of the pages: films of scenes as image strips inside the page, which player.js colours and plays.

A strip stacks a map's frames as one grey WebP, so that the page knows values, not colours. AoLP is stored as cosine and
sine of twice the angle, because a lossy picture of the angle itself would blur the jump from 180 to 0 degrees.
"""

import base64
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import matplotlib
import numpy as np
import torch
from jaxtyping import UInt8
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from torch import Tensor

from polarnet.reports.legend import Legend, with_structure
from polarnet.reports.maps import AOLP_TABLE, DOLP_TABLE, EVENT_TABLE, event_full_scale, table_of
from polarnet.runtime.files import replaced
from polarnet.storage.panels import NO_EVENTS, Panel, angle_bytes, fraction_bytes, signed_bytes
from polarnet.terminal.progress import ProgressBar

Kind = Literal["events", "s0", "dolp", "aolp"]

MAX_SIDE = 320  # pixels of a map's longer side; larger maps are reduced
MAX_FRAMES = 24  # with two maps a frame, MAX_SIDE * MAX_FRAMES stays below the 16,383 rows of a WebP
MAX_STRIP_BYTES = 28_000_000  # of all strips: a page with charts and tables stays below 30 MB
QUALITY: Mapping[Kind, int] = {"events": 50, "s0": 60, "dolp": 55, "aolp": 20}
TRUTH = "truth"
TO_BYTES: Mapping[Kind, Callable[[Tensor], Tensor]] = {
    "events": signed_bytes, "s0": fraction_bytes, "dolp": fraction_bytes, "aolp": angle_bytes,
}  # fmt: skip
"""From the values of a quantity to the bytes of its maps."""

COLOURS = {
    "events": EVENT_TABLE,
    "s0": table_of(matplotlib.colormaps["gray"]),
    "dolp": DOLP_TABLE,
    "aolp": AOLP_TABLE,
    "error": table_of(matplotlib.colormaps["magma"]),
}


def template(name: str) -> Template:
    """Load a page template of this package: every value is escaped, and a missing value is an error."""
    environment = Environment(
        loader=PackageLoader("polarnet.reports", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment.get_template(name)


class Map(NamedTuple):
    """One quantity of a scene over its frames."""

    source: str  # label of its origin: a method, the truth, or a recording
    kind: Kind
    frames: UInt8[np.ndarray, "n h w"]  # bytes in the steps of `polarnet.storage.panels`


class Film(NamedTuple):
    """A scene of the player."""

    name: str
    t_us: Sequence[int]
    maps: Sequence[Map]


def panel_film(panel: Panel, legend: Legend, title: str = "") -> Film:
    """The film of a benchmark's panel: events, truth, ours, and the other methods that are no constants."""
    methods = sorted(with_structure(panel.predictions), key=lambda method: method != "ours")
    sources = [(TRUTH, panel.truth), *((legend.label(method), panel.predictions[method]) for method in methods)]
    maps = [Map("Events", "events", panel.film_events.numpy()), Map(TRUTH, "s0", panel.film_s0.numpy())]
    for source, shown in sources:
        films: dict[Kind, Tensor | None] = {"aolp": shown.film_aolp, "dolp": shown.film_dolp}
        maps += [Map(source, kind, film.numpy()) for kind, film in films.items() if film is not None]
    return Film(f"{title}: {panel.sequence}" if title else panel.sequence, panel.film_t_us.tolist(), maps)


def player_data(films: Sequence[Film]) -> dict[str, Any]:
    """Content of the player's JSON: colour tables and scenes with their strips."""
    size_of_two = sum(len(one["strip"]) for film in films for one in _scene(film, 2)["maps"])
    frames = min(MAX_FRAMES, max(1, 2 * MAX_STRIP_BYTES // max(1, size_of_two)))
    return {
        "colours": {name: table.tobytes().hex() for name, table in COLOURS.items()},
        "scenes": [_scene(film, frames) for film in ProgressBar(films, "page", unit="scene")],
    }


def write_player(
    path: Path,
    title: str,
    films: Sequence[Film],
    facts: Mapping[str, str],
    notes: Sequence[str] = (),
    video: str | None = None,
) -> Path:
    """Write a page with the player, and below it `facts`; `video` names a file beside the page."""
    player = player_data(films)
    page = template("viewer.html.jinja").render(title=title, player=player, facts=facts, notes=notes, video=video)
    with replaced(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path


def _scene(film: Film, frames: int) -> dict[str, Any]:
    chosen = np.unique(np.linspace(0, len(film.t_us) - 1, min(frames, len(film.t_us))).round().astype(int))
    maps = [(one, _reduced(one.frames[chosen], one.kind)) for one in film.maps]
    height, width = maps[0][1].shape[1:]
    return {
        "name": film.name,
        "ms": [round(film.t_us[k] / 1000, 1) for k in chosen],
        "height": height,
        "width": width,
        "rows": film.maps[0].frames.shape[1],  # of the sensor, for coordinates
        "maps": [{"source": one.source, "kind": one.kind, **_strip(frames, one.kind)} for one, frames in maps],
    }


def _strip(frames: UInt8[np.ndarray, "n h w"], kind: Kind) -> dict[str, Any]:
    """`strip`: data URI; for events `scale`: count at full scale."""
    about: dict[str, Any] = {}
    if kind == "events":
        signed = frames.astype(np.float32) - NO_EVENTS
        about["scale"] = event_full_scale(torch.from_numpy(signed))
        frames = _bytes(127 * (signed / about["scale"]).clip(-1, 1) + NO_EVENTS)
    if kind == "aolp":
        doubled = frames.astype(np.float32) * (2 * np.pi / 256)
        frames = np.concatenate([_bytes(127 * wave(doubled) + 128) for wave in (np.cos, np.sin)])
    rows = np.concatenate([*frames])
    done, data = cv2.imencode(".webp", rows, [cv2.IMWRITE_WEBP_QUALITY, QUALITY[kind]])
    assert done, f"OpenCV could not encode a strip of {frames.shape}"
    return {**about, "strip": f"data:image/webp;base64,{base64.b64encode(data.tobytes()).decode()}"}


def _reduced(frames: UInt8[np.ndarray, "n h w"], kind: Kind) -> UInt8[np.ndarray, "n h2 w2"]:
    height, width = frames.shape[1:]
    factor = MAX_SIDE / max(height, width)
    if factor >= 1:
        return frames
    method = cv2.INTER_NEAREST if kind == "aolp" else cv2.INTER_AREA  # angles have no plain mean
    size = (round(width * factor), round(height * factor))
    return np.stack([cv2.resize(frame, size, interpolation=method) for frame in frames])


def _bytes(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    return values.round().astype(np.uint8)
