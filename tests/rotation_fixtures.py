"""Events of pixels behind a rotating polarizer, without sensor noise, and the error of an angle."""

import math

import numpy as np

from polarnet.events.stream import Events


def exact_events(dolp, aolp, rotation, stop_us, threshold=0.2, delay_us=0.0):
    """Events at the crossings of ln(1 + DoLP cos 2 (angle - AoLP)), found on a grid of 5 us and between its points."""
    t_us = np.arange(0, stop_us + 5, 5.0)
    rows = []
    for (y, x), m in np.ndenumerate(dolp):
        logs = np.log1p(m * np.cos(2 * (rotation.at(t_us - delay_us) - aolp[y, x])))
        # a level of the staircase is crossed again by the opposite polarity only one threshold further on
        reference = logs[0]
        for k in range(1, len(t_us)):
            while abs(logs[k] - reference) >= threshold:
                p = 1 if logs[k] > reference else -1
                reference += p * threshold
                share = (reference - logs[k - 1]) / (logs[k] - logs[k - 1])
                rows.append((round(t_us[k - 1] + 5 * share), x, y, p))
    columns = np.array(sorted(rows), np.int64).reshape(-1, 4).T
    return Events.from_columns(*columns, *dolp.shape)


def angle_error_deg(found, truth):
    return np.degrees((found.numpy() - truth + math.pi / 2) % math.pi - math.pi / 2)
