import pytest
import torch
from torch import nn

from polarnet.evaluation.cost import MIB, _peak_bytes, cost_of, first_windows
from polarnet.evaluation.methods import METHODS, Polarization


def test_a_convolution_has_two_operations_a_weight_and_pixel(recording, context, monkeypatch):
    layer = nn.Conv2d(4, 3, 3, padding=1)

    def convolve(recording, context):
        return Polarization(layer(torch.ones(len(recording.dolp), 4, 18, 20))[:, 0])

    monkeypatch.setitem(METHODS, "convolve", convolve)
    cost = cost_of("convolve", recording, context)
    assert cost.gflop == pytest.approx(2 * 4 * 3 * 9 * 18 * 20 / 1e9)
    assert cost.params == 4 * 3 * 9 + 3
    assert cost.ms_per_window > 0


def test_attention_counts_on_a_cpu(recording, context):
    assert cost_of("ours", recording, context).gflop > 0
    assert cost_of("ours", recording, context).params == sum(p.numel() for p in context.ours[0].parameters())


def test_a_filter_has_no_network(recording, context):
    cost = cost_of("cf", recording, context)
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

    _peak_bytes(run, torch.device("cpu"))  # what is imported at first use is no memory of the method
    assert _peak_bytes(run, torch.device("cpu")) / MIB == pytest.approx(8, abs=0.1)


def test_a_recording_is_cut_after_whole_windows(recording):
    cut = first_windows(recording, 2)
    assert cut.t_us.tolist() == [0, 1000, 2000]
    assert len(cut.dolp) == len(cut.s0) == 2
    assert all(int(events.t.max()) <= 2000 for events in cut.events)
    assert first_windows(recording, 99).t_us.tolist() == recording.t_us.tolist()
