"""Margins of the checks on polarizers (polarnet/recordings/polarizers.py): python -m studies.polarizers [--write]

Five sensors move over the built-in photographs, whose DoLP is reduced by factors down to 0. Each recording is checked
as four channels and as a mosaic of pixels with Sony's order, in its own order of angles and with two angles exchanged.
`--write` puts the table into docs/results/recordings.json, under `polarizers`: a row for each kind of recording and
each range of mean DoLP.
"""

import dataclasses
import functools
import json
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

from torch.nn.functional import interpolate

from polarnet.events.mosaic import split_mosaic
from polarnet.events.stream import Events
from polarnet.events.streaming import WindowCutter, WindowRule
from polarnet.recordings.polarizers import WINDOW_US, channel_findings, pair_misfits
from polarnet.simulation import BUILTIN_PHOTOS, MOTIONS, SENSORS, read_rgb, scene_from_polarization, simulate
from polarnet.simulation.scene import polarization_from_rgb
from polarnet.stokes import parse_mosaic
from studies.measure import ROOT, arguments_of, command_line, machine_record, write_section

HEIGHT, WIDTH, DURATION_S = 160, 240, 0.4
FACTORS = (1.0, 0.3, 0.1, 0.03, 0.0)
ORDER = parse_mosaic("90 45 / 135 0")
BANDS = ((0.0, 0.0), (0.0, 0.02), (0.02, 0.05), (0.05, 0.1), (0.1, 0.2), (0.2, 1.0))
uneven = functools.partial(dataclasses.replace, SENSORS["default"])
SENSORS_CHECKED = {
    **{name: SENSORS[name] for name in ("default", "clean", "noisy")},
    "0.1 / 0.4": uneven(contrast_threshold_on=0.1, contrast_threshold_off=0.4),
    "0.4 / 0.1": uneven(contrast_threshold_on=0.4, contrast_threshold_off=0.1),
}


class Result(NamedTuple):
    """One recording, looked at in one way."""

    name: str
    dolp: float
    spread: float
    """Events of the busiest channel over those of the quietest."""
    highest: float
    lowest: float
    """Misfits of the other pairs over that of the pairs at right angles."""
    equal: bool
    order: bool
    """Warnings about the recording in its own order."""
    exchanged_45_90: bool
    exchanged_90_135: bool
    """Warnings about the order with these angles exchanged."""


def result_of(name: str, dolp: float, channels: list[Events], mosaic: bool) -> Result:
    cutter = WindowCutter(WindowRule(WINDOW_US, None, None), channels[0].height, channels[0].width)
    misfits = pair_misfits(list(cutter.add(channels, round(DURATION_S * 1e6))))
    counts = [len(events) for events in channels]
    orders = [[0, 1, 2], [1, 0, 2], [2, 1, 0]]  # of the pairs: as they are, 45 and 90, 90 and 135 degrees exchanged
    said = [
        " ".join(channel_findings(misfits._replace(rms=misfits.rms[order]), counts, mosaic=mosaic)) for order in orders
    ]
    ratio = misfits.rms[1:] / misfits.rms[0]
    return Result(
        name,
        dolp,
        max(counts) / max(1, min(counts)),
        ratio.max(),
        ratio.min(),
        "show the same" in said[0],
        *("another order" in words for words in said),
    )


def figures_of(kind: str, low: float, high: float, results: Sequence[Result]) -> dict[str, Any]:
    """One row of the table: extremes of `results`, and how many of them each warning names."""
    return {
        "kind": kind,
        "dolp_from": low,
        "dolp_to": high,
        "recordings": len(results),
        "counts_min": min(r.spread for r in results),
        "counts_max": max(r.spread for r in results),
        "misfit_min": min(r.lowest for r in results),
        "misfit_max": max(r.highest for r in results),
        "warned_no_polarizers": sum(r.equal for r in results),
        "warned_order": sum(r.order for r in results),
        "warned_exchanged": sum(r.exchanged_45_90 + r.exchanged_90_135 for r in results),
        "exchanged": 2 * len(results),
    }


def recordings_of(photographs: int | None) -> dict[str, list[Result]]:
    """Results of every photograph, sensor and factor by the kind of recording."""
    motion = dataclasses.replace(MOTIONS["default"], sensor_height=HEIGHT, sensor_width=WIDTH, duration_s=DURATION_S)
    results = defaultdict(list)
    for photo in BUILTIN_PHOTOS[:photographs]:
        rgb = interpolate(read_rgb(photo.path)[None], (400, 600), mode="bilinear", antialias=True)[0].clamp(0, 1)
        s0, dolp, aolp = polarization_from_rgb(rgb)
        for sensor, config in SENSORS_CHECKED.items():
            for factor in FACTORS:
                simulation = simulate(scene_from_polarization(s0, factor * dolp, aolp), motion, config, seed=1)
                case = f"{photo.path.stem}, {sensor}, x {factor:g}", float(simulation.dolp.mean())
                results["four channels"].append(result_of(*case, simulation.events, mosaic=False))
                cells = [split_mosaic(events, ORDER)[number] for number, events in enumerate(simulation.events)]
                results["mosaic"].append(result_of(*case, cells, mosaic=True))
        print(f"{photo.path.stem} done", flush=True)
    return results


def main() -> None:
    parser = command_line(__doc__, "docs/results/recordings.json")
    parser.add_argument("--photographs", type=int, help="the first so many; default: all")
    options = arguments_of(parser)
    record = machine_record(ROOT)
    results = recordings_of(options.photographs)
    rows = []
    for kind, of_kind in results.items():
        for low, high in BANDS:
            within = [r for r in of_kind if low < r.dolp <= high or r.dolp == low == high]
            rows += [figures_of(kind, low, high, within)] if within else []
    for kind, of_kind in results.items():
        for result in of_kind:
            if result.order or (result.equal and result.dolp >= 0.1) or (not result.equal and result.dolp == 0):
                print(f"{kind}: {result}")
    print(json.dumps(rows, indent=2))
    if options.write:
        photographs = len(BUILTIN_PHOTOS[: options.photographs])
        figures = {"photographs": photographs, "sensors": list(SENSORS_CHECKED), "rows": rows}
        print(write_section(ROOT, "recordings", "polarizers", figures, record))


if __name__ == "__main__":
    main()
