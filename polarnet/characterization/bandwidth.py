"""The photoreceptor's bandwidth: the one for which increments (`known_light`) are closest to one threshold."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize_scalar

from polarnet.characterization.estimates import GROUPS, MAX_RELATIVE_ERROR, Estimate
from polarnet.characterization.known_light import BLOCK, Source, at_pixels, increments_of
from polarnet.characterization.leak import thresholds_without_leak
from polarnet.characterization.thresholds import misfit

CUTOFF_PIXELS = 600  # pixels that the bandwidth is fitted to
CUTOFF_GRID = np.geomspace(5, 2500, 14)  # Hz, first guesses


def bandwidth(sources: Sequence[Source], leak_hz: float) -> Estimate | None:
    """Bandwidth in Hz, from flickers if there are any, else from all sources; None if the data do not determine it."""
    flickers = [source for source in sources if not source.moves]
    sources = flickers or sources
    pixels = sources[0].events.pixels
    busy = np.flatnonzero(sum(np.bincount(source.intervals.pixel, minlength=pixels) for source in sources) >= 2 * BLOCK)
    if len(busy) < GROUPS:
        return None
    chosen = busy[:: max(1, len(busy) // CUTOFF_PIXELS)]
    logs = []
    for group in range(GROUPS):
        mask = np.zeros(pixels, bool)
        mask[chosen[group::GROUPS]] = True
        some = [at_pixels(source, mask) for source in sources]

        def loss(log_hz: float, some=some) -> float:
            data = increments_of(some, math.exp(log_hz))
            try:
                pair = thresholds_without_leak(data, leak_hz, pixels)
            except ValueError:
                return 2.0
            total = 0.0
            for of, thresholds in ((data.on, pair.on), (~data.on, pair.off)):
                valid = of & np.isfinite(thresholds.threshold[data.pixel])
                total += misfit(data.increment[valid], data.pixel[valid], thresholds.threshold) if valid.any() else 1.0
            return total

        grid = np.log(CUTOFF_GRID)
        losses = [loss(x) for x in grid]
        k = int(np.argmin(losses))
        if k == 0 or k == len(grid) - 1 or losses[k] > 0.98 * losses[-1]:
            continue
        bounds = (grid[k - 1], grid[k + 1])
        logs.append(minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 0.01}).x)
    if len(logs) < GROUPS // 2 + 1 or np.std(logs, ddof=1) / math.sqrt(len(logs)) > MAX_RELATIVE_ERROR:
        return None
    value = math.exp(float(np.median(logs)))
    names = " and ".join(source.name for source in sources)
    return Estimate(value, value * float(np.std(logs, ddof=1)) / math.sqrt(len(logs)), f"{names}, whole increments")
