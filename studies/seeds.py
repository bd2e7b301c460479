"""The recipe of the shipped weights with another seed, scored beside the shipped weights.

python -m studies.seeds --seed N --training FOLDER --photographs FOLDER --photographs-large FOLDER --measured FOLDER ...
    --work FOLDER [--write]

The stages run on the training photographs (`studies.robustness --training`) with `experiment=shipped` and then with
`experiment=shipped_whole`, all with seed N: it decides motion, scenes, sensors and the network.
`studies.robustness` scores the network and the shipped one on the test split of both sets of photographs and on the
measured scenes. An interrupted run resumes. --write puts both rows into docs/results/seeds.json, whose means are over
the shipped weights and all seeds there.
"""

from pathlib import Path
from statistics import fmean
from typing import Any

from polarnet.networks.weights import shipped_weights
from studies.data_curve import resolved, scored, with_folders
from studies.measure import ROOT, command_line, machine_record, read_results, run_missing, write_section

CONDITIONS = ("photographs", "photographs_large", "measured")
FIGURES = ("mse", "psnr", "corr", "mse_over_oracle_mean", "median_over_oracle_mean")
SHIPPED = "shipped"


def trained(seed: int, training: Path, folder: Path) -> Path:
    """Checkpoint after both trainings with this seed; finished stages are not run again."""
    common = (f"seed={seed}", f"ingest.root={training}", "benchmark.lpips=false")
    first = run_missing(folder / "shipped", "experiment=shipped", *common)
    return run_missing(folder / "shipped_whole", "experiment=shipped_whole", f"train.start={first}", *common)


def row_of(tables: dict[str, Any], network: str) -> dict[str, Any]:
    """Figures of one network by condition."""
    return {name: {key: tables[name]["rows"][network][key] for key in FIGURES} for name in CONDITIONS}


def means(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Mean of each figure over the networks, by condition."""
    return {name: {key: fmean(row[name][key] for row in rows) for key in FIGURES} for name in CONDITIONS}


def main() -> None:
    """Train and score, print and perhaps write."""
    parser = with_folders(command_line(__doc__, "docs/results/seeds.json"))
    parser.add_argument("--seed", type=int, required=True, help="seed of all stages; the shipped weights have 1")
    arguments = resolved(parser)
    record, name = machine_record(ROOT), f"seed_{arguments.seed}"
    weights = trained(arguments.seed, arguments.training, arguments.work / name)
    tables = scored({SHIPPED: shipped_weights(), name: weights}, arguments, CONDITIONS)
    row = row_of(tables, name)
    print(name, row)
    if arguments.write:
        write_section(ROOT, "seeds", SHIPPED, row_of(tables, SHIPPED), record)
        sections = read_results(ROOT, "seeds") | {name: row}
        rows = {key: one for key, one in sections.items() if key == SHIPPED or key.startswith("seed_")}
        scenes = {condition: tables[condition]["scenes"] for condition in CONDITIONS}
        above = {"networks": len(rows), "mean": means([*rows.values()]), "scenes": scenes}
        print(f"wrote {write_section(ROOT, 'seeds', name, row, record, above)}")


if __name__ == "__main__":
    main()
