"""Names, colours and explanations of a benchmark's rows; what `ours` and `E2V` are depends on the weights."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from polarnet.reports.tables import METHODS, in_order

GAIN = "+gain"
NETWORK_NAMES = {
    "polarnet": "polarnet's network",
    "paper": "the paper's network",
    "firenet": "FireNet",
    "e2vid": "E2VID",
    "e2p": "E2P",
}
"""Networks by the name in a checkpoint."""

NAMED_BY_NETWORK = ("e2v", "paper", "ours")
"""Rows whose key does not say which network they are."""

NETWORK_COLOURS = {
    "polarnet": "#d6336c",
    "paper": "#0ca678",
    "firenet": "#3d8fd9",
    "e2vid": "#2f6fb0",
    "e2p": "#7a5cc4",
}
METHOD_COLOURS = {
    "zeros": "#98a2b3",
    "train_mean": "#98a2b3",
    "oracle_mean": "#98a2b3",
    "cf": "#e08a1e",
    "highpass": "#b0851f",
    "e2v": NETWORK_COLOURS["firenet"],
    "e2vid": NETWORK_COLOURS["e2vid"],
    "firenet": NETWORK_COLOURS["firenet"],
    "e2p": NETWORK_COLOURS["e2p"],
    "paper": NETWORK_COLOURS["paper"],
    "ours": NETWORK_COLOURS["polarnet"],
}
"""Colours of rows where nothing says which network is behind them."""

OTHER_COLOUR = "#4aa37c"

WITHOUT_WEIGHTS = {
    "zeros": "A constant: no polarization anywhere.",
    "train_mean": "A constant: the mean DoLP of the training split.",
    "oracle_mean": "Each true frame's own mean, the best constant there is. It looks at the truth, so it is no method; "
    "what does not beat it shows little spatial skill in MSE.",
    "cf": "The complementary filter without frames (Scheerlinck et al. 2018): intensity from events, one polarizer at "
    "a time, then DoLP by the Stokes formula.",
    "highpass": "The high-pass filter (Scheerlinck et al. 2018): intensity from events, one polarizer at a time, then "
    "DoLP by the Stokes formula.",
}
"""What the rows without weights are."""

NETWORK_ABOUT = {
    "polarnet": "Polarnet's own network: event counts of the four polarizers in, DoLP, AoLP and the expected error of "
    "DoLP out. It solves the redundancy of the four polarizers and refines the answer with a small recurrent U-Net.",
    "paper": "The network of the paper (its Fig. 6), in polarnet's implementation: events of the four polarizers in, "
    "DoLP out.",
    "firenet": "FireNet (Scheerlinck et al. 2020), a recurrent network from events to intensity, one polarizer at a "
    "time, then DoLP by the Stokes formula.",
    "e2vid": "E2VID (Rebecq et al. 2019), a recurrent network from events to intensity, one polarizer at a time, then "
    "DoLP by the Stokes formula.",
    "e2p": "E2P (Mei et al. 2023), a published network from events to polarization.",
}
"""What the networks are, by the name in a checkpoint."""

ROLES = {"e2v": "Events to video. ", "ours": "The DoLP network in use. "}
"""What a row stands for, whichever network it is."""

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


GENERAL = Legend(METHODS, METHOD_COLOURS)
"""Where nothing says which networks are behind the rows."""


def legend_of(weights: Mapping[str, Mapping[str, Any]]) -> Legend:
    """The legend of a benchmark from details.json's `weights`, which names the network behind each row."""
    networks = {row: file["network"] for row, file in weights.items()}
    labels, colours = dict(METHODS), dict(METHOD_COLOURS)
    colours |= {row: NETWORK_COLOURS[network] for row, network in networks.items() if network in NETWORK_COLOURS}
    for row in NAMED_BY_NETWORK:
        name = NETWORK_NAMES.get(networks.get(row, ""))
        if name and METHODS[row] != name:
            for method in (row, row + GAIN):
                if method in METHODS:
                    labels[method] = METHODS[method].replace(METHODS[row], f"{METHODS[row]}: {name}")
    if networks.get("paper", "paper") != "paper":
        labels["paper"] = f"second network: {NETWORK_NAMES.get(networks['paper'], networks['paper'])}"
    return Legend(labels, colours)


def glossary(methods: Iterable[str], weights: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Term and explanation of each row of a benchmark, in the order of its table; all solved gains have one."""
    rows, legend = in_order(methods), legend_of(weights)
    entries = [
        (legend.label(row), _about(row, weights.get(row)))
        for row in dict.fromkeys(method.removesuffix(GAIN) for method in rows)
        if row in WITHOUT_WEIGHTS or row in weights
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
    if file is None:
        return WITHOUT_WEIGHTS[row]
    origin = "trained by polarnet" if file["file"].endswith(".safetensors") else "as its authors published them"
    return f"{ROLES.get(row, '')}{NETWORK_ABOUT[file['network']]} Weights: {file['file']}, {origin}."
