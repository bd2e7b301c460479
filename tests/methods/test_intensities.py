import dataclasses
import math

import pytest
import torch

from polarnet.methods.intensities import consistent, gains, solved
from polarnet.methods.intensity_networks import blur_kernel, sharper
from polarnet.methods.method import GainConfig
from polarnet.stokes import dolp, intensities_from_stokes, stokes_from_intensities, stokes_from_polarization

CONFIG = GainConfig(window_frames=10, rounds=5, pixels=20_000, smallest=0.1, pull=0.0)
HEIGHT, WIDTH = 60, 80


def smooth(generator, low, high):
    """A field of low frequencies between two values."""
    coarse = torch.rand(1, 1, 5, 6, generator=generator)
    fine = torch.nn.functional.interpolate(coarse, (HEIGHT, WIDTH), mode="bicubic").clamp(0, 1)[0, 0]
    return low + (high - low) * fine


def scene(seed):
    """DoLP and the four intensities behind the polarizers."""
    generator = torch.Generator().manual_seed(seed)
    truth = smooth(generator, 0.0, 0.9)
    stokes = stokes_from_polarization(smooth(generator, 0.1, 1.0), truth, smooth(generator, 0.0, math.pi))
    return truth, intensities_from_stokes(stokes), generator


def psnr(intensities, truth):
    error = (dolp(stokes_from_intensities(intensities)).clamp(0, 1) - truth).square().mean()
    return -10 * math.log10(max(error.item(), 1e-12))


def spoilt(seed, log_noise):
    """Truth, and intensities times unknown factors of e^-0.5 to e^0.5 and noise in proportion to them."""
    truth, intensities, generator = scene(seed)
    factors = torch.exp(torch.rand(4, generator=generator) - 0.5)
    noise = torch.exp(log_noise * torch.randn(intensities.shape, generator=generator))
    return truth, intensities * noise, (intensities * noise * factors[:, None, None])[None]


@pytest.mark.parametrize("seed", range(4))
def test_without_noise_unknown_factors_are_solved_to_more_than_40_db(seed):
    truth, _, unknown = spoilt(seed, 0.0)
    assert psnr(unknown[0], truth) < 28
    assert psnr(consistent(unknown, CONFIG)[0], truth) > 40


@pytest.mark.parametrize(("log_noise", "lost_db"), [(0.05, 1.5), (0.1, 2.5), (0.2, 3.5)])
def test_with_noise_little_is_lost_against_known_factors(log_noise, lost_db):
    known, left, solved_for = [], [], []
    for seed in range(6):
        truth, true_scale, unknown = spoilt(seed, log_noise)
        known.append(psnr(true_scale, truth))
        left.append(psnr(unknown[0], truth))
        solved_for.append(psnr(consistent(unknown, CONFIG)[0], truth))
    assert sum(solved_for) / 6 > sum(known) / 6 - lost_db
    assert sum(solved_for) / 6 > sum(left) / 6 + 1.5


def test_gains_of_a_hand_worked_pair_of_pixels():
    # 2 I0 + I90 = I45 + I135 holds at both, and another direction leaves a residual
    residuals = torch.tensor([[0.5, -1.0, 1.0, -1.0], [1.0, -1.0, 0.0, -1.0], [0.25, -0.75, 1.0, -0.75],
                              [0.5, -0.75, 0.5, -0.75], [0.5, -0.5, 0.75, -1.25]], dtype=torch.float64)  # fmt: skip
    solution = solved(residuals, CONFIG)
    torch.testing.assert_close(
        solution / solution[1], torch.tensor([2.0, 1.0, 1.0, 1.0], dtype=torch.float64), atol=1e-5, rtol=0
    )
    assert solution.log().mean().abs() < 1e-9


def test_gains_look_at_no_later_frame_stay_positive_and_follow_a_strong_pull():
    frames = torch.cat([spoilt(seed, 0.1)[2] for seed in range(4)])
    config = dataclasses.replace(CONFIG, window_frames=2)
    every = gains(frames, config)
    torch.testing.assert_close(gains(frames[:3], config), every[:3])
    torch.testing.assert_close(gains(frames[2:], config)[1:], every[3:])
    torch.manual_seed(0)
    for _ in range(20):
        frames = torch.rand(2, 4, 6, 7) ** 4
        solution = gains(frames, CONFIG)
        assert (solution > 0).all()
        torch.testing.assert_close(solution.log().mean(1), torch.zeros(2, dtype=torch.float64))
        torch.testing.assert_close(gains(100 * frames, CONFIG), solution)
    _, _, unknown = spoilt(2, 0.1)
    images = consistent(unknown, dataclasses.replace(CONFIG, pull=1e6))[0]
    brightness = images.square().mean((1, 2)).sqrt()
    torch.testing.assert_close(brightness / brightness.mean(), torch.ones(4), atol=1e-4, rtol=0)


def test_the_unsharp_mask_leaves_flat_images_alone_and_overshoots_at_an_edge():
    flat = torch.full((1, 1, 8, 9), 0.4)
    torch.testing.assert_close(sharper(flat), flat)
    edge = torch.zeros(1, 1, 8, 10)
    edge[..., 5:] = 0.5
    sharp = sharper(0.25 + edge)[0, 0, 4] - 0.25
    beyond = blur_kernel()[:, :2].sum()  # what the blur brings over the edge to the first bright pixel
    torch.testing.assert_close(sharp[5], 0.5 + 0.15 * beyond.float())
    torch.testing.assert_close(sharp[4], -0.15 * beyond.float())
    torch.testing.assert_close(sharp[[0, 9]], torch.tensor([0.0, 0.5]))


def test_the_kernel_is_the_published_one():
    # for sigma 1 the bins of the standard normal end at -1.3, -0.78, -0.26, 0.26, 0.78 and 1.3
    middle, near, far = 0.205136, 0.179737, 0.120895  # from a table of its distribution
    kernel = blur_kernel()
    torch.testing.assert_close(kernel.sum().item(), 1.0)
    torch.testing.assert_close((kernel[2, 1] / kernel[2, 2]).item(), (near / middle) ** 0.5, atol=1e-5, rtol=0)
    torch.testing.assert_close((kernel[0, 2] / kernel[2, 2]).item(), (far / middle) ** 0.5, atol=1e-5, rtol=0)
