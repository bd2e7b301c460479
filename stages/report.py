"""Results of all stages -> tables in data/benchmark and the HTML report in data/report."""

import dataclasses
import os
import shlex
import sys
from pathlib import Path

from polarnet.config.benchmark_tables import collect_rows, copy_histories
from polarnet.config.experiments import changed_values
from polarnet.config.pipeline import set_folder
from polarnet.config.tree import Config, hydra_stage
from polarnet.reports.artefacts import ReportPaths, Run, facts, git, read_results
from polarnet.reports.page import write_report
from polarnet.reports.tables import as_plain

PLUMBING = ("networks", "rows", "row", "baseline", "paths", "runtime", "cluster")
"""Sections that affect no result, and the networks, of which the page shows the one in use."""


def command_line(root: Path) -> str:
    """The command that makes the page again, with the values that differ from the commit's.

    `dvc exp run` needs a commit; without one, the page's section of parameters has the values.
    """
    if "DVC_STAGE" not in os.environ:
        return shlex.join(["python", "-m", "stages.report", *(w for w in sys.argv[1:] if not w.startswith("hydra."))])
    committed = git(root, "show", "HEAD:./params.yaml")
    changes = [word for change in changed_values(root) for word in ("-S", change)] if committed else []
    return shlex.join(["dvc", "exp", "run", *changes]) if changes else "dvc repro"


@hydra_stage
def main(config: Config) -> None:
    """Put the tables together from the rows of `benchmark.methods`, write the report and print its location."""
    tables = collect_rows(config)
    copy_histories(config)
    for name in tables:
        print(f"\ntest set {name}\n" + as_plain(read_results(set_folder(config, name)).table))
    paths = ReportPaths(**{f.name: Path(getattr(config.paths, f.name)) for f in dataclasses.fields(ReportPaths)})
    parameters = {
        name: value if isinstance(value, int | str) else dataclasses.asdict(value)
        for name, value in vars(config).items()
        if name not in PLUMBING
    }
    parameters["networks"] = {config.network: dataclasses.asdict(config.network_config)}
    root = Path(__file__).resolve().parent.parent
    run = Run(command_line(root), parameters, {"seed": str(config.seed)} | facts(root))
    print(f"the report: {write_report(paths, config.used_baselines, run, Path(config.paths.report))}")


if __name__ == "__main__":
    main()
