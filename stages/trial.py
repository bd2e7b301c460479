"""One point of a sweep: train and benchmark in the job's own folder, leaving what DVC tracks alone.

`python -m stages.trial -m loss.mse=1.0 loss.ssim=0.0,1.0 loss.lpips=0.0,5.0` runs every combination on the sequences
that the pipeline has made, and ends with one table (polarnet.sweep). Jobs may run side by side: what a method made of a
sequence is kept once, and so each job keeps its own until it is scored.
"""

import shutil
import subprocess
import sys
from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from polarnet.config import Config, hydra_stage

# What a training run is held against; the other rows of the benchmark do not depend on it.
REFERENCE_METHODS = "benchmark.methods=[zeros,train_mean,oracle_mean,ours]"


@hydra_stage
def main(config: Config) -> None:
    """Run the train and benchmark stages as child processes with this job's overrides and folder."""
    hydra = HydraConfig.get()
    job = Path(hydra.runtime.output_dir)
    overrides = list(hydra.overrides.task)
    if not any(override.startswith("benchmark.methods=") for override in overrides):
        overrides.append(REFERENCE_METHODS)
    for stage in ("train", "benchmark"):
        folders = [f"paths.{name}={job / name}" for name in ("train", "benchmark", "cache")]
        logs = [f"hydra.run.dir={job / 'logs' / stage}"]
        subprocess.run([sys.executable, "-m", f"stages.{stage}", *overrides, *folders, *logs], check=True)
    shutil.rmtree(job / "cache")


if __name__ == "__main__":
    main()
