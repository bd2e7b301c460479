"""`polarnet fit-sensor`: fit the simulated sensor to a camera's recordings."""

import argparse
import re
from pathlib import Path

from polarnet.characterization.fit import CONSTANT_LIGHT_PARAMETERS, FLICKER_PARAMETERS, SensorFit, fit_sensor
from polarnet.characterization.flicker import Flicker
from polarnet.cli.options import reading_of
from polarnet.cli.project import settings_root, working_folder
from polarnet.recordings.recording import read_recording
from polarnet.simulation.presets import SENSORS
from polarnet.terminal.progress import ProgressBar

WRITTEN_BY = "# Written by `polarnet fit-sensor`"
MIDDLE_DN = 127.5
PARAMETERS = (*FLICKER_PARAMETERS, "refractory_period_us", "leak_rate_hz", *CONSTANT_LIGHT_PARAMETERS)
UNITS = {"on": "log intensity", "off": "log intensity", "us": "us", "hz": "Hz"}
"""Unit of a parameter by the last word of its name; others have none."""


def run(options: argparse.Namespace) -> None:
    """Fit, print the table and write the sensor."""
    check_options(options)
    preset = _preset_path(options.name)

    paths, reading = [*([options.static] if options.static else []), *(options.flicker or [])], reading_of(options)
    recordings = [read_recording(path, **reading).events for path in ProgressBar(paths, "read", unit="recording")]
    static = recordings.pop(0) if options.static else None
    static_light = MIDDLE_DN if options.static_light is None else options.static_light
    flickers = [
        (events, Flicker(options.flicker_light, options.contrast, hz))
        for events, hz in zip(recordings, options.frequency or [], strict=True)
    ]
    fit = fit_sensor(static, static_light, flickers, SENSORS["default"])
    notes = list(fit.notes)
    if options.static and options.static_light is None:
        notes.append(
            f"Brightness of the static recording: {MIDDLE_DN} DN is assumed, so shot noise may be wrong by a factor of "
            f"up to 2.4; give --static-light"
        )
    for parameter, estimate, error, source in [("parameter", "estimate", "std. error", "from"), *_rows(fit)]:
        print(f"{parameter:32}{estimate:24}{error:12}{source}".rstrip())
    for note in notes:
        print(f"note: {note}")
    preset.parent.mkdir(parents=True, exist_ok=True)
    preset.write_text(_preset_text(options.name, fit.parameters()), encoding="utf-8")
    print(f"sensor      {preset} (use it with sensor={options.name})")


def check_options(options: argparse.Namespace) -> None:
    """ValueError for options that are missing, or that do not belong together."""
    if not (options.static or options.flicker):
        raise ValueError("expected a recording; give --static or --flicker")
    if options.static_light is not None and not (options.static and 0 <= options.static_light <= 255):
        raise ValueError(
            f"--static-light: expected 0 to 255 DN and --static FILE, got {options.static_light}; white is 255"
        )
    files, frequencies = len(options.flicker or []), len(options.frequency or [])
    if files != frequencies:
        raise ValueError(
            f"--frequency: expected one frequency for each of {files} flicker recordings, got {frequencies}"
        )
    if bool(files) != (options.contrast is not None):
        raise ValueError("--contrast: expected the contrast of the flicker, 0 to 1, together with --flicker FILE")


def _rows(fit: SensorFit) -> list[tuple[str, str, str, str]]:
    rows = []
    for name in PARAMETERS:
        if one := fit.estimates.get(name):
            unit = UNITS.get(name.rpartition("_")[2], "")
            rows.append((name, f"{one.value:.4g} {unit}".rstrip(), f"{one.error:.2g}", one.source))
        else:
            rows.append((name, "not estimated", "", f"{fit.missing[name]}; the default stays"))
    return rows


def _preset_text(name: str, values: dict[str, float]) -> str:
    """conf/sensor/NAME.yaml: the estimates that differ from the default sensor."""
    lines = ["# @package _global_", f"{WRITTEN_BY} --name {name}; parameters not named here keep their defaults."]
    body = [f"  {key}: {value:g}" if value % 1 else f"  {key}: {value:.1f}" for key, value in values.items()]
    return "\n".join([*lines, *(["emulate:", *body] if body else ["emulate: {}"])]) + "\n"


def _preset_path(name: str) -> Path:
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise ValueError(f"--name: expected letters, digits, - and _, got {name!r}")
    path, shipped = (root / "conf" / "sensor" / f"{name}.yaml" for root in (working_folder(), settings_root()))
    if shipped.exists() and shipped != path:
        raise ValueError(f"--name: polarnet has a sensor {name}; choose another name")
    if path.exists() and WRITTEN_BY not in path.read_text(encoding="utf-8"):
        raise ValueError(f"--name: {path} exists and was not written by fit-sensor; choose another name")
    return path
