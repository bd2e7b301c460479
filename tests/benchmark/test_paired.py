import numpy as np
import pytest
from scipy.stats import wilcoxon

from polarnet.benchmark.paired import compared, paired_comparisons
from polarnet.benchmark.score import METRICS, FrameScore


def row(method, scene, value):
    scores = {name: value for name in METRICS if name != "skill"} | {"lpips": None, "aolp_deg": None}
    return FrameScore(method, scene, scene, 0, 0, **scores, oracle_mse=1.0)


def test_winning_all_of_six_scenes_has_effect_1_and_the_smallest_p_there_is():
    comparison = compared(np.arange(1.0, 7.0))
    assert comparison == {"scenes": 6, "better": 6, "effect": 1.0, "p": pytest.approx(2 / 2**6)}


def test_ranks_by_hand():
    # |gains| rank 1, 2, 3, 4; the second smallest is a loss: (1 - 2 + 3 + 4) / 10
    comparison = compared(np.array([0.1, -0.2, 0.3, 0.4]))
    assert comparison["effect"] == pytest.approx(0.6)
    assert comparison["p"] == pytest.approx(wilcoxon([0.1, -0.2, 0.3, 0.4]).pvalue)


def test_lower_is_better_for_errors_and_higher_for_psnr():
    rows = [row("ours", f"s{i}", 1.0 + i) for i in range(4)] + [row("cf", f"s{i}", 2.0 + 1.5 * i) for i in range(4)]
    comparison = paired_comparisons(rows, "ours")["cf"]
    assert comparison["mse"]["better"] == 4
    assert comparison["psnr"]["better"] == 0
    assert comparison["mse"]["median_difference"] == pytest.approx(-1.75)
    assert comparison["psnr"]["effect"] == -1
    assert "lpips" not in comparison


def test_holm_corrects_for_the_number_of_rivals_and_never_falls():
    gains = {"a": [1, 2, 3, 4, 5, 6], "b": [1, 2, 3, 4, 5, -6], "c": [-1, 2, -3, 4, -5, 6]}
    rows = [row("ours", f"s{i}", 10.0) for i in range(6)]
    rows += [row(name, f"s{i}", 10.0 + gain) for name, values in gains.items() for i, gain in enumerate(values)]
    by_rival = {rival: scores["mse"] for rival, scores in paired_comparisons(rows, "ours").items()}
    assert by_rival["a"]["p_holm"] == pytest.approx(3 * by_rival["a"]["p"])
    assert by_rival["b"]["p_holm"] == pytest.approx(2 * by_rival["b"]["p"])
    assert by_rival["a"]["p_holm"] <= by_rival["b"]["p_holm"] <= by_rival["c"]["p_holm"] <= 1


def test_without_the_method_there_is_nothing_to_compare():
    assert paired_comparisons([row("cf", "s", 1.0), row("zeros", "s", 2.0)], "ours") == {}
