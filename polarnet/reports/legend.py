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
    """Label, colour and description of a network in tables, figures and the glossary."""

    label: str
    colour: str
    about: str


RECONSTRUCTS = "a recurrent network from events to intensity, one polarizer at a time, then DoLP by the Stokes formula."
NETWORKS = {
    name: Network(METHODS[name].label, METHODS[name].colour, METHODS[name].about)
    for name in ("paper", "e2p", "cista_tc")
} | {
    "polarnet": Network(
        "polarnet's network",
        METHODS["ours"].colour,
        "Polarnet's own network: event counts of the four polarizers in, DoLP, AoLP and the expected error of DoLP "
        "out. It solves the redundancy of the four polarizers and refines the answer with a small recurrent U-Net.",
    ),
    "e2vid": Network("E2VID", METHODS["e2vid_published"].colour, f"E2VID (Rebecq et al. 2019), {RECONSTRUCTS}"),
    "firenet": Network(
        "FireNet", METHODS["firenet_published"].colour, f"FireNet (Scheerlinck et al. 2020), {RECONSTRUCTS}"
    ),
}
"""Networks by their name in a checkpoint."""

NAMED_BY_NETWORK = ("e2v", "paper", "ours")
"""Rows whose key does not name their network."""

OTHER_COLOUR = "#4aa37c"
"""Colour of rows in older results that polarnet no longer has."""

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


def glossary(methods: Iterable[str], weights: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Term and explanation of each row of a benchmark, in table order; all rows with solved gains share one entry."""
    rows, legend = in_order(methods), legend_of(weights)
    entries = [
        (legend.label(row), _about(row, weights.get(row)))
        for row in dict.fromkeys(method.removesuffix(GAIN) for method in rows)
        if row in weights or (row in ROWS and ROWS[row].about and (row not in METHODS or not METHODS[row].networks))
    ]
    return entries + ([("gains solved", GAINS)] if any(method.endswith(GAIN) for method in rows) else [])


def _about(row: str, file: Mapping[str, Any] | None) -> str:
    """Description of a row, followed by that of its network if it has one."""
    about = ROWS[row].about if row in ROWS else ""
    if file is None:
        return about
    if network := NETWORKS.get(file["network"]):
        about = network.about if row in NETWORKS else f"{about} {network.about}".lstrip()
    origin = "trained by polarnet" if file["file"].endswith(".safetensors") else "as its authors published them"
    return f"{about} Weights: {file['file']}, {origin}.".lstrip()
