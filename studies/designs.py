"""Scores of earlier designs of the network: python -m studies.designs

This script measures nothing. It collects docs/results/network.json from earlier commits, where `studies/study.py
--write` trained and scored the network of that commit on the same photographs. It writes docs/results/designs.json and
needs the whole history of the repository.
"""

import argparse
import json
from pathlib import Path
from typing import NamedTuple

from polarnet.reports.provenance import git
from studies.measure import ABLATION_KEYS, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]


class Design(NamedTuple):
    """A design: its difference from the one before, and the commit with its figures."""

    about: str
    commit: str
    sections: tuple[str, ...]
    """Sections of network.json, one for each training."""


DESIGNS = (
    Design("redundancy solved at several scales, combined by a U-Net", "4c440ea", ("seed_1", "seed_2", "seed_3")),
    Design("+ training scenes drawn towards one uniform polarization of any degree", "a6073c9", ("shipped",)),
    Design("+ prediction averaged with a panorama after training", "74fb33b", ("shipped",)),
    Design("+ panorama part of training, larger receptive field, whole frames", "43e460a", ("seed_1",)),
    Design("+ Muon instead of Adam", "5bfdc00", ("seed_1", "seed_2", "seed_3")),
    Design(
        "the same without scenes drawn towards one polarization, with fewer windows of each sequence",
        "160795c",
        ("seed_2", "seed_3"),
    ),
    Design(
        "+ gradients of the panorama, squared error only; scenes drawn towards the polarization at one of their points",
        "29c0c05",
        ("seed_1",),
    ),
)


def main() -> None:
    """Collect the figures and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    rows = []
    for design in DESIGNS:
        results = json.loads(git(ROOT, "show", f"{design.commit}:docs/results/network.json"))
        commit = git(ROOT, "rev-parse", "--short=10", design.commit)
        studies_at_commit = [results[section]["rows"] for section in design.sections]
        simulated = [one["simulated"] for one in studies_at_commit]
        rows.append({
            "commit": commit,
            "seeds": [{key: one["ours"][key] for key in ABLATION_KEYS} for one in simulated],
            "mse_over_oracle_mean": [one["ours"]["mse"] / one["oracle_mean"]["mse"] for one in simulated],
            "measured_mse": [one["measured"]["ours"]["mse"] for one in studies_at_commit],
        })  # fmt: skip
    print(write_section(ROOT, "designs", "rows", {"designs": rows}, machine_record(ROOT)))


if __name__ == "__main__":
    main()
