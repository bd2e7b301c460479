import pytest
import torch

from polarnet.events.stream import Events
from polarnet.events.streaming import EventWindow
from polarnet.methods.dolp_network import dolp_recoverer
from polarnet.methods.two_threads import PARTS
from polarnet.networks.checkpoint import load_network
from polarnet.networks.weights import shipped_weights
from polarnet.runtime.machine import torch_threads

HEIGHT, WIDTH = 24, 36


def windows_of(count: int, per_channel: int = 60) -> list[EventWindow]:
    """Windows of random events, one after the other."""
    generator = torch.Generator().manual_seed(0)

    def events(start_us: int) -> Events:
        x, y, p = (torch.randint(0, limit, (per_channel,), generator=generator) for limit in (WIDTH, HEIGHT, 2))
        t = torch.randint(start_us, start_us + 33_333, (per_channel,), generator=generator).sort().values
        return Events(t, x.short(), y.short(), (2 * p - 1).to(torch.int8), HEIGHT, WIDTH)

    spans = [(33_333 * k, 33_333 * (k + 1)) for k in range(count)]
    return [EventWindow([events(start) for _ in range(4)], start, stop) for start, stop in spans]


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("binning", [1, 2])
def test_two_threads_give_the_bytes_of_one(precision, binning, monkeypatch):
    part = 2 * binning**2
    monkeypatch.setattr("polarnet.methods.method.PIXELS_AT_ONCE", 2 * HEIGHT * WIDTH)
    windows = windows_of(3 * part + 1)
    network = load_network(shipped_weights())
    with torch_threads(1):
        alone = dolp_recoverer(*network, precision=precision, binning=binning)
        assert alone.at_once(HEIGHT, WIDTH) == part
        state, predictions = alone.start(HEIGHT, WIDTH), []
        for first in range(0, len(windows), part):
            state, prediction = alone.step(state, windows[first : first + part])
            predictions.append(prediction)
    with torch_threads(2):
        shared = dolp_recoverer(*network, precision=precision, binning=binning)
        _, together = shared.step(shared.start(HEIGHT, WIDTH), windows)
        assert torch.get_num_threads() == 2
        assert shared.at_once(HEIGHT, WIDTH) == PARTS * part
    for fields in zip(together, *predictions, strict=True):
        assert fields[0] is None or torch.equal(fields[0], torch.cat(fields[1:]))
