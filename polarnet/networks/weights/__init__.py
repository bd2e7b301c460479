"""Weights that come with the package, and a function that locates them."""

from pathlib import Path


def shipped_weights() -> Path:
    """Path of the checkpoint of network `polarnet` that comes with the package; FileNotFoundError if there is none.

    >>> from polarnet.networks import shipped_weights
    >>> shipped_weights().name
    'polarnet.safetensors'
    """
    path = Path(__file__).parent / "polarnet.safetensors"
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is missing. Give --weights FILE, the best.safetensors of a training (`dvc repro train` leaves one "
            f"in data/train/ours), or --method highpass, which needs none"
        )
    return path
