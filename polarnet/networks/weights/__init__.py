"""The weights that come with the package, and where they are."""

from pathlib import Path


def shipped_weights() -> Path:
    """The checkpoint of the network `polarnet`; FileNotFoundError, which says what to do, where there is none.

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
