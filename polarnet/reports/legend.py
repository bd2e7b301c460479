"""Names, colours and explanations of a benchmark's rows; what `ours` and `E2V` are depends on the weights."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from polarnet.evaluation.rows import ROWS
from polarnet.methods import METHODS
from polarnet.methods.intensities import GAIN
from polarnet.reports.tables import LABELS, in_order


class Network(NamedTuple):
    """A network as tables, figures and the glossary present it."""

    label: str
    colour: str
    about: str


POLARNET = Network(
    "polarnet's network",
    METHODS["ours"].colour,
    "Polarnet's own network: event counts of the four polarizers in, DoLP, AoLP and the expected error of DoLP out. It "
    "solves the redundancy of the four polarizers and refines the answer with a small recurrent U-Net.",
)
NETWORKS = {"polarnet": POLARNET} | {
    name: Network(METHODS[name].label, METHODS[name].colour, METHODS[name].about)
    for method in METHODS.values()
    if method.weights is not None
    for name in method.weights.networks
    if name in METHODS
}
"""Networks by the name in a checkpoint; but for polarnet's, each is presented as the method of its name is."""

NAMED_BY_NETWORK = ("e2v", "paper", "ours")
"""Rows whose key does not say which network they are."""

OTHER_COLOUR = "#4aa37c"
"""Colour of rows of older results that polarnet no longer has."""

GAINS = (
    "The same intensities, each polarizer's scale solved from I0 + I90 = I45 + I135 before the Stokes formula. Nothing "
    "is trained for it."
)
LPIPS_BACKBONES = {"vgg": "VGG16", "alex": "AlexNet", "squeeze": "SqueezeNet 1.1"}


class Legend(NamedTuple):
    """What tables and figures call the rows of one benchmark, and their colours; by row, gains solved or not."""

    labels: Mapping[str, str]
    colours: Mapping[str, str]

    def label(self, method: str) -> str:
        """The readable name; a row that polarnet does not know keeps its key."""
        return self.labels.get(method, method)

    def colour(self, method: str) -> str:
        """The colour of lines and dots; solved gains do not change it."""
        return self.colours.get(method.removesuffix(GAIN), OTHER_COLOUR)


GENERAL = Legend(LABELS, {name: row.colour for name, row in ROWS.items()})
"""Where nothing says which networks are behind the rows."""


def legend_of(weights: Mapping[str, Mapping[str, Any]]) -> Legend:
    """The legend of a benchmark from details.json's `weights`, which names the network behind each row."""
    networks = {row: file["network"] for row, file in weights.items()}
    labels, colours = dict(GENERAL.labels), dict(GENERAL.colours)
    colours |= {row: NETWORKS[network].colour for row, network in networks.items() if network in NETWORKS}
    for row in NAMED_BY_NETWORK:
        network = NETWORKS.get(networks.get(row, ""))
        if network and LABELS[row] != network.label:
            for method in (row, row + GAIN):
                if method in LABELS:
                    labels[method] = LABELS[method].replace(LABELS[row], f"{LABELS[row]}: {network.label}")
    if networks.get("paper", "paper") != "paper":
        labels["paper"] = f"second network: {network_label(networks['paper'])}"
    return Legend(labels, colours)


def network_label(network: str) -> str:
    """The readable name of a network; one that polarnet does not know keeps the name in its checkpoint."""
    return NETWORKS[network].label if network in NETWORKS else network


def glossary(methods: Iterable[str], weights: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Term and explanation of each row of a benchmark, in the order of its table; all solved gains have one."""
    rows, legend = in_order(methods), legend_of(weights)
    entries = [
        (legend.label(row), _about(row, weights.get(row)))
        for row in dict.fromkeys(method.removesuffix(GAIN) for method in rows)
        if row in weights or (row in ROWS and ROWS[row].about and not _needs_weights(row))
    ]
    return entries + ([("gains solved", GAINS)] if any(method.endswith(GAIN) for method in rows) else [])


def lpips_about(lpips: Mapping[str, Any]) -> str | None:
    """What LPIPS is, with the backbone that details.json's `lpips` names; None where the table has no such column."""
    if lpips["backbone"] is None:
        return None
    backbone = LPIPS_BACKBONES.get(lpips["backbone"], lpips["backbone"])
    return (
        f"Learned perceptual distance, version 0.1, with {backbone} as its backbone, of DoLP as a grey picture. Values "
        "of different backbones cannot be compared; the paper's backbone is VGG16."
    )


def _about(row: str, file: Mapping[str, Any] | None) -> str:
    """Description of a row: its network's where it has one, after what the row itself stands for."""
    about = ROWS[row].about if row in ROWS else ""
    if file is None:
        return about
    if network := NETWORKS.get(file["network"]):
        about = network.about if row in NETWORKS else f"{about} {network.about}".lstrip()
    origin = "trained by polarnet" if file["file"].endswith(".safetensors") else "as its authors published them"
    return f"{about} Weights: {file['file']}, {origin}.".lstrip()


def _needs_weights(row: str) -> bool:
    return row in METHODS and METHODS[row].weights is not None
