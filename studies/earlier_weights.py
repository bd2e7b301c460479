"""The test bed of earlier shipped weights: python -m studies.earlier_weights [--write]

Collects the figures that `studies.robustness` measured for them from docs/results/robustness.json of the commits in
MEASURED, which needs a clone with its history. --write puts them into docs/results/earlier_weights.json.
"""

import json
import subprocess
from collections.abc import Mapping
from typing import Any

from studies.measure import ROOT, arguments_of, command_line, machine_record, write_section
from studies.rate import OURS

MEASURED = {
    "a472419": "twelve windows of whole frames, one visit to each; five features, fitted to photographs",
    "4546618": "crops, then whole sequences (`loss.half_weight=0.05`); five features, fitted to photographs",
    "a9a6e44": "the same network; five features, half of the weight on scenes like real ones",
    "70dea80": "weakly polarized frames weighted more (`loss.half_weight=0.02`); four features, squares and products",
    "8bc01fe": "the same network with the level from shot noise",
}
"""Training and expected errors, by the commit that has the figures."""
RATIOS = (
    "photographs", "photographs_large", "measured", "sensors.default", "sensors.noisy", "sensors.thresholds_0.4",
    "sensors.dvs_voltmeter", "sensors.saturating_readout", "sensors.randomised",
)  # fmt: skip
FACTORS = ("photographs", "measured", "sensors.noisy")


def figures_of(tables: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """MSE relative to the oracle mean's and the factors of expected errors, by condition."""
    rows = {name: tables[name]["rows"][OURS] for name in RATIOS}
    return {
        "ratio": {name: row["mse_over_oracle_mean"] for name, row in rows.items()},
        "factor": {name: rows[name]["error_factor"] for name in FACTORS},
    }


def main() -> None:
    """Collect, print and perhaps write."""
    arguments = arguments_of(command_line(__doc__, "docs/results/earlier_weights.json"))
    rows = []
    for commit, about in MEASURED.items():
        command = ["git", "show", f"{commit}:docs/results/robustness.json"]
        results = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True).stdout)
        measured = {"about": about, "commit": results["records"]["test"]["commit"]}
        rows.append(measured | figures_of(results["test"]["tables"]))
    print(json.dumps(rows, indent=1))
    if arguments.write:
        print(write_section(ROOT, "earlier_weights", "test", {"rows": rows}, machine_record(ROOT)))


if __name__ == "__main__":
    main()
