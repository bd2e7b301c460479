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
            f"{path} is not there: this version ships no weights. Give --weights FILE, the best.safetensors of a "
            f"training (`dvc repro train` leaves one in data/train/ours), or --method highpass, which needs none"
        )
    return path
