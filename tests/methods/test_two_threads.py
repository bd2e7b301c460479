import pytest
import torch

from polarnet.methods.dolp_network import dolp_recoverer
from polarnet.methods.two_threads import PARTS
from polarnet.networks.registry import load_network
from polarnet.networks.weights import shipped_weights
from polarnet.runtime.machine import torch_threads
from studies.speed_of_network import random_channels, windows_of

HEIGHT, WIDTH = 24, 36


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("binning", [1, 2])
def test_two_threads_give_the_bytes_of_one(precision, binning, monkeypatch):
    part = 2 * binning**2
    monkeypatch.setattr("polarnet.methods.method.PIXELS_AT_ONCE", 2 * HEIGHT * WIDTH)
    count = 3 * part + 1
    windows = windows_of(random_channels(HEIGHT, WIDTH, count), count)
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
