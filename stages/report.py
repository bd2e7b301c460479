"""Results of all stages -> data/report: the HTML report."""

import dataclasses
import os
import sys
from pathlib import Path

from polarnet.config.tree import Config, hydra_stage
from polarnet.reports.artefacts import ReportPaths
from polarnet.reports.page import write_report
from polarnet.reports.provenance import Run, facts

PLUMBING = ("paths", "runtime", "cluster")  # sections that do not affect results


@hydra_stage
def main(config: Config) -> None:
    """Write the report and print its location."""
    paths = ReportPaths(**{f.name: Path(getattr(config.paths, f.name)) for f in dataclasses.fields(ReportPaths)})
    parameters = {name: value for name, value in dataclasses.asdict(config).items() if name not in PLUMBING}
    overrides = [override for override in sys.argv[1:] if not override.startswith("hydra.")]
    command = "dvc repro" if "DVC_STAGE" in os.environ else " ".join(["polarnet run", *overrides])
    run = Run(command, parameters, {"seed": str(config.seed)} | facts(Path(__file__).resolve().parent.parent))
    print(f"the report: {write_report(paths, run, Path(config.paths.report))}")


if __name__ == "__main__":
    main()
