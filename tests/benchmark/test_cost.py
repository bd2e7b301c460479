import dataclasses

import pytest
import torch
from torch import nn

from polarnet.benchmark.cost import cost_of, first_windows
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


def test_attention_counts_on_a_cpu_and_a_filter_has_no_network(sequence, context):
    cost, network = cost_of("ours", sequence, context), opened(METHODS["ours"], context).network
    assert cost.gflop > 0
    assert cost.params == sum(p.numel() for p in network.parameters())
    of_filter = cost_of("cf", sequence, context)
    assert (of_filter.gflop, of_filter.params) == (None, 0)


def test_a_recording_is_cut_after_whole_windows(sequence):
    cut = first_windows(sequence, 2)
    assert cut.t_us.tolist() == [0, 1000, 2000]
    assert len(cut.dolp) == len(cut.s0) == 2
    assert [window.stop_us for window in cut.windows] == [1000, 2000]
    assert first_windows(sequence, 99).t_us.tolist() == sequence.t_us.tolist()
