import math

import pytest
import torch

from polarnet.networks.polarnet.panorama import Memory, Motion, Panorama, displacements, empty_panorama, follow

MEMORY = Memory(prior=1.0, noise=0.01, drift=0.01, renewal=0.15, fade=0.95)
HEIGHT, WIDTH, MARGIN = 44, 60, 16


def scene(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Random log intensities behind four polarizers, in steps, at any place of an endless plane."""
    generator = torch.Generator().manual_seed(0)
    across, down = (torch.randn(4, 40, 1, 1, generator=generator) * 0.5 for _ in range(2))
    phase = torch.rand(4, 40, 1, 1, generator=generator) * 2 * math.pi
    return torch.sin(across * x + down * y + phase).sum(1) / 2


def views(places: list[tuple[float, float]]) -> torch.Tensor:
    """Images [n, 4, h, w] of a sensor whose first pixel lies at these (x, y)."""
    rows, columns = torch.arange(HEIGHT).view(-1, 1), torch.arange(WIDTH)
    return torch.stack([scene(columns + x, rows + y) for x, y in places])


def path(count: int) -> list[tuple[float, float]]:
    """Places along a circle: motion in all directions, 2.8 pixels a window."""
    return [(9 * math.cos(0.31 * k), 9 * math.sin(0.31 * k)) for k in range(count)]


def motion_between(places: list[tuple[float, float]], k: int) -> Motion:
    (x0, y0), (x1, y1) = places[k : k + 2]
    return Motion(torch.tensor([[x1 - x0, y1 - y0]]), torch.tensor([True]))


def followed(places: list[tuple[float, float]], noise: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The panorama after the last window, sums of events, and what the sensor then sees; each [4, h, w], means 0.

    The events have errors of this standard deviation, which the filter is told.
    """
    memory = MEMORY._replace(drift=max(MEMORY.drift, noise**2))
    changes = views(places).diff(dim=0)
    changes = changes + noise * torch.randn(changes.shape, generator=torch.Generator().manual_seed(1))
    panorama = empty_panorama(changes[:1], MARGIN)
    for k, change in enumerate(changes):
        panorama = follow(change[None], motion_between(places, k), panorama, memory)
    level, truth = panorama.level[0, :, :HEIGHT, :WIDTH], views(places[-1:])[0]
    return tuple(image - image.mean((-1, -2), keepdim=True) for image in (level, changes.sum(0), truth))  # type: ignore[return-value]


@pytest.mark.parametrize("speed", [(3.0, 0.0), (0.0, 2.0), (5.0, 4.0), (-2.4, 1.3), (0.5, -6.7)])
def test_the_motion_is_found_in_the_events_of_two_windows(speed):
    images = views([(k * speed[0], k * speed[1]) for k in range(4)])
    motion = displacements(images.diff(dim=0).sum(1, keepdim=True).round(), reach=8)
    assert motion.reliable.all()
    torch.testing.assert_close(motion.displacement, torch.tensor(speed).expand(2, 1, 2), atol=0.25, rtol=0)


def test_windows_that_differ_have_no_motion_and_one_hot_pixel_hides_none():
    one, other = torch.randn(2, 1, 120, 180, generator=torch.Generator().manual_seed(0))
    nothing = torch.zeros_like(one)
    assert not displacements(torch.stack([nothing, one, other, nothing, nothing]), reach=6).reliable.any()
    small = torch.randn(1, 1, 8, 8, generator=torch.Generator().manual_seed(0)).repeat(2, 1, 1, 1)  # than the reach
    torch.testing.assert_close(displacements(small, 40).displacement, torch.zeros(1, 1, 2), atol=0.5, rtol=0)
    changes = [views([(k * x, k * y) for k in range(3)]).diff(dim=0).sum(1, keepdim=True) for x, y in ((4, 1), (2, 0))]
    images = torch.cat(changes, dim=1).round()
    images[:, 0, 20, 30] = 500.0
    together = displacements(images, reach=8)
    torch.testing.assert_close(together.displacement[0], torch.tensor([[4.0, 1.0], [2.0, 0.0]]), atol=0.3, rtol=0)
    for stream in range(2):
        alone = displacements(images[:, stream : stream + 1], reach=8)
        torch.testing.assert_close(together.displacement[:, stream], alone.displacement[:, 0])


def test_following_the_motion_shows_the_scene_where_sums_show_changes_and_noise():
    level, sums, truth = followed(path(31), noise=0.0)
    variance = truth.square().mean()
    assert (level - truth).square().mean() < 0.06 * variance
    assert (sums - truth).square().mean() > 0.5 * variance
    noisy, _, _ = followed(path(31), noise=0.5)
    assert (noisy - level).square().mean() < 0.01 * 30 * 0.5**2  # a share of the noise of the sums


def test_without_motion_the_picture_changes_as_the_pixels_do_and_streams_are_followed_one_by_one():
    places = path(6)
    changes = views(places).diff(dim=0)
    panorama = empty_panorama(changes[:1], MARGIN)
    for n, change in enumerate(changes[:-1]):
        panorama = follow(change[None], motion_between(places, n), panorama, MEMORY)
    lost = Motion(torch.tensor([[2.0, 1.0]]), torch.tensor([False]))
    after = follow(changes[-1:], lost, panorama, MEMORY)
    torch.testing.assert_close(after.own, panorama.own + changes[-1:])
    torch.testing.assert_close(after.level[..., :HEIGHT, :WIDTH], after.own, atol=1e-4, rtol=0)
    both = Motion(*(torch.cat(pair) for pair in zip(lost, motion_between(places, 4), strict=True)))
    together = follow(changes[[-1, -1]], both, Panorama(*(torch.cat([x, x]) for x in panorama)), MEMORY)
    other = follow(changes[-1:], motion_between(places, 4), panorama, MEMORY)
    for image, one, two in zip(together, after, other, strict=True):
        torch.testing.assert_close(image, torch.cat([one, two]), atol=1e-5, rtol=1e-5)


def test_one_window_by_hand():
    change = torch.zeros(1, 2, 16, 16)
    change[:, :, 4, 5], change[:, :, 4, 6] = -1.0, 1.0  # what was bright at column 6 came to column 5 ...
    motion = Motion(torch.tensor([[1.0, 0.0]]), torch.tensor([True]))
    memory = Memory(prior=2.0, noise=0.3, drift=0.2, renewal=0.0, fade=0.5)
    panorama = follow(change, motion, empty_panorama(change, 16), memory)
    down, across = (torch.fft.fftfreq(32) * 2 * math.pi)[:, None], torch.fft.rfftfreq(32) * 2 * math.pi
    before = 2 / (down.square() + across.square()).clamp(min=(2 * math.pi / 32) ** 2)  # variance of either error
    step = 2 - 2 * torch.cos(across)  # |exp(i f) - 1|^2
    spread = before * step + 0.2 + 0.3
    # both errors were minus the scene; that of the level has moved: (1 - exp(i f)) of it shows in the difference
    difference = torch.exp(-4j * down) * (torch.exp(-6j * across) - torch.exp(-5j * across))
    level = torch.fft.irfft2(before * (1 - torch.exp(1j * across)) / spread * difference, s=(32, 32))
    own = torch.fft.irfft2((before * (1 - torch.exp(-1j * across)) + 0.2) / spread * difference, s=(32, 32))
    for channel in range(2):
        torch.testing.assert_close(panorama.level[0, channel], level, atol=1e-5, rtol=0)
        torch.testing.assert_close(panorama.own[0, channel], change[0, channel] - own[:16, :16], atol=1e-5, rtol=0)
    torch.testing.assert_close(panorama.explained[0, 0], before.square() * step / spread, atol=1e-4, rtol=1e-5)
    own_alone = (before * (1 - torch.exp(-1j * across)) + 0.2).abs().square()
    torch.testing.assert_close(panorama.explained[0, 1], own_alone / spread - 0.2, atol=1e-4, rtol=1e-5)
    unchecked = memory._replace(noise=1e12)  # so noisy that nothing is corrected: what was known moves on, and fades
    later = follow(torch.zeros_like(change), motion, panorama, unchecked).level[0, 0]
    moved = panorama.level[0, 0].roll(-1, dims=-1)
    torch.testing.assert_close(later[:16, :16], moved[:16, :16], atol=1e-5, rtol=0)
    torch.testing.assert_close(later[:, 16:], 0.5 * moved[:, 16:], atol=1e-5, rtol=0)  # out of sight
