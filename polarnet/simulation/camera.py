"""The simulated camera: its sensors, the polarizers before their pixels, and their readout."""

from dataclasses import asdict, dataclass, replace
from typing import Any

from polarnet.runtime.machine import seed_for
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.polarizers import IDEAL, PolarizersConfig
from polarnet.simulation.ranges import RandomisedConfig, draws
from polarnet.simulation.readout import PERFECT, ReadoutConfig


@dataclass(frozen=True)
class Camera:
    """A simulated camera: sections `emulate`, `polarizers` and `readout` of params.yaml.

    >>> from polarnet.simulation import POLARIZERS, SENSORS, Camera
    >>> Camera(SENSORS["noisy"], POLARIZERS["film"]).polarizers.transmission
    [0.737, 0.737, 0.737, 0.737]
    """

    sensor: EmulatorConfig
    polarizers: PolarizersConfig = IDEAL
    readout: ReadoutConfig = PERFECT
    key: int = 0  # 64 bits that seed mismatch and noise: two cameras of one kind differ in it. `drawn` sets it.

    @property
    def sections(self) -> dict[str, Any]:
        """The sections by name."""
        return {name: asdict(section) for name, section in self._sections.items()}

    def draws(self, seed: int, sequence: str) -> dict[str, dict[str, Any]]:
        """Values that a sequence draws from the ranges of `randomise`, by section and parameter."""
        values = {name: draws(section, seed, sequence) for name, section in self._sections.items()}
        return {name: drawn for name, drawn in values.items() if drawn}

    def drawn(self, seed: int, sequence: str, purpose: str = "emulate") -> "Camera":
        """The camera of one sequence: with a key, and the sequence's own values for the ranges of `randomise`."""
        values = self.draws(seed, sequence)
        return Camera(
            replace(self.sensor, **values.get("emulate", {}), randomise=None),
            replace(self.polarizers, **values.get("polarizers", {}), randomise=None),
            replace(self.readout, **values.get("readout", {}), randomise=None),
            seed_for(seed, sequence, purpose),
        )

    @property
    def _sections(self) -> dict[str, RandomisedConfig]:
        return {"emulate": self.sensor, "polarizers": self.polarizers, "readout": self.readout}
