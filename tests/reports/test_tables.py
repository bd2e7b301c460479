import math

from polarnet.reports.tables import COLUMNS, PAPER_TABLE_2, paper_table, score_table

SCORES = {
    "ours": {"mse": 0.02, "psnr": 17.0, "ssim": 0.4, "lpips": None, "corr": 0.6, "ms_per_window": 19.04},
    "zeros": {"mse": 0.09, "psnr": 11.0, "ssim": 0.1, "lpips": None, "corr": 0.0, "ms_per_window": 0.0},
    "cf": {"mse": 0.3, "psnr": 7.0, "ssim": 0.05, "lpips": None, "corr": 0.1, "ms_per_window": 9.0},
}


def row(table, method):
    return next(row for row in table.rows if row.method == method)


def test_methods_keep_one_order_and_one_without_a_name_follows_under_its_own_key():
    assert [r.method for r in score_table(SCORES).rows] == ["zeros", "cf", "ours"]
    table = score_table({"e2vid_official": {"mse": 0.1}, "zeros": {"mse": 0.2}})
    assert [r.label for r in table.rows] == ["zeros", "e2vid_official"]


def test_values_that_read_the_same_are_bold_together_and_the_fastest_method_is_not_because_speed_is_no_score():
    table = score_table({"cf": {"psnr": 12.001}, "ours": {"psnr": 12.004}})
    assert [r.cells[0].best for r in table.rows] == [True, True]
    table = score_table(SCORES)
    assert table.headings[-1] == "ms / window ↓"
    assert not any(r.cells[-1].best for r in table.rows)


def test_a_row_of_another_camera_is_never_bold_and_a_note_says_why():
    table = score_table({"rotating_polarizer": {"mse": 0.01}, "cf": {"mse": 0.3}, "ours": {"mse": 0.02}})
    assert not row(table, "rotating_polarizer").cells[0].best
    assert row(table, "ours").cells[0].best
    assert row(table, "rotating_polarizer").label.endswith("†")
    assert table.notes[0].startswith("† Not ranked: another camera")
    assert score_table({"ours": {"mse": 0.02}}).notes == ()


def test_lpips_names_its_backbone_in_heading_and_caption():
    scores = {method: row | {"lpips": 0.25, "lpips_backbone": "alex"} for method, row in SCORES.items()}
    table = score_table(scores)
    assert "LPIPS (alex) ↓" in table.headings
    assert table.notes == ("LPIPS (alex): version 0.1 on the features of AlexNet.",)
    assert score_table(scores, {"mse": COLUMNS["mse"]}).notes == ()


def test_what_rounds_to_zero_has_no_sign():
    assert [COLUMNS["skill"].printed(value) for value in (-0.0001, -0.0006)] == ["0.000", "-0.001"]


def test_the_papers_figures_agree_with_each_other():
    """Its network is best, and -10 log10(MSE) bounds the mean PSNR from below (Jensen)."""
    for experiment, methods in PAPER_TABLE_2.items():
        assert all(cell.best for cell in row(paper_table(experiment), "paper").cells)
        assert set(methods) == {"cf", "e2v", "paper"}
        assert all(scores["psnr"] >= -10 * math.log10(scores["mse"]) - 0.01 for scores in methods.values())
