from studies.comparisons import paired_lines, standing

OURS = {"mse": 0.02, "psnr": 17.0, "ssim": 0.4, "lpips": None, "corr": 0.6, "ms_per_window": 19.04}


def test_standing_says_better_or_worse_with_the_difference():
    lines = standing({"train_mean": {"mse": 0.05, "psnr": 13.0, "ssim": 0.5}, "ours": OURS})
    assert lines == ["ours against training mean: MSE -0.0300 (better), PSNR +4.00 dB (better), SSIM -0.1000 (worse)."]


def test_standing_without_ours_says_nothing():
    assert standing({"cf": {"mse": 0.1}}) == []


def test_pairs_are_said_in_the_order_of_the_table():
    one = {"scenes": 10, "better": 9, "effect": 0.964, "p_holm": 0.0058}
    lines = paired_lines({"e2v": {"mse": one}, "cf": {"mse": one}, "zeros": {"psnr": one}})
    assert lines == [
        "CF: ours is better in 9 of 10 scenes (effect +0.96, p = 0.0058).",
        "E2V: ours is better in 9 of 10 scenes (effect +0.96, p = 0.0058).",
    ]
