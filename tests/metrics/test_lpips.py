import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import skimage.data
import torch

from polarnet.metrics.lpips import BACKBONES, Lpips

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "lpips.json").read_text())


def astronaut(blur):
    """The crop and its blur, RGB in [0, 1]."""
    top, bottom, left, right = GOLDEN["crop"]
    sharp = skimage.data.astronaut()[top:bottom, left:right] / np.float32(255)
    return [torch.from_numpy(image).permute(2, 0, 1)[None] for image in (sharp, cv2.blur(sharp, (blur, blur)))]


@pytest.fixture(scope="module", params=["alex", "vgg"])
def installed(request):
    """LPIPS with the weights that the set-up installs."""
    return Lpips.load(request.param)


@pytest.mark.parametrize("blur", [3, 7, 15])
def test_alexnet_and_vgg_give_the_values_of_the_program_that_their_weights_come_from(installed, blur):
    assert installed(*astronaut(blur)).item() == pytest.approx(
        GOLDEN["distances"][installed.backbone][str(blur)], abs=2e-6
    )


@pytest.mark.thorough
def test_in_bf16_the_distance_is_within_a_percent(installed):
    pair = astronaut(7)
    with torch.autocast("cpu", torch.bfloat16):
        low = installed(*pair)
    assert low.dtype == torch.float32
    assert low.item() == pytest.approx(installed(*pair).item(), rel=0.01)


@pytest.mark.parametrize(("backbone", "parameters", "side"), [("alex", 2_469_696, 31), ("vgg", 14_714_688, 16)])
def test_a_backbone_has_torchvisions_parameters_the_heads_channels_and_a_smallest_image(backbone, parameters, side):
    distance = Lpips(backbone)
    assert sum(p.numel() for p in distance.layers.parameters()) == parameters
    features = distance.features(torch.rand(1, 64, 64))
    assert tuple(x.shape[1] for x in features) == BACKBONES[backbone].channels
    assert distance(torch.zeros(1, side, side), torch.ones(1, side, side)).isfinite().all()
    with pytest.raises(ValueError, match=rf"LPIPS \({backbone}\) needs images of {side} pixels a side"):
        distance.features(torch.zeros(1, 50, side - 1))


def test_lpips_is_0_for_equal_images_symmetric_and_reaches_the_images_but_not_their_truth():
    torch.manual_seed(0)
    distance = Lpips("alex")
    a, b = torch.rand(2, 2, 40, 48, generator=torch.Generator().manual_seed(0))
    rgb = [x[:, None].expand(-1, 3, -1, -1) for x in (a, b)]
    torch.testing.assert_close(distance(a, b), distance(*rgb))
    assert distance(a, a).tolist() == [0.0, 0.0]
    torch.testing.assert_close(distance(a, b), distance(b, a))
    distance(a.requires_grad_(), b.requires_grad_()).sum().backward()
    assert a.grad.isfinite().all()
    assert a.grad.abs().sum() > 0
    assert b.grad is None
    assert all(p.grad is None for p in distance.parameters())
    blank = torch.zeros(1, 40, 40, requires_grad=True)
    distance(blank, torch.rand(1, 40, 40)).sum().backward()
    assert blank.grad.isfinite().all()
