import dataclasses

import pytest
import torch
from torch import nn

from polarnet.benchmark.cost import MIB, cost_of, first_windows, observed
from polarnet.benchmark.rows import opened
from polarnet.methods import METHODS
from polarnet.methods.method import Method, Recoverer
from polarnet.stokes import Prediction


def test_a_convolution_has_two_operations_a_weight_and_pixel(sequence, context, monkeypatch):
    layer = nn.Conv2d(4, 3, 3, padding=1)

    def convolve(state, windows):
        return state, Prediction(layer(torch.ones(len(windows), 4, 18, 20))[:, 0])

    recoverer = Recoverer(lambda height, width: None, convolve, network=layer)
    monkeypatch.setitem(METHODS, "convolve", Method("convolve", "convolve", "#000000", lambda setup: recoverer))
    context = dataclasses.replace(context, setups=context.setups | {"convolve": context.setups["cf"]})
    cost = cost_of("convolve", sequence, context)
    assert cost.gflop == pytest.approx(2 * 4 * 3 * 9 * 18 * 20 / 1e9)
    assert cost.params == 4 * 3 * 9 + 3
    assert cost.ms_per_window > 0


def test_attention_counts_on_a_cpu(sequence, context):
    cost, network = cost_of("ours", sequence, context), opened(METHODS["ours"], context).network
    assert cost.gflop > 0
    assert cost.params == sum(p.numel() for p in network.parameters())


def test_a_filter_has_no_network(sequence, context):
    cost = cost_of("cf", sequence, context)
    assert cost.gflop is None
    assert cost.params == 0
    assert cost.peak_mib > 4 * 3 * 18 * 20 * 4 / MIB  # the intensities that it gives


def test_the_peak_is_what_lives_at_once():
    weights = torch.zeros(2**20)

    def run():
        a = torch.zeros(2**20)  # 4 MiB
        weights.view(2, -1).add_(1)
        b = a + 1
        del a
        c = b + 1
        return c.sum()

    observed(run, torch.device("cpu"))  # what is imported at first use is no memory of the method
    assert observed(run, torch.device("cpu"))[1] / MIB == pytest.approx(8, abs=0.1)


def test_a_recording_is_cut_after_whole_windows(sequence):
    cut = first_windows(sequence, 2)
    assert cut.t_us.tolist() == [0, 1000, 2000]
    assert len(cut.dolp) == len(cut.s0) == 2
    assert [window.stop_us for window in cut.windows] == [1000, 2000]
    assert first_windows(sequence, 99).t_us.tolist() == sequence.t_us.tolist()
