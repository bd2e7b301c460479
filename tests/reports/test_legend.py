import pytest

from polarnet.reports.legend import GENERAL, NETWORKS, glossary, legend_of


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
    entries = dict(glossary(["cf", "cf+gain", "ours"], legend_of(weights(ours="paper"))))
    assert list(entries) == ["CF", "ours: the paper's network", "gains solved"]
    assert "gains solved" not in dict(glossary(["cf"], GENERAL))
