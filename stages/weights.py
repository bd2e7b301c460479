"""Finds LPIPS weights -> data/weights: the tensors, or the reason why there are none, for all stages after it."""

import logging

from polarnet.config import Config, hydra_stage
from polarnet.lpips import find_weights, where_to_put, write_weights

log = logging.getLogger(__name__)

RULE = "=" * 100


@hydra_stage
def main(config: Config) -> None:
    """Search, warn or refuse where there are none, and write down which were found."""
    try:
        weights = find_weights(config.lpips)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    if weights.tensors is None:
        remedy = f"{where_to_put(config.lpips.backbone)}; then run `dvc repro --force --single-item weights`"
        if config.lpips.required:
            raise SystemExit(f"lpips.required is true, but there are no LPIPS weights: {weights.reason}; {remedy}")
        log.warning(
            "\n%s\nNO LPIPS WEIGHTS: %s.\nTraining leaves its LPIPS term out, the benchmark says lpips: null.\n"
            "To have it: %s and `dvc repro`.\n%s",
            RULE, weights.reason, remedy, RULE,
        )  # fmt: skip
    write_weights(config.paths.weights, config.lpips.backbone, weights)
    print(f"LPIPS ({config.lpips.backbone}): {weights.source or 'none'}")


if __name__ == "__main__":
    main()
