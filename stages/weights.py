"""LPIPS weights -> data/weights: those that the losses and the benchmark table require; an error if missing."""

import functools

from polarnet.config.tree import Config, hydra_stage, or_exit, with_lpips
from polarnet.metrics.lpips import PURPOSES, find_weights, write_weights


@hydra_stage
def main(config: Config) -> None:
    """Search for the weights, refuse if they are missing, and record their source."""
    find = functools.cache(find_weights)  # both purposes may share a backbone
    every = or_exit(lambda: {purpose: with_lpips(config, purpose, find) for purpose in PURPOSES})
    required = {purpose: weights for purpose, weights in every.items() if weights is not None}
    write_weights(config.paths.weights, required)
    for purpose, weights in required.items():
        print(f"LPIPS of the {purpose}: {weights.backbone}, from {weights.source}")
    if not required:
        print("no LPIPS: no loss has a weight for it, and benchmark.lpips is false")


if __name__ == "__main__":
    main()
