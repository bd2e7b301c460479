import dataclasses

import pytest
import torch
from scipy.stats import wilcoxon

from polarnet.benchmark.score import (
    METRICS,
    BenchmarkConfig,
    FrameScore,
    paired_comparisons,
    scene_means,
    score_sequence,
    summary,
)
from polarnet.metrics.lpips import Lpips
from polarnet.metrics.offset import atanh_stokes, dolp_of
from polarnet.stokes import Prediction

CPU = torch.device("cpu")


def row(scene, value, method="m", sequence=None, window=0, lpips=None, aolp_deg=None, oracle_mse=0.5):
    scores = {name: value for name in METRICS if name != "skill"} | {"lpips": lpips, "aolp_deg": aolp_deg}
    scores["oracle_mse"] = oracle_mse
    return FrameScore(method, scene, sequence or scene, window, 0, **scores)


SETTINGS = {
    "methods": ["zeros"], "sets": ["simulated"], "warmup_windows": 1, "precision": "fp32", "lpips": False,
    "lpips_backbone": "alex", "bootstrap_samples": 10, "panel_scenes": 1,
}  # fmt: skip


def test_a_constant_offset_scores_its_square_as_level_in_windows_after_the_warm_up(sequence):
    sequence = dataclasses.replace(sequence, dolp=0.5 * sequence.dolp)
    rows = score_sequence(sequence, {"m": Prediction(sequence.dolp + 0.1)}, 0, None, CPU)
    assert [r.window for r in rows] == [0, 1, 2, 3]
    assert [r.t_us for r in rows] == [1000, 2000, 3000, 4000]
    for r in rows:
        scores = (r.mse, r.psnr, r.level_mse, r.pattern_mse, r.corr)
        assert scores == pytest.approx((0.01, 20, 0.01, 0, 1), abs=1e-6)
        assert r.lpips is None
    spoilt = sequence.dolp.clone()
    spoilt[:2] = float("nan")  # windows of the warm-up count for no method
    rows = score_sequence(sequence, {"a": Prediction(spoilt), "b": Prediction(sequence.dolp)}, 2, None, CPU)
    assert [(r.method, r.window) for r in rows] == [("a", 2), ("a", 3), ("b", 2), ("b", 3)]


def test_an_offset_of_s1_and_s2_is_scored_apart_from_the_rest(sequence):
    truth = dataclasses.replace(sequence, dolp=0.5 * sequence.dolp)
    moved = atanh_stokes(truth.dolp, truth.aolp) + torch.tensor([0.3, -0.1])[:, None, None]
    s1, s2 = torch.tanh(moved).unbind(1)
    prediction = Prediction(dolp_of(moved), torch.atan2(s2, s1) / 2)
    valid = torch.rand(truth.dolp.shape, generator=torch.Generator().manual_seed(0)) < 0.8
    masked = dataclasses.replace(truth, valid=valid)
    rows = score_sequence(masked, {"moved": prediction, "plain": Prediction(prediction.dolp)}, 1, None, CPU)
    for r in rows[:3]:
        assert r.offset == pytest.approx((0.3**2 + 0.1**2) / 2, rel=1e-3)
        assert r.no_offset_mse < 1e-6 < 1e-3 < r.mse
    assert [(r.offset, r.no_offset_mse) for r in rows[3:]] == [(None, None)] * 3


def test_frames_that_cannot_be_scored_are_refused(sequence):
    with pytest.raises(ValueError, match=r"4 windows and the first 4 are warm-up.*lower benchmark.warmup_windows"):
        score_sequence(sequence, {"m": Prediction(sequence.dolp)}, 4, None, CPU)
    valid = torch.ones_like(sequence.dolp, dtype=torch.bool)
    valid[2] = False
    masked = dataclasses.replace(sequence, valid=valid)
    with pytest.raises(ValueError, match="window 2: no pixel is valid"):
        score_sequence(masked, {"m": Prediction(sequence.dolp)}, 1, None, CPU)
    assert len(score_sequence(masked, {"m": Prediction(sequence.dolp)}, 3, None, CPU)) == 1


def test_scenes_weigh_alike_and_the_interval_is_the_same_every_time_and_shrinks_to_a_single_scene():
    rows = [row("x", 1.0, sequence="x1"), row("x", 3.0, sequence="x2"), row("x", 5.0, sequence="x2", window=1)]
    rows += [row("y", 9.0)]
    assert summary(rows, 100, 0)["m"]["mse"] == 6.0  # (3 + 9) / 2, not (1 + 3 + 5 + 9) / 4
    rows = [row(f"s{i}", float(i)) for i in range(10)]
    first, again, other = summary(rows, 500, 1), summary(rows[::-1], 500, 1), summary(rows, 500, 2)
    assert first == again
    assert first["m"]["mse_ci"] != other["m"]["mse_ci"]
    low, high = first["m"]["mse_ci"]
    assert 2 < low < 4.5 < high < 7  # +- 1.96 * 2.87 / sqrt(10) = 1.78
    assert summary(rows[3:4], 500, 1)["m"]["mse_ci"] == [3.0, 3.0]
    assert first["m"]["lpips"] is None
    assert "lpips_ci" not in first["m"]


def test_skill_is_a_ratio_of_means_against_the_oracle_mean():
    rows = [row("x", 0.1, oracle_mse=0.2), row("y", 0.3, oracle_mse=0.6)]
    rows += [row("x", 0.2, "best", oracle_mse=0.2), row("y", 0.6, "best", oracle_mse=0.6)]
    table = summary(rows, 100, 0)
    assert table["m"]["skill"] == pytest.approx(0.5)  # 1 - 0.2 / 0.4
    assert table["best"]["skill"] == pytest.approx(0)
    assert table["m"]["skill_ci"] == pytest.approx([0.5, 0.5])
    uneven = [row("x", 0.1, oracle_mse=0.1), row("y", 0.1, oracle_mse=0.9)]
    assert summary(uneven, 10, 0)["m"]["skill"] == pytest.approx(1 - 0.1 / 0.5)
    assert scene_means(uneven, "skill")["m"] == pytest.approx({"x": 0.0, "y": 1 - 0.1 / 0.9})


@pytest.mark.parametrize(("change", "message"), [
    ({"methods": ["zeros", "magic"]}, r"methods\[1\]: expected one of zeros, train_mean, .*, got 'magic'"),
    ({"methods": ["zeros", "zeros"]}, "methods: expected at least one and none twice"),
    ({"methods": []}, "methods: expected at least one and none twice"),
    ({"sets": ["measured"]}, "sets: expected simulated and others, none twice"),
    ({"sets": ["simulated", "real"]}, r"sets\[1\]: expected one of simulated, measured, got"),
])  # fmt: skip
def test_settings_out_of_range_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        BenchmarkConfig(**{**SETTINGS, **change})


def test_masked_pixels_count_in_no_score(make_sequence):
    sequence, other = make_sequence(seed=1), make_sequence(seed=2).dolp
    valid = torch.rand(sequence.dolp.shape, generator=torch.Generator().manual_seed(3)) < 0.7
    masked = dataclasses.replace(sequence, valid=valid)
    torch.manual_seed(0)
    lpips = Lpips("vgg")
    spoilt = torch.where(valid, other, 1 - other)
    rows, again = (score_sequence(masked, {"m": Prediction(frames)}, 1, lpips, CPU) for frames in (other, spoilt))
    assert rows == again
    for r in rows:
        where = valid[r.window]
        difference = (other - sequence.dolp)[r.window][where]
        assert r.mse == pytest.approx(difference.square().mean().item(), rel=1e-5)
        assert r.level_mse == pytest.approx(difference.mean().square().item(), rel=1e-4, abs=1e-9)
        mixed = torch.where(where, other[r.window], sequence.dolp[r.window])
        assert r.lpips == pytest.approx(lpips(mixed[None], sequence.dolp[r.window][None]).item(), rel=1e-4)
    unmasked = score_sequence(sequence, {"m": Prediction(other)}, 1, lpips, CPU)
    assert all(a.ssim != b.ssim for a, b in zip(rows, unmasked, strict=True))


def scenes_of(method, values):
    return [row(f"s{i}", value, method) for i, value in enumerate(values)]


def test_pairs_are_counted_by_scene_and_holm_corrects_for_the_number_of_rivals():
    rows = scenes_of("ours", range(1, 7)) + scenes_of("cf", [2.0 + 1.5 * i for i in range(6)])
    assert paired_comparisons(rows, "ours") == {
        "cf": {"scenes": 6, "better": 6, "median_difference": -2.25, "p": pytest.approx(2 / 2**6),
               "p_holm": pytest.approx(2 / 2**6)}
    }  # fmt: skip
    assert paired_comparisons(rows, "zeros") == {}
    gains = {"a": [1, 2, 3, 4, 5, 6], "b": [1, 2, 3, 4, 5, -6], "c": [-1, 2, -3, 4, -5, 6]}
    rows = scenes_of("ours", [10.0] * 6)
    rows += [one for name, values in gains.items() for one in scenes_of(name, [10.0 + gain for gain in values])]
    by_rival = paired_comparisons(rows, "ours")
    assert by_rival["b"]["p"] == wilcoxon(gains["b"]).pvalue
    assert by_rival["a"]["p_holm"] == pytest.approx(3 * by_rival["a"]["p"])
    assert by_rival["b"]["p_holm"] == pytest.approx(2 * by_rival["b"]["p"])
    assert by_rival["a"]["p_holm"] <= by_rival["b"]["p_holm"] <= by_rival["c"]["p_holm"] <= 1
