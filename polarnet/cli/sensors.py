"""Command for sensors: fit-sensor."""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from polarnet.cli.parsers import READING_OPTIONS, Commands, add_reading
from polarnet.cli.project import settings_root, working_folder

if TYPE_CHECKING:
    from polarnet.characterization.fit import SensorFit
    from polarnet.characterization.light import MovingLight
    from polarnet.events.stream import Events

WRITTEN_BY = "# Written by `polarnet fit-sensor`"
UNITS = {
    "contrast_threshold_on": "log intensity",
    "contrast_threshold_off": "log intensity",
    "contrast_threshold_sigma_on": "log intensity",
    "contrast_threshold_sigma_off": "log intensity",
    "contrast_threshold_correlation": "",
    "cutoff_hz": "Hz",
    "refractory_period_us": "us",
    "leak_rate_hz": "Hz",
    "noise_rate_cov_decades": "decades",
    "leak_jitter": "",
    "shot_noise_rate_hz": "Hz",
    "hot_pixel_share": "",
    "hot_pixel_rate_hz": "Hz",
}
"""Unit of each parameter, in the order of the table."""


def add_to(commands: Commands) -> None:
    """Add the command fit-sensor."""
    fit = commands.add_parser(
        "fit-sensor",
        help="fit the simulated sensor to a camera's recordings",
        description="Estimates thresholds, their deviations, bandwidth, refractory period, leak, shot noise and hot "
        "pixels of a camera from its recordings; prints a table, writes conf/sensor/NAME.yaml, and draws a page that "
        "compares each recording with its simulated twin. docs/fit-sensor.md says what to record.",
        epilog="example: polarnet fit-sensor --name lab --static dark.raw --static-light 0 --moving walk.raw --frames "
        "frames/",
    )
    fit.add_argument("--name", required=True, help="name of the sensor: sensor=NAME uses it")
    fit.add_argument("--static", type=Path, metavar="FILE", help="recording under constant light")
    fit.add_argument(
        "--static-light", type=float, metavar="DN",
        help="brightness of the static recording, 0 (covered lens) to 255 (white) (default: 127.5)",
    )  # fmt: skip
    fit.add_argument("--moving", type=Path, metavar="FILE", help="recording of a moving scene")
    fit.add_argument(
        "--frames", type=Path, metavar="FOLDER",
        help="frames of the moving scene at the pixels of the sensor, with timestamps.txt: one time per frame in "
        "microseconds of the recording's clock",
    )  # fmt: skip
    fit.add_argument(
        "--flicker", type=Path, nargs="+", metavar="FILE", help="recordings of a display or lamp with sinusoidal light"
    )
    fit.add_argument("--contrast", type=float, metavar="C", help="contrast of the flicker, (max - min) / (max + min)")
    fit.add_argument("--frequency", type=float, nargs="+", metavar="HZ", help="frequency of each flicker recording")
    fit.add_argument(
        "--flicker-light", type=float, metavar="DN", help="mean brightness of the flicker (default: 127.5)"
    )
    fit.add_argument("--part", metavar="SEQUENCE/ANGLE", help="sequence and channel, if the files are event stores")
    add_reading(fit)
    fit.add_argument("--page", type=Path, metavar="HTML", help="page to write (default: outputs/fit-sensor/NAME.html)")
    fit.set_defaults(run=_fit_sensor)


def _fit_sensor(options: argparse.Namespace) -> int:
    from polarnet.characterization.fit import fit_sensor
    from polarnet.characterization.light import Flicker, KnownLight, read_light
    from polarnet.characterization.twin import compare, fitted_parameters, fitted_sensor
    from polarnet.recordings.recording import read_recording
    from polarnet.reports.realism import FitRow, realism_page
    from polarnet.simulation.presets import SENSORS

    check_options(options)
    preset = _preset_path(options.name)
    reading: dict[str, Any] = {name: getattr(options, name) for name in READING_OPTIONS}

    def read(path: Path) -> "Events":
        return read_recording(path, part=options.part, **reading).events

    static_light = 127.5 if options.static_light is None else options.static_light
    static = read(options.static) if options.static else None
    moving = read(options.moving) if options.moving else None
    known: list[KnownLight] = []
    lights: list[tuple[str, Events, MovingLight | Flicker | float]] = []
    if static is not None:
        lights.append((f"static: {options.static.name}", static, static_light))
    if moving is not None and options.frames:
        light = read_light(options.frames, moving.height, moving.width)
        known.append(KnownLight("moving", moving, light))
        lights.append((f"moving: {options.moving.name}", moving, light))
    mean = 127.5 if options.flicker_light is None else options.flicker_light
    for path, frequency_hz in zip(options.flicker or [], options.frequency or [], strict=True):
        flicker = Flicker(mean, options.contrast, frequency_hz)
        known.append(KnownLight(f"flicker {frequency_hz:g} Hz", read(path), flicker))
        lights.append((f"flicker: {path.name}", known[-1].events, flicker))
    fit = fit_sensor(static, static_light, known, [moving] if moving is not None and not options.frames else [])
    rows = table_rows(fit)
    for cells in rows:
        print("  ".join(f"{cell:{width}}" for cell, width in zip(cells, _widths(rows), strict=True)).rstrip())
    notes = list(fit.notes)
    if options.static and options.static_light is None:
        notes.append(
            "Brightness of the static recording: 127.5 DN is assumed, so shot noise may be wrong by a factor of up to "
            "2.4; give --static-light"
        )
    for note in notes:
        print(f"note: {note}")
    preset.parent.mkdir(parents=True, exist_ok=True)
    preset.write_text(preset_text(options.name, fitted_parameters(fit)), encoding="utf-8")
    sensor = fitted_sensor(fit, SENSORS["default"])
    comparisons = [compare(name, events, light, sensor, seed=1) for name, events, light in lights if len(events) > 1]
    for comparison in comparisons:
        print(f"{comparison.name}: {comparison.verdict}")
    page = options.page or Path("outputs") / "fit-sensor" / f"{options.name}.html"
    page.parent.mkdir(parents=True, exist_ok=True)
    table = [FitRow(*cells) for cells in rows[1:]]
    page.write_text(realism_page(options.name, table, notes, comparisons), encoding="utf-8")
    print(f"sensor      {preset} (use it with sensor={options.name})")
    print(f"page        {page}")
    return 0


def check_options(options: argparse.Namespace) -> None:
    """ValueError for options that are missing, or that do not belong together."""
    if not (options.static or options.moving or options.flicker):
        raise ValueError("expected a recording; give --static, --moving with --frames, or --flicker")
    if options.frames and not options.moving:
        raise ValueError("--frames: expected the recording of these frames; give --moving FILE")
    if options.static_light is not None and not (options.static and 0 <= options.static_light <= 255):
        raise ValueError(
            f"--static-light: expected 0 to 255 DN and --static FILE, got {options.static_light}; white is 255"
        )
    files, frequencies = options.flicker or [], options.frequency or []
    if len(files) != len(frequencies):
        raise ValueError(
            f"--frequency: expected one frequency for each of {len(files)} flicker recordings, got {len(frequencies)}"
        )
    if bool(files) != (options.contrast is not None):
        raise ValueError("--contrast: expected the contrast of the flicker, 0 to 1, together with --flicker FILE")


def table_rows(fit: "SensorFit") -> list[tuple[str, str, str, str]]:
    """Heading and rows of the table: parameter, estimate, standard error, source."""
    rows = [("parameter", "estimate", "std. error", "from")]
    for name, unit in UNITS.items():
        if name in fit.estimates:
            one = fit.estimates[name]
            rows.append((name, f"{one.value:.4g} {unit}".rstrip(), f"{one.error:.2g}", one.source))
        else:
            rows.append((name, "not estimated", "", f"{fit.missing[name]}; the default stays"))
    return rows


def preset_text(name: str, values: dict[str, float]) -> str:
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


def _widths(rows: Sequence[Sequence[str]]) -> list[int]:
    return [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
