import functools
import io

import matplotlib.image

from polarnet.reports.curves import event_budget_figure, sensitivity_figure
from polarnet.reports.figures import LIGHT
from polarnet.reports.maps import png
from studies.figures import expected_errors_figure, loss_sweep_figure, robustness_figure


def scores(value):
    return {"psnr": 10 + value, "corr": value}


BUDGET = {
    "since_start": {"cf": [{"events_per_pixel": x, **scores(x / 10)} for x in (0.2, 1.1, 4.0)]},
    "window_length": {"cf": [{"window_us": x, **scores(0.3)} for x in (5000, 33333)]},
    "sliding": [
        {"events_per_pixel": x, "carry": carry, "spacing_us": 500, **scores(0.5)}
        for x in (0.25, 1.0)
        for carry in (False, True)
    ],
    "between": {"window_us": 33333, "spacing_us": 500, **scores(0.9)},
}
SETTINGS = {
    "speed": [{"value": v, "scores": {"cf": scores(0.1), "ours": scores(0.6)}} for v in (0.5, 1.0)],
    "channel_error": [{"value": v, "scores": {"cf": scores(0.1), "ours": scores(0.6 - v)}} for v in (0.0, 0.2)],
}
EXPECTED = {
    seed: {"sets": {name: {"curve": [(0.01, 0.02, 100), (0.1, 0.1, 300)]} for name in ("simulated", "measured")}}
    for seed in ("1", "2")
}

CONDITIONS = {
    name: {"scenes": 3, "rows": {"oracle_mean": {"mse_over_oracle_mean": 1.0}, **rows}}
    for name, rows in {
        "photographs": {"zeros": {"mse_over_oracle_mean": 5.5}, "ours": {"mse_over_oracle_mean": 0.75}},
        "measured": {"zeros": {"mse_over_oracle_mean": 7.0}, "ours": {"mse_over_oracle_mean": 1.84}},
        "time": {"ours": {"mse_over_oracle_mean": 0.9}, "held": {"mse_over_oracle_mean": 0.98}},
    }.items()
}


def test_the_figures_are_drawn_the_same_each_time():
    for draw, results in (
        (event_budget_figure, BUDGET),
        (sensitivity_figure, SETTINGS),
        (functools.partial(expected_errors_figure, theme=LIGHT), EXPECTED),
        (functools.partial(robustness_figure, theme=LIGHT), CONDITIONS),
    ):
        content = png(draw(results))
        assert content == png(draw(results))
        assert matplotlib.image.imread(io.BytesIO(content)).std() > 0


def test_frames_carried_on_between_windows_are_a_line_beside_the_overlapping_windows():
    sliding = event_budget_figure(BUDGET).axes[2]
    (line,) = [one for one in sliding.lines if one.get_label() == "carried on between windows of 33 ms"]
    assert set(line.get_ydata()) == {10.9}


def test_the_papers_answer_is_marked_in_the_event_budget():
    start = event_budget_figure(BUDGET).axes[0]
    assert any(line.get_linestyle() == "--" and line.get_xdata()[0] == 1.04 for line in start.lines)


def test_a_setting_is_a_column_with_its_values_below():
    axes = sensitivity_figure(SETTINGS).axes
    assert len(axes) == 4
    assert [tick.get_text() for tick in axes[1].get_xticklabels()] == ["0", "0.2"]


def test_expected_errors_are_drawn_for_each_set_and_seed_beside_the_diagonal():
    simulated, measured = expected_errors_figure(EXPECTED, LIGHT).axes
    assert simulated.get_title("left") == "Simulated"
    for axes in (simulated, measured):
        diagonal, *seeds = axes.lines
        assert list(diagonal.get_xdata()) == list(diagonal.get_ydata()) == [0.01, 0.1]
        assert [line.get_label() for line in seeds] == ["seed 1", "seed 2"]
        assert list(seeds[0].get_ydata()) == [0.02, 0.1]


def test_conditions_are_rows_and_a_row_of_few_conditions_has_no_column():
    (axes,) = robustness_figure(CONDITIONS, LIGHT).axes
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["photographs (3)", "measured (3)", "time (3)"]
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["zeros", "ours"]
    assert [text.get_text() for text in axes.texts] == ["5.50", "0.75", "7.00", "1.84", "0.90"]


def swept(mse, ssim, lpips, value):
    score = {"mean": value, "std": None}
    weights = {"mse": mse, "ssim": ssim, "lpips": lpips}
    return {"weights": weights, "validation": {"mse": score}, "test": {"mse": score, "psnr": {**score, "mean": 15.0}}}


def test_a_loss_sweep_has_a_cell_a_point_the_best_in_bold_and_one_frame():
    points = [swept(m, s, p, m + s + p / 100) for m in (1.0, 10.0) for s in (0.0, 1.0) for p in (0.0, 10.0)][1:]
    figure = loss_sweep_figure(points, LIGHT)
    assert len(figure.axes) == 4  # two scores, two weights of the MSE
    assert [axes.get_title(loc="left") for axes in figure.axes[:2]] == ["MSE ↓, loss.mse=1", "MSE ↓, loss.mse=10"]
    assert [len(axes.texts) for axes in figure.axes] == [3, 4, 3, 4]  # the first point was not trained
    bold = [text.get_text() for axes in figure.axes[:2] for text in axes.texts if text.get_weight() == "bold"]
    assert bold == ["1.1000"]
    assert [len(axes.patches) for axes in figure.axes] == [1, 0, 1, 0]
    assert png(figure) == png(loss_sweep_figure(points, LIGHT))
