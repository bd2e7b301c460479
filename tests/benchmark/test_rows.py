import dataclasses
import math

import pytest
import torch
from method_fixtures import WITH_WEIGHTS_HERE
from torch import nn

from polarnet.benchmark.rows import available, cost_of, first_windows, opened, predictions_of, weights_used
from polarnet.events.stream import Events
from polarnet.methods import METHODS, ROWS
from polarnet.methods.method import Method, Recoverer
from polarnet.metrics.references import REFERENCES, oracle_mean
from polarnet.metrics.similarity import mse
from polarnet.stokes import Prediction


def dolp_of(row, sequence, context):
    return predictions_of([row], sequence, context)[row].dolp


def test_all_rows_of_one_sequence_come_in_the_order_asked_for(sequence, context):
    wanted = ["ours", "cf+gain", "oracle_mean", "cf"]
    predictions = predictions_of(wanted, sequence, context)
    assert list(predictions) == wanted
    for row, prediction in predictions.items():
        assert torch.equal(prediction.dolp, dolp_of(row, sequence, context)), row


@pytest.mark.thorough
def test_only_the_oracle_looks_at_the_truth(sequence, context):
    blind = dataclasses.replace(sequence, dolp=torch.full_like(sequence.dolp, 0.5))
    seen, unseen = (predictions_of(WITH_WEIGHTS_HERE, one, context) for one in (sequence, blind))
    differing = [row for row in WITH_WEIGHTS_HERE if not torch.equal(seen[row].dolp, unseen[row].dolp)]
    assert differing == ["oracle_mean"]


@pytest.mark.parametrize("row", ["zeros", "train_mean", "oracle_mean", "rotating_polarizer"])
def test_references_look_at_no_event_and_a_rotating_polarizer_has_a_camera_of_its_own(row, sequence, context):
    still = dataclasses.replace(sequence, events=[Events.empty(18, 20)] * 4)
    assert torch.equal(dolp_of(row, sequence, context), dolp_of(row, still, context))
    if row == "rotating_polarizer":
        without = dataclasses.replace(sequence, rotating=None)
        with pytest.raises(ValueError, match="a: expected events of a camera behind a rotating polarizer, there are"):
            dolp_of(row, without, context)


def test_the_oracle_mean_beats_every_constant_on_every_frame_and_knows_the_valid_pixels_alone(sequence, context):
    oracle = dolp_of("oracle_mean", sequence, context)
    for constant in (0.0, 0.25, 0.45, 0.5, 0.55, 1.0):
        assert (mse(oracle, sequence.dolp) <= mse(torch.full_like(oracle, constant), sequence.dolp)).all()
    truth = torch.rand(3, 4, 5)
    valid = truth < 0.6
    valid[1] = False
    best = oracle_mean(truth, valid).dolp
    for frame, mean, where in zip(truth, best, valid, strict=True):
        expected = frame[where].mean() if where.any() else torch.tensor(0.0)
        torch.testing.assert_close(mean, expected.expand(4, 5))


def test_a_row_that_cannot_run_is_left_out_with_the_reason(make_context, tmp_path):
    missing = tmp_path / "none.safetensors"
    context = make_context(None, firenet_published={"weights": None}, paper={"weights": missing})
    wanted = ["zeros", "train_mean", "cf+gain", "e2v", "firenet_published+gain", "paper", "ours"]
    there, left_out = available(wanted, context)
    assert there == ["zeros", "cf+gain", "e2v", "ours"]
    assert left_out["train_mean"] == "the training split is not there; run `dvc repro synthesize`"
    assert "rows.firenet_published+gain.needs" in left_out["firenet_published+gain"]
    assert left_out["paper"] == f"{missing} is not there"
    there, left_out = available(list(ROWS), make_context())
    assert there == WITH_WEIGHTS_HERE
    assert left_out["registered"].endswith("holds a paper, expected polarnet: set rows.registered.needs to such a file")


def test_a_predicted_value_that_is_not_a_number_is_named(sequence, context, monkeypatch):
    sequence.dolp[2, 3, 3] = math.nan
    damaged = dataclasses.replace(REFERENCES["zeros"], predict=lambda truth, valid, train_mean: Prediction(truth))
    monkeypatch.setitem(REFERENCES, "zeros", damaged)
    with pytest.raises(ValueError, match="zeros on a, window 2: it predicted values that are not numbers"):
        predictions_of(["zeros"], sequence, context)


def test_weights_are_named_once_a_section(context):
    used = weights_used(["zeros", "cf", "e2v", "e2v+gain"], context)
    assert {section: one["file"] for section, one in used.items()} == {"e2v": "firenet.safetensors"}


def test_a_convolution_has_two_operations_a_weight_and_pixel_attention_counts_and_a_filter_has_none(
    sequence, context, monkeypatch
):
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
    cost, network = cost_of("ours", sequence, context), opened(METHODS["ours"], context).network
    assert cost.gflop > 0
    assert cost.params == sum(p.numel() for p in network.parameters())
    of_filter = cost_of("cf", sequence, context)
    assert (of_filter.gflop, of_filter.params) == (None, 0)


def test_a_recording_is_cut_after_whole_windows(sequence):
    cut = first_windows(sequence, 2)
    assert cut.t_us.tolist() == [0, 1000, 2000]
    assert len(cut.dolp) == len(cut.s0) == 2
    assert [window.stop_us for window in cut.windows()] == [1000, 2000]
    assert first_windows(sequence, 99).t_us.tolist() == sequence.t_us.tolist()
