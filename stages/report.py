"""Results of all stages -> tables in data/benchmark and the HTML report in data/report."""

import dataclasses
import os
import sys
from pathlib import Path
from typing import Any

from polarnet.config.pipeline import set_folder
from polarnet.config.tables import collect_rows, copy_histories
from polarnet.config.tree import Config, hydra_stage
from polarnet.reports.artefacts import ReportPaths, Run, facts, read_results, results_table
from polarnet.reports.page import write_report
from polarnet.reports.tables import as_plain

PLUMBING = ("networks", "rows", "row", "baseline", "paths", "runtime", "cluster")
"""Sections that affect no result, and the networks, of which the page shows the one in use."""


def plain(value: Any) -> Any:
    """A section as a dict; other values as they are."""
    return dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value


@hydra_stage
def main(config: Config) -> None:
    """Put the tables together from the rows of `benchmark.methods`, write the report and print its location."""
    tables = collect_rows(config)
    copy_histories(config)
    for name in tables:
        print(f"\ntest set {name}\n" + as_plain(results_table(read_results(set_folder(config, name)))))
    paths = ReportPaths(**{f.name: Path(getattr(config.paths, f.name)) for f in dataclasses.fields(ReportPaths)})
    shown = [field.name for field in dataclasses.fields(config) if field.name not in PLUMBING]
    parameters = {name: plain(getattr(config, name)) for name in shown}
    parameters["networks"] = {config.network: plain(config.network_config)}
    overrides = [override for override in sys.argv[1:] if not override.startswith("hydra.")]
    command = "dvc repro" if "DVC_STAGE" in os.environ else " ".join(["python -m stages.report", *overrides])
    run = Run(command, parameters, {"seed": str(config.seed)} | facts(Path(__file__).resolve().parent.parent))
    print(f"the report: {write_report(paths, config.used_baselines, run, Path(config.paths.report))}")


if __name__ == "__main__":
    main()
