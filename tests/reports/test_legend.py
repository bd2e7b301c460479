import pytest

from polarnet.methods import METHODS, ROWS
from polarnet.reports.legend import NETWORKS, glossary, legend_of, lpips_about


def weights(**networks):
    return {row: {"file": "best.safetensors", "sha256": "0" * 64, "network": name} for row, name in networks.items()}


@pytest.mark.parametrize(
    ("network", "label"), [("polarnet", "ours: polarnet's network"), ("paper", "ours: the paper's network")]
)
def test_ours_is_named_and_coloured_after_the_network_behind_it(network, label):
    legend = legend_of(weights(ours=network))
    assert legend.label("ours") == label
    assert legend.colour("ours") == NETWORKS[network].colour


def test_e2v_is_named_after_its_network_with_and_without_solved_gains():
    legend = legend_of(weights(e2v="e2vid"))
    assert legend.label("e2v") == "E2V: E2VID"
    assert legend.label("e2v+gain") == "E2V: E2VID, gains solved"
    assert legend.colour("e2v+gain") == NETWORKS["e2vid"].colour


def test_a_second_network_that_is_not_the_papers_is_not_called_the_papers():
    assert legend_of(weights(paper="paper")).label("paper") == "the paper's network"
    assert legend_of(weights(paper="polarnet")).label("paper") == "second network: polarnet's network"


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


@pytest.mark.parametrize(("backbone", "name"), [("vgg", "VGG16"), ("alex", "AlexNet")])
def test_lpips_is_explained_with_its_backbone(backbone, name):
    assert f"with {name} as its backbone" in lpips_about({"backbone": backbone})
