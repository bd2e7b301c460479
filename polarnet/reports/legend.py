"""Order, labels, colours and descriptions of a benchmark's rows, which are methods and references.

The networks behind `ours` and `E2V` depend on the weights.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from polarnet.methods import METHODS, ROWS
from polarnet.methods.intensities import GAIN
from polarnet.metrics.references import REFERENCES

LABELS: Mapping[str, str] = {name: row.label for name, row in ROWS.items()}
"""Default labels of the rows, in table order, for results that do not name the networks."""


class Network(NamedTuple):
    """Label and colour of a network in tables and figures."""

    label: str
    colour: str


NETWORKS = {name: Network(METHODS[name].label, METHODS[name].colour) for name in ("paper", "e2p", "cista_tc")} | {
    "polarnet": Network("polarnet's network", METHODS["ours"].colour),
    "e2vid": Network("E2VID", METHODS["e2vid_published"].colour),
    "firenet": Network("FireNet", METHODS["firenet_published"].colour),
}
"""Networks by their name in a checkpoint."""

NAMED_BY_NETWORK = ("e2v", "paper", "ours")  # rows whose key does not name their network

OTHER_COLOUR = "#4aa37c"  # colour of rows in older results that polarnet no longer has

GAINS = (
    "The same intensities, each polarizer's scale solved from I0 + I90 = I45 + I135 before the Stokes formula. Nothing "
    "is trained for it."
)
LPIPS_BACKBONES = {"vgg": "VGG16", "alex": "AlexNet"}


class Legend(NamedTuple):
    """Labels and colours of the rows of one benchmark, with and without solved gains."""

    labels: Mapping[str, str]
    colours: dict[str, str]

    def label(self, method: str) -> str:
        """The label of a row; an unknown row keeps its key."""
        return self.labels.get(method, method)

    def colour(self, method: str) -> str:
        """The colour of a row's lines and dots, the same with solved gains."""
        return self.colours.get(method.removesuffix(GAIN), OTHER_COLOUR)


GENERAL = Legend(LABELS, {name: row.colour for name, row in ROWS.items()})
"""Legend for results that do not name the networks behind the rows."""


def in_order(rows: Iterable[str]) -> list[str]:
    """Rows in the order of every table and figure; unknown rows, from older results, come last."""
    given = list(rows)
    return [name for name in ROWS if name in given] + [name for name in given if name not in ROWS]


def with_structure(rows: Iterable[str]) -> list[str]:
    """Rows in order, without the references, which predict one value everywhere."""
    return [name for name in in_order(rows) if name not in REFERENCES]


def legend_of(weights: Mapping[str, Mapping[str, Any]]) -> Legend:
    """The legend of a benchmark, from details.json's `weights`, which name the network behind each row."""
    networks = {row: file["network"] for row, file in weights.items() if file["network"] in NETWORKS}
    labels = dict(LABELS)
    for row, network in networks.items():
        if row in NAMED_BY_NETWORK and LABELS[row] != NETWORKS[network].label:
            own = "second network" if row == "paper" else LABELS[row]
            labels[row] = f"{own}: {NETWORKS[network].label}"
            if row + GAIN in LABELS:
                labels[row + GAIN] = LABELS[row + GAIN].replace(LABELS[row], labels[row])
    return Legend(labels, GENERAL.colours | {row: NETWORKS[network].colour for row, network in networks.items()})


def network_label(network: str) -> str:
    """The label of a network; an unknown network keeps its name in the checkpoint."""
    return NETWORKS[network].label if network in NETWORKS else network


def glossary(methods: Iterable[str], legend: Legend) -> list[tuple[str, str]]:
    """Label and description of the rows of a benchmark that have one; rows with solved gains share an entry."""
    rows = in_order(methods)
    described = [row for row in rows if row in ROWS and ROWS[row].about and not row.endswith(GAIN)]
    entries = [(legend.label(row), ROWS[row].about) for row in described]
    return entries + ([("gains solved", GAINS)] if any(row.endswith(GAIN) for row in rows) else [])
