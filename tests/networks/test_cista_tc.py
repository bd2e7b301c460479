import numpy as np
import pytest
import torch

from polarnet.networks.cista_tc.network import CistaTc


@pytest.mark.shared
@torch.no_grad()
def test_the_published_weights_give_the_images_of_the_authors_network(shared):
    network = CistaTc.load(shared / "weights" / "cista_tc.pth.tar")
    assert sum(tensor.numel() for tensor in network.state_dict().values()) == 1_260_867
    with np.load(shared / "weights" / "cista_tc_check.npz") as check:
        voxels, images = torch.from_numpy(check["voxels"]), torch.from_numpy(check["images"])
    state = None
    for window, expected in zip(voxels, images, strict=True):
        image, state = network(window[None], state)
        torch.testing.assert_close(image[0], expected, atol=1e-5, rtol=0)


@torch.no_grad()
def test_any_size_gives_an_image_of_that_size_that_depends_on_the_windows_before():
    torch.manual_seed(0)
    network, window = CistaTc(5).eval(), torch.randn(2, 5, 21, 30)
    image, state = network(window)
    assert image.shape == (2, 21, 30)
    assert 0 <= image.min() <= image.max() <= 1
    assert not torch.equal(network(window, state)[0], image)
