import math
import pathlib

import numpy as np
import pytest
import torch

from polarnet.networks.e2p.network import E2p, MosaicHead, angle_of, coded_aolp, decoded_aolp, interleaved


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return E2p(5)


def test_four_channels_are_laid_out_as_the_mosaic_90_45_over_135_0():
    channels = torch.stack([torch.full((1, 2, 3), float(angle)) for angle in (0, 45, 90, 135)])
    mosaic = interleaved(channels)
    assert mosaic.shape == (1, 4, 6)
    assert mosaic[0, 0].tolist() == mosaic[0, 2].tolist() == [90, 45, 90, 45, 90, 45]
    assert mosaic[0, 1].tolist() == mosaic[0, 3].tolist() == [135, 0, 135, 0, 135, 0]


@torch.no_grad()
def test_each_convolution_of_the_first_layer_is_centred_on_one_polarizer():
    head = MosaicHead(1)
    for pattern in (head.pattern1, head.pattern2, head.pattern3, head.pattern4):
        torch.nn.init.zeros_(pattern.weight)
        torch.nn.init.zeros_(pattern.bias)
        pattern.weight[:, 0, 1, 1] = 1.0  # the middle of the 3x3
    torch.nn.init.zeros_(head.conv.weight)
    torch.nn.init.zeros_(head.conv.bias)  # every channel weighs sigmoid(0) = 1/2
    channels = torch.rand(1, 4, 1, 3, 4)
    features = 2 * head(interleaved(channels))
    for group, angle in enumerate((90, 45, 135, 0)):
        torch.testing.assert_close(features[:, 8 * group], channels[:, angle // 45, 0])


def test_aolp_is_coded_from_minus_90_to_90_degrees_or_as_sine_then_cosine_of_twice_the_angle():
    angles = torch.tensor([0.0, 45, 89, 90, 135]).deg2rad().view(1, 1, 5)
    code, none = coded_aolp(angles), 0 * angles
    torch.testing.assert_close(code.flatten(), torch.tensor([90.0, 135, 179, 0, 45]) / 180)
    torch.testing.assert_close(angle_of(torch.stack([none, code, none], dim=1)), angles)
    both = [3 * torch.sin(2 * angles), 3 * torch.cos(2 * angles)]
    torch.testing.assert_close(angle_of(torch.stack([none, *both, none], dim=1)), angles)
    outside = decoded_aolp(torch.linspace(-3, 3, 601).view(1, 1, -1))
    assert 0 <= outside.min() <= outside.max() < math.pi


def by_the_authors_names(network):
    letters = {"intensity": "i", "aolp": "a", "dolp": "d"}
    theirs = {}
    for name, tensor in network.state_dict().items():
        parts = name.split(".")
        if parts[0] == "branches":
            parts = [f"{parts[2]}_{letters[parts[1]]}", *parts[3:]]
        if parts[1].startswith("pattern") or (parts[0].startswith("fusion") and parts[1] != "conv4"):
            parts.insert(2, "0")
        theirs[".".join(parts)] = tensor
    return theirs


class AuthorsConfig:
    """The published files hold an object of the authors' `parse_config.ConfigParser`, with paths and numbers in it."""

    def __init__(self):
        self.save_dir, self.loss = pathlib.PurePosixPath("saved/models"), np.float64(0.5)

    def __setstate__(self, state):
        raise AssertionError("code of the authors was run")


@pytest.mark.parametrize("aolp_channels", [1, 2])
def test_a_published_file_of_either_head_loads_beside_its_authors_objects_which_are_not_run(aolp_channels, tmp_path):
    """head_i.pattern1.0, head_i.conv, G1_i.reset_gate, R2_i.conv1, pred_i, fusion_weight1.conv1.0 and so on."""
    torch.manual_seed(2)
    network = E2p(5, aolp_channels=aolp_channels)
    theirs = by_the_authors_names(network)
    assert {"head_i.pattern1.0.weight", "fusion_weight2.conv4.weight", "head_a.conv.bias"} < theirs.keys()
    content = {"arch": "V16", "epoch": 3, "state_dict": theirs, "config": AuthorsConfig()}
    torch.save(content, tmp_path / "e2p.pth")
    loaded = E2p.load(tmp_path / "e2p.pth")
    assert loaded.state_dict().keys() == network.state_dict().keys()
    assert all(torch.equal(loaded.state_dict()[name], tensor) for name, tensor in network.state_dict().items())
    with torch.no_grad():
        assert loaded(torch.randn(1, 5, 32, 32))[0].shape == (1, 2 + aolp_channels, 16, 16)


@pytest.mark.parametrize("shape", [(1, 4, 32, 32), (1, 5, 31, 32), (1, 5, 14, 32)])
def test_other_inputs_are_refused_and_those_that_the_gate_would_pool_away(network, shape):
    with pytest.raises(ValueError, match="this E2P takes 5 bins of even height and width, at least 16, got"):
        network(torch.zeros(shape))
