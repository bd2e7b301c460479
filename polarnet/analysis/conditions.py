"""Size, duration, motion and sensor of simulated sequences, compared with those of a network's training."""

import dataclasses
import functools
import json
from collections.abc import Mapping
from typing import Any

from polarnet.networks.base.checkpoint import nested
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.motion import SynthesizeConfig

NOT_COMPARED = ("synthesize.sequences_per_picture",)
RANDOMISE = "emulate.randomise"
LOW, HIGH = "synthesize.speed_min_px_s", "synthesize.speed_max_px_s"


def conditions(synthesize: SynthesizeConfig, emulate: EmulatorConfig) -> dict[str, Any]:
    """Values by key of params.yaml that sequences are made with."""
    return _keyed(dataclasses.asdict(synthesize), dataclasses.asdict(emulate))


def trained_on(metadata: Mapping[str, Any]) -> dict[str, Any] | None:
    """The same of a training, from the JSON of its checkpoint; None if that does not record them."""
    if "data" not in metadata:
        return None
    size = {f"sensor_{side}": metadata["data"].get(side) for side in ("height", "width")}
    made = functools.partial(nested, metadata, "data", "events_from")
    return _keyed({**made("scenes", "synthesize"), **size}, made("emulate"))


def _keyed(synthesize: Mapping[str, Any], emulate: Mapping[str, Any]) -> dict[str, Any]:
    keyed = {f"synthesize.{key}": value for key, value in synthesize.items()}
    keyed |= {f"emulate.{key}": value for key, value in emulate.items()}
    return {key: value for key, value in keyed.items() if key not in NOT_COMPARED}


def sentence(used: Mapping[str, Any]) -> str:
    """Size, duration, frame rate and pixel model in words."""
    return (
        f"Sequences of {used['synthesize.sensor_height']}x{used['synthesize.sensor_width']} pixels (height x width), "
        f"{used['synthesize.duration_s']:g} s at {used['synthesize.frame_rate_hz']:g} frames a second; "
        f"sensor: model {used['emulate.model']}."
    )


def warnings(used: Mapping[str, Any], checkpoints: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """One warning per training whose sequences differ from `used`, with both values of each such key.

    `checkpoints` maps each row to the metadata of its weights.
    """
    rows: dict[str, list[str]] = {}
    for row, metadata in checkpoints.items():
        rows.setdefault(_warning(used, trained_on(metadata)), []).append(row)
    return [f"{', '.join(of)}: {text}" for text, of in rows.items() if text]


def _warning(used: Mapping[str, Any], trained: Mapping[str, Any] | None) -> str:
    if trained is None:
        return "the checkpoint does not say what it was trained on, so size and sensor were not compared."
    drawn = {f"emulate.{name}": values for name, values in (trained.get(RANDOMISE) or {}).items()}
    there = {**trained, **drawn}
    if drawn and not used[RANDOMISE]:  # one sensor, against those that the training drew
        del there[RANDOMISE]
    random_here = {f"emulate.{name}" for name in used[RANDOMISE] or {}}
    slower = {LOW, HIGH} <= there.keys() and there[LOW] <= used[LOW] and used[HIGH] <= there[HIGH]
    different = [
        key
        for key, value in there.items()
        if key in used.keys() - random_here
        and not (_among(used[key], drawn[key]) if key in drawn else used[key] == value)
        and not (slower and key in (LOW, HIGH))
    ]
    if not different:
        return ""
    both = ", ".join(f"{key} {json.dumps(used[key])} (training: {json.dumps(there[key])})" for key in different)
    return (
        f"these sequences differ from those of its training: {both}. Give the training's values as KEY=VALUE, or in "
        f"params.yaml, to score on sequences like those."
    )


def _among(value: float | str | None, drawn: list[Any]) -> bool:
    """Whether a training that drew from names, or from a range with these ends, drew values like this one."""
    return value in drawn if value is None or isinstance(value, str) else min(drawn) <= value <= max(drawn)
