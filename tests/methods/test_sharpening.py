import torch

from polarnet.methods.intensity_networks import blur_kernel, sharper
from polarnet.methods.method import SharpeningConfig


def test_switched_off_it_only_clips():
    images = torch.linspace(-1, 2, 4 * 6 * 7).view(1, 4, 6, 7)
    assert torch.equal(sharper(images, SharpeningConfig(0.0, 1.0)), images.clamp(0, 1))


def test_the_unsharp_mask_leaves_flat_images_alone_and_overshoots_at_an_edge():
    flat = torch.full((1, 1, 8, 9), 0.4)
    torch.testing.assert_close(sharper(flat, SharpeningConfig(0.3, 1.0)), flat)
    edge = torch.zeros(1, 1, 8, 10)
    edge[..., 5:] = 0.5
    sharp = sharper(0.25 + edge, SharpeningConfig(0.3, 1.0))[0, 0, 4] - 0.25
    beyond = blur_kernel(1.0)[:, :2].sum()  # what the blur brings over the edge to the first bright pixel
    torch.testing.assert_close(sharp[5], 0.5 + 0.15 * beyond.float())
    torch.testing.assert_close(sharp[4], -0.15 * beyond.float())
    torch.testing.assert_close(sharp[[0, 9]], torch.tensor([0.0, 0.5]))


def test_the_kernel_is_the_published_one():
    # for sigma 1 the bins of the standard normal end at -1.3, -0.78, -0.26, 0.26, 0.78 and 1.3
    middle, near, far = 0.205136, 0.179737, 0.120895  # from a table of its distribution
    kernel = blur_kernel(1.0)
    torch.testing.assert_close(kernel.sum().item(), 1.0)
    torch.testing.assert_close((kernel[2, 1] / kernel[2, 2]).item(), (near / middle) ** 0.5, atol=1e-5, rtol=0)
    torch.testing.assert_close((kernel[0, 2] / kernel[2, 2]).item(), (far / middle) ** 0.5, atol=1e-5, rtol=0)
