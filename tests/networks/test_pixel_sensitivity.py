import torch

from polarnet.networks.polarnet.sensitivity import MISMATCH, WEIGHTS, Equaliser

WINDOWS, HEIGHT, WIDTH = 40, 48, 64


def counts(sensitivity: torch.Tensor, windows: int = WINDOWS) -> tuple[torch.Tensor, torch.Tensor]:
    """ON and OFF events of pixels with relative `sensitivity` [8, h, w] that all see the same swings of light."""
    rates = 2 * sensitivity.expand(windows, 1, 8, HEIGHT, WIDTH)
    events = (rates.cumsum(0) + 0.5).floor().diff(dim=0, prepend=torch.zeros_like(rates[:1]))
    on, off = events.split(4, dim=2)
    return on - off, on + off


def spread(values: torch.Tensor) -> float:
    return float(values.std() / values.mean())


@torch.no_grad()
def test_pixels_that_fire_more_for_the_same_light_weigh_less():
    torch.manual_seed(0)
    polarity, events = counts(torch.empty(8, HEIGHT, WIDTH).uniform_(0.5, 1.5))
    equalised, _ = Equaliser()(polarity, events, [])
    assert spread(events[10:].sum(0)) > 0.19
    assert spread(equalised.events[10:].sum(0)) < 0.1
    assert abs(equalised.mismatch[-1].item() - 1 / 12) < 0.02  # variance of the uniform distribution


@torch.no_grad()
def test_on_and_off_events_of_a_pixel_are_weighted_apart():
    torch.manual_seed(0)
    polarity, events = counts(torch.empty(8, HEIGHT, WIDTH).uniform_(0.5, 1.5))
    equalised, _ = Equaliser()(polarity, events, [])
    drift, left = (one[10:].sum(0).abs().mean() for one in (polarity, equalised.polarity))
    assert left < 0.4 * drift


@torch.no_grad()
def test_a_sensor_without_mismatch_keeps_its_events():
    polarity, events = counts(torch.ones(8, HEIGHT, WIDTH))
    equalised, _ = Equaliser()(polarity, events, [])
    torch.testing.assert_close(equalised.events, events)
    torch.testing.assert_close(equalised.polarity, polarity)
    torch.testing.assert_close(equalised.mismatch, torch.full((WINDOWS, 1), MISMATCH[0]))


@torch.no_grad()
def test_edges_of_the_scenes_activity_are_no_mismatch():
    busy = torch.ones(8, HEIGHT, WIDTH)
    busy[:, :, WIDTH // 2 :] = 3
    equalised, _ = Equaliser()(*counts(busy), [])
    far = equalised.events[-10:].sum(0)
    assert abs(far[..., -8:].mean() / far[..., :8].mean() - 3) < 0.1


@torch.no_grad()
def test_a_hot_pixel_is_silenced_and_does_not_hide_the_others():
    torch.manual_seed(0)
    sensitivity = torch.empty(8, HEIGHT, WIDTH).uniform_(0.9, 1.1)
    sensitivity[0, 20, 20] = 500
    equalised, _ = Equaliser()(*counts(sensitivity), [])
    weight = equalised.events[-1, 0, 0, 20, 20] / counts(sensitivity)[1][-1, 0, 0, 20, 20]
    assert weight < 2 * WEIGHTS[0] + 0.5
    assert equalised.events[-10:, 0, 0, 30:, 30:].mean() > 0.9 * counts(sensitivity)[1][-10:, 0, 0, 30:, 30:].mean()


@torch.no_grad()
def test_a_threshold_for_off_events_above_that_for_on_events_is_evened_out():
    sensitivity = torch.ones(8, HEIGHT, WIDTH)
    sensitivity[4:] = 0.5
    polarity, events = counts(sensitivity, 60)
    equalised, _ = Equaliser()(polarity, events, [])
    assert equalised.polarity[-10:].mean().abs() < 0.1 * polarity[-10:].mean().abs()


@torch.no_grad()
def test_windows_at_once_are_windows_one_by_one():
    torch.manual_seed(0)
    polarity, events = counts(torch.empty(8, HEIGHT, WIDTH).uniform_(0.5, 1.5), 6)
    equaliser = Equaliser()
    together, last = equaliser(polarity, events, [])
    state: list[torch.Tensor] = []
    for number in range(6):
        one, state = equaliser(polarity[number, None], events[number, None], state)
        torch.testing.assert_close(one.polarity[0], together.polarity[number])
    torch.testing.assert_close(state, last)
