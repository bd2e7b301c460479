"""The names that rooms export: typed, loaded on first use, each with an example that runs."""

import doctest
import importlib
import subprocess
import sys

import pytest
from skimage.data import coffee

ROOMS = ("events", "metrics", "networks", "pictures", "recordings", "recovery", "reports", "simulation", "storage")
EXAMPLES = (
    "polarnet.metrics.scores", "polarnet.recovery.events", "polarnet.reports.look", "polarnet.reports.videos",
    "polarnet.runtime.progress",
)  # fmt: skip


@pytest.mark.parametrize("room", ROOMS)
def test_every_exported_name_exists_and_is_listed(room):
    package = importlib.import_module(f"polarnet.{room}")
    assert package.__all__
    for name in package.__all__:
        assert getattr(package, name) is not None
        assert name in dir(package)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        package.nothing  # noqa: B018


@pytest.mark.parametrize("module", EXAMPLES)
def test_examples_run(module):
    result = doctest.testmod(importlib.import_module(module), optionflags=doctest.ELLIPSIS)
    assert result.attempted > 0
    assert result.failed == 0


def test_importing_the_rooms_loads_no_large_package():
    imports = "; ".join(f"import polarnet.{room}" for room in ROOMS)
    script = f"import sys; {imports}; print([name for name in ('torch', 'numpy', 'zarr', 'av') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True).stdout.strip() == "[]"


def test_simulate_recover_score_and_look_in_a_few_lines():
    from polarnet.metrics import score
    from polarnet.networks import shipped_weights
    from polarnet.recovery import recover
    from polarnet.reports import plot_prediction
    from polarnet.simulation import MOTIONS, SENSORS, simulate

    simulation = simulate(coffee().transpose(2, 0, 1) / 255, MOTIONS["default"], SENSORS["default"], seed=1)
    recovered = recover(simulation.events, shipped_weights(), simulation.t_us)
    scores = score(recovered.prediction, simulation.dolp[1:], simulation.aolp[1:], warmup_frames=5)
    assert recovered.t_us.tolist() == simulation.t_us[1:].tolist()
    assert scores["mse"] < 0.1
    assert scores["corr"] > 0.3
    first = recovered.prediction._replace(**{name: values[10] for name, values in recovered.prediction._asdict().items()
                                             if values is not None})  # fmt: skip
    assert plot_prediction(first, simulation.dolp[11]).width > 1000
