"""Size, duration, motion and sensor of sequences, compared with those of a network's training."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.motion import SynthesizeConfig
from polarnet.simulation.ranges import NAMES

NOT_COMPARED = ("synthesize.sequences_per_picture",)
MODEL_ALONE = {"esim_log_eps": ("esim", "esim_gpu"), "voltmeter_camera": ("dvs_voltmeter",)}
"""Parameters that exist only in the pixel models listed."""
SPEEDS = ("synthesize.speed_min_px_s", "synthesize.speed_max_px_s")


class Conditions(NamedTuple):
    """The sections `synthesize` and `emulate` that sequences were made with; unknown keys are absent."""

    synthesize: Mapping[str, Any]
    emulate: Mapping[str, Any]

    @property
    def values(self) -> dict[str, Any]:
        """Values by full params.yaml key, without the keys that do not affect a network's input."""
        emulate = {
            key: value
            for key, value in self.emulate.items()
            if (key not in MODEL_ALONE or self.emulate["model"] in MODEL_ALONE[key])
            and key not in (self.emulate["randomise"] or {})
        }
        keyed = {f"synthesize.{key}": value for key, value in self.synthesize.items()}
        keyed |= {f"emulate.{key}": value for key, value in emulate.items()}
        return {key: value for key, value in keyed.items() if key not in NOT_COMPARED}


def configured(synthesize: SynthesizeConfig, emulate: EmulatorConfig) -> Conditions:
    """Conditions of sequences made with these sections."""
    return Conditions(dataclasses.asdict(synthesize), dataclasses.asdict(emulate))


def stored(attributes: Mapping[str, Any], height: int, width: int) -> Conditions:
    """Conditions from the attributes of an event store; only the size if its events were not simulated."""
    size = {"sensor_height": height, "sensor_width": width}
    return Conditions(attributes.get("scenes", {}).get("synthesize", {}) | size, attributes.get("emulate", {}))


def trained_on(metadata: Mapping[str, Any]) -> Conditions | None:
    """Training conditions from the JSON of a checkpoint; None if it does not record them."""
    if "data" not in metadata:
        return None
    data = metadata["data"]
    return stored(data.get("events_from", {}), data["height"], data["width"])


def sentence(conditions: Conditions) -> str:
    """Size, duration, frame rate and sensor in words."""
    scene, sensor = conditions
    text = f"Sequences of {scene['sensor_height']}x{scene['sensor_width']} pixels (height x width)"
    if "duration_s" in scene:
        text += f", {scene['duration_s']:g} s at {scene['frame_rate_hz']:g} frames a second"
    return f"{text}; sensor: {_sensor(sensor)}." if sensor else f"{text}."


def _sensor(sensor: Mapping[str, Any]) -> str:
    """The pixel model and its parameters in words, or the names of those drawn for each sequence."""
    drawn = sensor["randomise"] or {}
    model = f"model {sensor['model']}"
    if drawn:
        names = [*drawn] if "model" in drawn else [model, *drawn]
        return f"{', '.join(names)} drawn for each sequence (emulate.randomise)"
    if sensor["model"] == "dvs_voltmeter":
        return f"{model} with the constants of {sensor['voltmeter_camera']}"
    on, off = sensor["contrast_threshold_on"], sensor["contrast_threshold_off"]
    parts = [model, f"contrast thresholds {on:g} (ON) and {off:g} (OFF)"]
    if sensor["model"] not in MODEL_ALONE["esim_log_eps"]:
        sigma_on, sigma_off = sensor["contrast_threshold_sigma_on"], sensor["contrast_threshold_sigma_off"]
        parts += [
            f"mismatch {sigma_on:g} (ON) and {sigma_off:g} (OFF)",
            f"cutoff {sensor['cutoff_hz']:g} Hz" if sensor["cutoff_hz"] else "cutoff none",
            f"leak {sensor['leak_rate_hz']:g} Hz",
            f"shot noise {sensor['shot_noise_rate_hz']:g} Hz",
        ]
    return ", ".join([*parts, f"refractory period {sensor['refractory_period_us']:g} us"])


def warnings(used: Conditions, checkpoints: Mapping[str, Mapping[str, Any]], advice: str) -> list[str]:
    """One warning per training whose sequences differ from `used`: both values of each such key, and the keys to set.

    `checkpoints` maps each row to the metadata of its weights. `advice` introduces the list of keys to set.
    """
    rows: dict[str, list[str]] = {}
    for row, metadata in checkpoints.items():
        rows.setdefault(_warning(used, trained_on(metadata), advice), []).append(row)
    return [f"{', '.join(of)}: {text}" for text, of in rows.items() if text]


def announced(used: Conditions, checkpoints: Mapping[str, Mapping[str, Any]], advice: str) -> dict[str, Any]:
    """Print size, duration and sensor, and the `warnings`; returns both and the sections for details.json."""
    differences = warnings(used, checkpoints, advice)
    print("\n".join([sentence(used), *(f"WARNING: {line}" for line in differences)]), flush=True)
    return {"sentence": sentence(used), "warnings": differences, **used._asdict()}


def _warning(used: Conditions, trained: Conditions | None, advice: str) -> str:
    if trained is None:
        return "the checkpoint does not say what it was trained on, so size and sensor were not compared."
    here, there = used.values, trained.values
    keys = [key for key in there if key in here and here[key] != there[key]]
    nearest = dict(there)
    ranges = trained.emulate.get("randomise")
    if ranges and used.emulate and not used.emulate["randomise"]:  # one sensor, against those that the training drew
        keys.remove("emulate.randomise")
        for name, listed in ranges.items():
            key, value = f"emulate.{name}", used.emulate[name]
            there[key], nearest[key] = listed, _nearest(name, value, listed)
            if value != nearest[key] and key in here:
                keys.append(key)
    if _within_speeds(here, there):
        keys = [key for key in keys if key not in SPEEDS]
    if not keys:
        return ""
    both = ", ".join(f"{key} {_printed(here[key])} (training: {_printed(there[key])})" for key in keys)
    settings = " ".join(f"{key}={_printed(nearest[key])}" for key in keys)
    return f"these sequences differ from those of its training: {both}. {advice} {settings}"


def _nearest(name: str, value: Any, listed: list[Any]) -> Any:
    """The value that a training drew from `listed` (`randomise`) and that is nearest to `value`; a name if of NAMES."""
    if name in NAMES:
        return value if value in listed else listed[0]
    lowest, highest = listed
    return min(max(value, lowest), highest)


def _within_speeds(here: Mapping[str, Any], there: Mapping[str, Any]) -> bool:
    """Whether the speeds of the sequences lie within those of the training."""
    low, high = SPEEDS
    if any(key not in values for key in SPEEDS for values in (here, there)):
        return False
    return bool(there[low] <= here[low] and here[high] <= there[high])


def _printed(value: Any) -> str:
    """A value in the syntax of Hydra's command line."""
    if isinstance(value, list):
        return f"[{','.join(map(_printed, value))}]"
    if isinstance(value, dict):
        return f"{{{','.join(f'{key}:{_printed(one)}' for key, one in value.items())}}}"
    return {True: "true", False: "false"}[value] if isinstance(value, bool) else "null" if value is None else str(value)
