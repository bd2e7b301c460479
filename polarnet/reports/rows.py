"""Labels, colours and descriptions of the benchmark's rows: those of the methods, and of the references among them."""

from collections import ChainMap
from collections.abc import Mapping
from typing import NamedTuple

from polarnet.methods import METHODS
from polarnet.methods.method import Method

COLOUR = "#98a2b3"


class ReferenceRow(NamedTuple):
    """A row of `polarnet.benchmark.references`, whose DoLP is constant over a frame."""

    label: str
    colour: str
    about: str
    """Glossary sentence of the HTML pages."""


REFERENCES = {
    "zeros": ReferenceRow("zeros", COLOUR, "A constant: no polarization anywhere."),
    "train_mean": ReferenceRow("training mean", COLOUR, "A constant: the mean DoLP of the training split."),
    "oracle_mean": ReferenceRow(
        "oracle mean",
        COLOUR,
        "Each true frame's own mean, the best constant there is. It looks at the truth, so it is no method; what does "
        "not beat it shows little spatial skill in MSE.",
    ),
}
"""Reference by name."""

ROWS: Mapping[str, ReferenceRow | Method] = ChainMap(METHODS, REFERENCES)  # type: ignore[arg-type]
"""Reference or method by name, in the order of all tables: references first."""
