"""A flicker of known contrast, and the photoreceptor's response to it."""

import dataclasses
import math

import numpy as np
import pytest

from polarnet.characterization.flicker import Flicker, flicker_cycle
from polarnet.simulation.presets import SENSORS


@pytest.mark.parametrize(
    ("level", "changes", "response"),
    [
        (100.0, {}, np.log),
        (10.0, {}, lambda dn: dn * math.log(20) / 20),
        (10.0, {"knee_dn": 2.72}, np.log),
        (10.0, {"dark_dn": 5.0}, lambda dn: np.log(dn + 5)),
    ],
)
def test_without_a_photoreceptor_the_cycle_is_the_response_of_the_sensor(level, changes, response):
    flicker = Flicker(level, 0.5, 10.0)
    cycle = flicker_cycle(flicker, dataclasses.replace(SENSORS["default"], **changes), 0.0)
    assert cycle == pytest.approx(response(flicker.light(np.linspace(0, 2 * math.pi, len(cycle)))), abs=1e-5)


def test_a_flicker_at_the_bandwidth_of_its_level_loses_a_factor_of_root_two():
    flickers = (Flicker(127.5, 0.05, frequency_hz) for frequency_hz in (0.1, 147.5))
    slow, fast = (flicker_cycle(flicker, SENSORS["default"], 275.0) for flicker in flickers)
    assert np.ptp(slow) == pytest.approx(math.log(1.05 / 0.95), rel=1e-3)
    assert np.ptp(fast) == pytest.approx(np.ptp(slow) / math.sqrt(2), rel=1e-2)
    assert fast[0] == pytest.approx(fast[-1])
    assert 2 * math.pi * fast.argmax() / (len(fast) - 1) == pytest.approx(0.75 * math.pi, abs=0.05)  # 45 degrees late


@pytest.mark.parametrize(
    ("values", "word"), [((127.5, 1.2, 10.0), "contrast"), ((127.5, 0.5, 0.0), "Hz"), ((200.0, 0.5, 10.0), "lower the")]
)
def test_impossible_flicker_is_refused(values, word):
    with pytest.raises(ValueError, match=word):
        Flicker(*values)
