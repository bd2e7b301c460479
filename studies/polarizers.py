"""Margins of the checks on polarizers (polarnet/recordings/polarizers.py), on simulated recordings.

`python -m studies.polarizers` lets five sensors move over the built-in photographs, whose DoLP is reduced by
factors down to 0, and looks at each recording as four channels and as a mosaic of pixels with Sony's order. It prints
the docs' table: misfits, counts, and how many recordings each warning names, by the mean DoLP of what was seen.
"""

import argparse
import dataclasses
import functools
from collections import defaultdict
from typing import NamedTuple

from torch.nn.functional import interpolate

from polarnet.events.mosaic import split_mosaic
from polarnet.events.stream import Events
from polarnet.events.streaming import WindowCutter, WindowRule
from polarnet.recordings.polarizers import WINDOW_US, channel_findings, pair_misfits
from polarnet.simulation import BUILTIN_PHOTOS, MOTIONS, SENSORS, read_rgb, scene_from_polarization, simulate
from polarnet.simulation.scene import polarization_from_rgb
from polarnet.stokes import parse_mosaic

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photographs", type=int, help="the first so many; default: all")
    options = parser.parse_args()
    motion = dataclasses.replace(MOTIONS["default"], sensor_height=HEIGHT, sensor_width=WIDTH, duration_s=DURATION_S)
    results = defaultdict(list)
    for photo in BUILTIN_PHOTOS[: options.photographs]:
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
    print(
        "| | mean DoLP | recordings | counts | misfits | warned of no polarizers | of the order | of exchanged orders |"
    )
    print("|---|---|---:|---:|---:|---:|---:|---:|")
    for kind, rows in results.items():
        for low, high in BANDS:
            of = [row for row in rows if (low < row.dolp <= high or row.dolp == low == high)]
            if of:
                print(
                    f"| {kind} | {f'{low:g} to {high:g}' if high else '0'} | {len(of)} "
                    f"| {min(r.spread for r in of):.2f} to {max(r.spread for r in of):.2f} "
                    f"| {min(r.lowest for r in of):.2f} to {max(r.highest for r in of):.2f} "
                    f"| {sum(r.equal for r in of)} | {sum(r.order for r in of)} "
                    f"| {sum(r.exchanged_45_90 + r.exchanged_90_135 for r in of)} of {2 * len(of)} |"
                )
    for kind, rows in results.items():
        for row in rows:
            if row.order or (row.equal and row.dolp >= 0.1) or (not row.equal and row.dolp == 0):
                print(f"{kind}: {row}")


if __name__ == "__main__":
    main()
