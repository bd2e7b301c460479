"""What all networks have in common: sizes, windows in order, gradients."""

import math

import pytest
import torch
from test_dolp_unet import SMALL
from test_stokes_unet import moving_events, network

from polarnet.networks.cista_tc.network import CistaTc
from polarnet.networks.e2p.network import E2p
from polarnet.networks.e2v.network import E2vid, FireNet
from polarnet.networks.paper.dolp_unet import DolpUNet
from polarnet.stokes import Prediction

NETWORKS = {
    "polarnet": (network, 8, None),
    "polarnet, blocks": (lambda: network(binning=2), 8, None),
    "paper": (lambda: DolpUNet(SMALL), 4, None),
    "e2vid": (lambda: E2vid(5), 5, 10_712_098),
    "firenet": (lambda: FireNet(5), 5, 37_777),
    "cista_tc": (lambda: CistaTc(5), 5, 669_763),
    "e2p": (lambda: E2p(5), 5, 512_501),
}
"""How to build a network, its input images, and its number of parameters, where it is published."""


def maps_of(output: Prediction | torch.Tensor) -> list[torch.Tensor]:
    return [field for field in output if field is not None] if isinstance(output, Prediction) else [output]


@torch.no_grad()
@pytest.mark.parametrize("name", NETWORKS)
def test_windows_at_once_are_windows_one_by_one_with_the_state_carried_and_streams_do_not_mix(name):
    torch.manual_seed(0)
    build, channels, parameters = NETWORKS[name]
    built = build().eval()
    assert parameters is None or sum(tensor.numel() for tensor in built.parameters()) == parameters
    windows, state = torch.randint(-3, 4, (4, 2, channels, 18, 22)).float(), None
    output, last = built.unroll(windows)
    together = maps_of(output)
    for number, window in enumerate(windows):
        one, state = built(window, state)
        for field, expected in zip(maps_of(one), together, strict=True):
            torch.testing.assert_close(field, expected[number], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(state, last, atol=1e-4, rtol=1e-4)
    alone, _ = built.unroll(windows[:, 1:])
    torch.testing.assert_close(maps_of(alone)[0], together[0][:, 1:], atol=1e-4, rtol=1e-4)
    assert not torch.allclose(maps_of(built(windows[-1])[0])[0], together[0][-1])  # the state matters
    if name in ("e2vid", "cista_tc"):
        assert 0 < together[0].min() < together[0].max() < 1


@torch.no_grad()
@pytest.mark.parametrize("name", ["polarnet", "polarnet, blocks", "paper"])
@pytest.mark.parametrize(("height", "width"), [(16, 24), (21, 35)])
def test_any_height_and_width_come_back_with_everything_predicted(name, height, width):
    build, channels, _ = NETWORKS[name]
    prediction, _ = build().eval()(torch.randint(-3, 4, (2, channels, height, width)).float())
    assert prediction.dolp.shape == (2, height, width)
    assert (prediction.aolp is None) == (name == "paper")
    if prediction.aolp is not None:
        assert {field.shape for field in prediction[:3]} == {(2, height, width)}
        assert prediction.stokes.shape == (2, 2, height, width)
        assert 0 <= prediction.aolp.min() <= prediction.aolp.max() < math.pi


@pytest.mark.parametrize("name", ["polarnet", "paper"])
def test_every_parameter_has_a_gradient_from_a_few_windows(name):
    build, channels, _ = NETWORKS[name]
    built = build()
    prediction, _ = built.unroll(moving_events(3, 48, 64)[:, :, :channels])
    (prediction.dolp.sum() + sum(field.square().sum() for field in maps_of(prediction)[3:])).backward()
    assert [key for key, p in built.named_parameters() if p.grad is None or not p.grad.any()] == []
