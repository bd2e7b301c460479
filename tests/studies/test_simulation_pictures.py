"""The pictures of docs/simulation.md and docs/physics.md."""

from dataclasses import replace

import numpy as np

from polarnet.reports.maps import png
from studies.simulation_pictures import FIGURES, QUIET, few_colours, light_of_one_pixel, pixel_events
from studies.simulation_pictures import parameters_figure as draw


def test_the_events_of_the_pixel_add_up_to_the_change_of_its_log_light():
    """From the first to the last value the log falls by 0.6, less than a threshold short: so do the events in sum."""
    light = light_of_one_pixel(np.array([0.0, 500.0]))
    assert np.isclose(np.log(light[1] / light[0]), -0.6)
    total = int(pixel_events(QUIET).p.sum()) * QUIET.contrast_threshold_on
    assert -0.6 - 1e-6 <= total <= -0.6 + QUIET.contrast_threshold_on


def test_half_the_threshold_gives_about_twice_the_events():
    half = replace(QUIET, contrast_threshold_on=0.1, contrast_threshold_off=0.1)
    assert 1.7 * len(pixel_events(QUIET)) <= len(pixel_events(half)) <= 2.5 * len(pixel_events(QUIET))


def test_the_same_picture_is_drawn_each_time_and_lies_beside_the_pages(project_root):
    assert few_colours(png(draw())) == few_colours(png(draw()))
    pages = "".join((project_root / "docs" / f"{page}.md").read_text() for page in ("simulation", "physics"))
    for name in FIGURES:
        assert f"pictures/{name}.png" in pages
        assert (project_root / "docs" / "pictures" / f"{name}.png").stat().st_size < 300_000
