import pytest

from polarnet.methods import METHODS, ROWS
from polarnet.reports.legend import NETWORKS, glossary, legend_of


def weights(**networks):
    return {row: {"file": "best.safetensors", "sha256": "0" * 64, "network": name} for row, name in networks.items()}


@pytest.mark.parametrize(
    ("row", "section", "network", "label"),
    [
        ("ours", "ours", "polarnet", "ours: polarnet's network"),
        ("ours", "ours", "paper", "ours: the paper's network"),
        ("e2v", "e2v", "e2vid", "E2V: E2VID"),
        ("e2v+gain", "e2v", "e2vid", "E2V: E2VID, gains solved"),
        ("paper", "paper", "paper", "the paper's network"),
        ("paper", "paper", "polarnet", "second network: polarnet's network"),
    ],
)
def test_a_row_is_named_and_coloured_after_the_network_behind_it(row, section, network, label):
    legend = legend_of(weights(**{section: network}))
    assert (legend.label(row), legend.colour(row)) == (label, NETWORKS[network].colour)


def test_the_glossary_has_the_rows_of_the_table_and_no_other():
    entries = dict(glossary(["cf", "cf+gain", "e2v", "ours"], weights(e2v="firenet", ours="paper")))
    assert list(entries) == ["CF", "E2V: FireNet", "ours: the paper's network", "gains solved"]
    assert "Fig. 6" in entries["ours: the paper's network"]
    assert "FireNet (Scheerlinck et al. 2020)" in entries["E2V: FireNet"]
    assert "gains solved" not in dict(glossary(["cf"], {}))


def test_every_method_is_explained_with_the_weights_that_it_takes():
    files = {
        name: {"file": "weights.pth.tar", "sha256": "0" * 64, "network": method.networks[0]}
        for name, method in METHODS.items()
        if method.networks and method.wraps is None
    }
    entries = dict(glossary(ROWS, files))
    assert len(entries) == len([name for name in ROWS if not name.endswith("+gain")]) + 1  # and the solved gains
    assert all(len(about) > 30 for about in entries.values())
    assert entries["CISTA-TC, published weights"].startswith("CISTA-TC (Liu and Dragotti 2022), a recurrent network")
    assert entries["E2V: FireNet"].startswith("Events to video. FireNet (Scheerlinck et al. 2020)")
