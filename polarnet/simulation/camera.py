"""The simulated camera: its sensors, the polarizers before their pixels, and their readout."""

from dataclasses import asdict, dataclass
from typing import Any

from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.polarizers import IDEAL, PolarizersConfig
from polarnet.simulation.readout import PERFECT, ReadoutConfig


@dataclass(frozen=True)
class Camera:
    """Sections `emulate`, `polarizers` and `readout` of params.yaml."""

    sensor: EmulatorConfig
    polarizers: PolarizersConfig = IDEAL
    readout: ReadoutConfig = PERFECT

    @property
    def sections(self) -> dict[str, Any]:
        """The sections by name."""
        return {
            "emulate": asdict(self.sensor),
            "polarizers": asdict(self.polarizers),
            "readout": asdict(self.readout),
        }
