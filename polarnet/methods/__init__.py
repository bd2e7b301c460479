"""Methods from events to DoLP: the `Method` records of all modules in this folder."""

import importlib
import pkgutil
from collections import ChainMap
from collections.abc import Mapping

from polarnet.methods.method import Method
from polarnet.metrics.references import REFERENCES, Reference


def _assembled() -> dict[str, Method]:
    """Records from the `METHODS` of each module, in alphabetical order within three groups.

    Filters come first, then networks that reconstruct intensities, then networks that predict DoLP.
    """
    modules = [importlib.import_module(f"{__name__}.{name}") for _, name, _ in pkgutil.iter_modules(__path__)]
    records = [method for module in modules for method in getattr(module, "METHODS", ())]
    records.sort(key=lambda method: (bool(method.networks), not method.reconstructs))
    by_name = {method.name: method for method in records}
    assert len(by_name) == len(records), f"two methods have one name: {[method.name for method in records]}"
    return by_name


METHODS = _assembled()
"""Method by name, in the order of all tables and figures.

>>> from polarnet.methods import METHODS
>>> METHODS["highpass"].label
'high-pass'
"""

ROWS: Mapping[str, Reference | Method] = ChainMap(METHODS, REFERENCES)  # type: ignore[arg-type]
"""Row of the tables by name, in the order of all tables: references first, then methods."""


def is_rotating(row: str) -> bool:
    """Whether a row sees one camera behind a rotating polarizer instead of four channels.

    >>> from polarnet.methods import is_rotating
    >>> is_rotating("ours")
    False
    """
    return row in METHODS and METHODS[row].rotating
