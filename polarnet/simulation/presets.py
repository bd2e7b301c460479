"""Ready-made sensors and motions for callers from Python: the settings of the wheel, or of a clone's params.yaml."""

from dataclasses import replace
from typing import Any

from ruamel.yaml import YAML

from polarnet.simulation.camera import IDEAL
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.motion import SynthesizeConfig
from polarnet.terminal.installation import shipped_settings


def _preset(group: str, name: str) -> dict[str, Any]:
    """Values of the one section that a sensor or polarizers set."""
    content = YAML(typ="safe").load(shipped_settings() / "conf" / group / f"{name}.yaml") or {}
    return next(iter(content.values()), {})


_PARAMS = YAML(typ="safe").load(shipped_settings() / "params.yaml")
_SENSOR = EmulatorConfig(**_PARAMS["emulate"])

SENSORS = {
    name: replace(_SENSOR, **_preset("sensor", name))
    for name in ("default", "clean", "noisy", "random", "davis346", "gen41", "celex5")
}
"""v2e's command-line defaults, its options `clean` and `noisy`, `random`, which differs from sequence to sequence, and
three real cameras: DAVIS346, Prophesee Gen4.1 (Sony IMX636) and CeleX-5, with their sources in conf/sensor.

Derive others with `dataclasses.replace`.

>>> from polarnet.simulation import SENSORS
>>> SENSORS["clean"].shot_noise_rate_hz
0.0
"""

POLARIZERS = {
    name: replace(IDEAL, **_preset("polarizers", name)) for name in ("ideal", "film", "wire_grid", "micropolarizers")
}
"""Polarizers of a `Camera`, as in conf/polarizers.

>>> from polarnet.simulation import POLARIZERS
>>> POLARIZERS["micropolarizers"].layout
'dofp'
"""

MOTIONS = {"default": SynthesizeConfig(**_PARAMS["synthesize"])}
"""One second of a 120 x 180 px sensor that drifts at up to 160 px/s.

>>> from polarnet.simulation import MOTIONS
>>> MOTIONS["default"].frame_rate_hz
30.0
"""
