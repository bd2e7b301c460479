"""What the designs of the network scored on the way: python -m studies.designs

Nothing is measured here. docs/results/network.json was written at each of these commits by `studies/study.py
--write`, which trained and scored the network of its day on the same photographs; git still has it. Writes
docs/results/designs.json; today's network is in network.json itself. Needs the whole history of the repository.
"""

import json
from pathlib import Path
from typing import NamedTuple

from polarnet.reports.provenance import git
from studies.measure import ABLATION_KEYS, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]


class Design(NamedTuple):
    """What was new, and where its figures are."""

    about: str
    commit: str
    sections: tuple[str, ...]
    """Of network.json: a training each."""


DESIGNS = (
    Design("The redundancy solved at many scales, a U-Net that mixes.", "4c440ea", ("seed_1", "seed_2", "seed_3")),
    Design("+ training scenes evened towards any degree", "a6073c9", ("shipped",)),
    Design("+ averaged with a mosaic after the training", "74fb33b", ("shipped",)),
    Design("+ trained with the mosaic, sees further, whole images", "43e460a", ("seed_1",)),
    Design("+ Muon instead of Adam", "5bfdc00", ("seed_1", "seed_2", "seed_3")),
    Design("... of that, without evened scenes, in shorter visits", "160795c", ("seed_2", "seed_3")),
    Design(
        "+ slopes of the mosaic, squared errors alone; scenes evened towards one of their own points",
        "29c0c05",
        ("seed_1",),
    ),
)


def main() -> None:
    """Collect and write."""
    rows = []
    for design in DESIGNS:
        results = json.loads(git(ROOT, "show", f"{design.commit}:docs/results/network.json"))
        commit = git(ROOT, "rev-parse", "--short=10", design.commit)
        found = [results[section]["rows"] for section in design.sections]
        simulated = [one["simulated"] for one in found]
        rows.append({
            "about": design.about,
            "commit": commit,
            "seeds": [{key: one["ours"][key] for key in ABLATION_KEYS} for one in simulated],
            "mse_over_oracle_mean": [one["ours"]["mse"] / one["oracle_mean"]["mse"] for one in simulated],
            "measured_mse": [one["measured"]["ours"]["mse"] for one in found],
        })  # fmt: skip
    print(write_section(ROOT, "designs", "rows", {"designs": rows}, machine_record(ROOT)))


if __name__ == "__main__":
    main()
