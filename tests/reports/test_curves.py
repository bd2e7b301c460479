import io

import matplotlib.image

from polarnet.reports.curves import event_budget_figure, sensitivity_figure
from polarnet.reports.maps import png


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


def test_the_figures_are_drawn_the_same_each_time():
    for draw, results in (
        (event_budget_figure, BUDGET),
        (sensitivity_figure, SETTINGS),
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
