import dataclasses
import math

import pytest
import torch

from polarnet.baselines.trivial import oracle_mean
from polarnet.evaluation.methods import METHODS, Polarization, e2v_intensities, from_intensities, recover
from polarnet.events.representations import event_tensor
from polarnet.events.stream import Events
from polarnet.events.windows import encode_windows
from polarnet.networks.checkpoint import load_network
from polarnet.similarity import mse


@pytest.mark.parametrize("method", METHODS)
def test_every_method_gives_a_frame_a_window_between_0_and_1(method, recording, context):
    found = recover(method, recording, context)
    assert found.dolp.shape == recording.dolp.shape
    assert found.dolp.dtype == torch.float32
    assert 0 <= found.dolp.min() <= found.dolp.max() <= 1
    assert found.seconds > 0
    if found.aolp is not None:
        assert found.aolp.shape == recording.dolp.shape
        assert 0 <= found.aolp.min() <= found.aolp.max() < math.pi


@pytest.mark.parametrize("method", [name for name in METHODS if name != "oracle_mean"])
def test_only_the_oracle_looks_at_the_truth(method, recording, context):
    blind = dataclasses.replace(recording, dolp=torch.full_like(recording.dolp, 0.5))
    assert torch.equal(recover(method, recording, context).dolp, recover(method, blind, context).dolp)


@pytest.mark.parametrize("method", ["zeros", "train_mean", "oracle_mean"])
def test_the_trivial_rows_look_at_no_event(method, recording, context):
    still = dataclasses.replace(recording, events=[Events.empty(18, 20)] * 4)
    assert torch.equal(recover(method, recording, context).dolp, recover(method, still, context).dolp)


@pytest.mark.parametrize("constant", [0.0, 0.25, 0.45, 0.5, 0.55, 1.0])
def test_the_oracle_mean_beats_every_constant_on_every_frame(constant, recording, context):
    oracle = recover("oracle_mean", recording, context).dolp
    assert (mse(oracle, recording.dolp) <= mse(torch.full_like(oracle, constant), recording.dolp)).all()


def test_dolp_outside_0_and_1_is_clamped_in_one_place(recording, context, monkeypatch):
    wild = torch.linspace(-1, 2, recording.dolp.numel()).view_as(recording.dolp)
    monkeypatch.setitem(METHODS, "wild", lambda *_: Polarization(wild))
    assert torch.equal(recover("wild", recording, context).dolp, wild.clamp(0, 1))


def test_intensities_become_dolp_and_aolp_by_the_stokes_formula(recording, context):
    intensities = torch.tensor([0.8, 0.5, 0.2, 0.5]).view(1, 4, 1, 1)
    found = from_intensities(lambda *_: intensities)(recording, context)
    torch.testing.assert_close(found.dolp, torch.full((1, 1, 1), 0.6))
    torch.testing.assert_close(found.aolp, torch.zeros(1, 1, 1))


def test_cf_of_one_event_behind_one_polarizer(recording, context):
    row, column = torch.tensor([2], dtype=torch.int16), torch.tensor([3], dtype=torch.int16)
    one = Events(torch.tensor([1000]), column, row, torch.ones(1, dtype=torch.int8), 18, 20)
    silent = Events.empty(18, 20)
    lit = dataclasses.replace(recording, events=[one, silent, silent, silent])
    found = recover("cf", lit, context).dolp
    dark = 0.1 / 1.3  # what a pixel without events shows: exp(0) - 1 = 0, and -0.1 ... 1.2 is shown as 0 ... 1
    bright = [(math.expm1(0.1 * math.exp(-math.pi * t)) + 0.1) / 1.3 for t in (0, 1e-3, 2e-3, 3e-3)]
    expected = [(b - dark) / (b + dark) for b in bright]
    torch.testing.assert_close(found[:, 2, 3], torch.tensor(expected))
    found[:, 2, 3] = 0
    assert not found.any()


def test_ours_runs_window_by_window_with_its_state_carried_on(recording, context):
    network, _ = load_network(context.ours_checkpoint)
    inputs = encode_windows(recording.events, recording.t_us, event_tensor)
    with torch.no_grad():
        at_once, _ = network.unroll(inputs[:, None])
    expected = at_once.dolp[:, 0].clamp(0, 1)
    torch.testing.assert_close(recover("ours", recording, context).dolp, expected)


def test_e2v_treats_the_four_polarizers_alike(recording, context):
    turned = dataclasses.replace(recording, events=[*recording.events[1:], recording.events[0]])
    with torch.no_grad():
        straight, shifted = e2v_intensities(recording, context), e2v_intensities(turned, context)
    torch.testing.assert_close(shifted, straight.roll(-1, dims=1))


def test_bf16_is_near_fp32(recording, context):
    low = dataclasses.replace(context, precision="bf16")
    for method in ("e2v", "ours"):
        a, b = (recover(method, recording, c).dolp for c in (context, low))
        assert 0 < (a - b).abs().mean() < 0.02


def test_a_network_that_was_not_trained_is_missed_by_its_methods_alone(recording, context, tmp_path):
    without = dataclasses.replace(context, ours_checkpoint=tmp_path / "none.safetensors")
    recover("cf", recording, without)
    with pytest.raises(FileNotFoundError, match=r"none.safetensors is missing"):
        recover("ours", recording, without)


def test_the_oracle_knows_the_mean_of_the_valid_pixels_alone():
    truth = torch.rand(3, 4, 5)
    valid = truth < 0.6
    valid[1] = False
    best = oracle_mean(truth, valid)
    for frame, mean, where in zip(truth, best, valid, strict=True):
        expected = frame[where].mean() if where.any() else torch.tensor(0.0)
        torch.testing.assert_close(mean, expected.expand(4, 5))
