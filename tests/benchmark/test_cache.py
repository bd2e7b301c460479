import dataclasses
import math

import pytest
import torch

from polarnet.benchmark.cache import Cache, sequence_digest
from polarnet.benchmark.cost import Cost
from polarnet.benchmark.score import score_sequence
from polarnet.stokes import Prediction


@pytest.fixture
def cache(tmp_path):
    return Cache(tmp_path / "cache")


def test_a_prediction_comes_back_in_the_steps_of_the_truth(cache, sequence):
    found = Prediction(sequence.dolp, sequence.aolp, 3 * sequence.dolp - 4)
    kept = cache.write_prediction("m", "a", "key", found)
    again = cache.prediction("m", "a", "key")
    assert torch.equal(again.dolp, kept.dolp)
    assert torch.equal(again.aolp, kept.aolp)
    assert torch.equal(again.log_variance, kept.log_variance)
    torch.testing.assert_close(again.log_variance, found.log_variance, atol=0.002, rtol=0)
    torch.testing.assert_close(again.dolp, found.dolp, atol=0.51 / 65535, rtol=0)


def test_another_key_another_method_or_another_sequence_finds_nothing(cache, sequence):
    cache.write_prediction("m", "a", "key", Prediction(sequence.dolp))
    for method, sequence, key in (("m", "a", "other"), ("n", "a", "key"), ("m", "b", "key")):
        assert cache.prediction(method, sequence, key) is None
    assert cache.prediction("m", "a", "key").aolp is None


def test_an_entry_cut_short_is_no_entry(cache, sequence):
    cache.write_prediction("m", "a", "key", Prediction(sequence.dolp))
    file = next(cache.folder.rglob("a.npz"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert cache.prediction("m", "a", "key") is None
    cache.write_scores("m", "a", "key", [])
    file = next(cache.folder.rglob("a.scores.json"))
    file.write_text(file.read_text()[:9])
    assert cache.scores("m", "a", "key") is None


def test_a_value_that_is_not_a_number_is_named_not_kept(cache, sequence):
    sequence.dolp[2, 3, 3] = math.nan
    with pytest.raises(ValueError, match="m on a, window 2: it recovered values that are not numbers"):
        cache.write_prediction("m", "a", "key", Prediction(sequence.dolp))


def test_scores_and_costs_come_back_to_the_last_bit(cache, sequence):
    rows = score_sequence(sequence, {"m": Prediction(0.9 * sequence.dolp)}, 1, None, torch.device("cpu"))
    cache.write_scores("m", "a", "key", rows)
    assert cache.scores("m", "a", "key") == rows
    cost = Cost(1 / 3, None, 7, 0.1)
    cache.write_cost("m", "key", cost)
    assert cache.cost("m", "key") == cost
    assert cache.cost("m", "other") is None


def test_sequences_that_are_gone_are_forgotten(cache, sequence):
    for name in ("a", "b"):
        cache.write_prediction("m", name, "key", Prediction(sequence.dolp))
    cache.write_cost("m", "key", Cost(1.0, None, 0, 0.0))
    cache.forget(["b"])
    assert sorted(path.name for path in cache.folder.glob("*/*")) == ["b.npz", "cost.json"]


def test_the_digest_of_a_sequence_changes_with_an_event_and_with_the_truth(sequence):
    before = sequence_digest(sequence)
    assert sequence_digest(sequence) == before
    assert sequence_digest(dataclasses.replace(sequence, dolp=sequence.dolp + 1e-4)) != before
    first = sequence.events[0]
    turned = dataclasses.replace(first, p=torch.cat([-first.p[:1], first.p[1:]]))
    assert sequence_digest(dataclasses.replace(sequence, events=[turned, *sequence.events[1:]])) != before
