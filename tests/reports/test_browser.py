"""The pages in headless Chromium: they work, show everything, and ask for nothing outside."""

import contextlib
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from polarnet.reports.artefacts import Run
from polarnet.reports.page import write_report
from polarnet.reports.player import write_player
from polarnet.reports.viewing import films_of

pytest.importorskip("playwright", reason="playwright is not installed: pip install 'polarnet[dev]'")
if shutil.which("chromium") is None:
    pytest.skip("no Chromium was found: install Debian's chromium", allow_module_level=True)

SERIOUS = ("serious", "critical")
TIMEOUT_MS = 20_000
CUT_OFF = """() => [document.documentElement, ...document.querySelectorAll("section, table, figure, td, th, details")]
  .filter((one) => one.scrollWidth > one.clientWidth + 1 && one.clientWidth > 0)
  .filter((one) => !one.closest("thead") || getComputedStyle(one.closest("thead")).clipPath === "none")
  .map((one) => `${one.tagName} ${one.className} ${one.textContent.slice(0, 40)}`)"""
"""Elements whose content is wider than they are; 1 px for rounding. Headings for screen readers alone do not count."""


@contextlib.contextmanager
def opened(browser: Any, file: Path, width: int, scheme: str) -> Iterator[tuple[Any, list[str]]]:
    """The page in a tab of its own with every `details` open, and the problems so far.

    Problems are messages of the console, errors, and requests for anything but the file and the data inside it.
    """
    page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page.set_default_timeout(TIMEOUT_MS)
    problems: list[str] = []
    page.on("console", lambda message: problems.append(f"console: {message.text}"))
    page.on("pageerror", lambda error: problems.append(f"error: {error}"))
    inside = ("data:", "blob:", file.as_uri())
    page.on("request", lambda one: problems.extend([] if one.url.startswith(inside) else [f"request: {one.url}"]))
    try:
        page.goto(file.as_uri())
        settle(page)
        yield page, problems
    finally:
        page.close()


def settle(page: Any) -> None:
    """Open everything, and wait for the player."""
    page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    page.wait_for_function("[...document.querySelectorAll('.player')].every((one) => one.dataset.ready === 'yes')")


def wear(page: Any, width: int, scheme: str) -> None:
    """Show an open page at another width, in light or dark."""
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": 900})
    page.wait_for_timeout(150)  # the player follows the width


def axe_serious(page: Any) -> list[str]:
    """Serious and critical faults that axe-core finds, each with the first element; needs axe-playwright-python."""
    page.evaluate(Path(find_spec("axe_playwright_python").origin).with_name("axe.min.js").read_text(encoding="utf-8"))
    audit = page.evaluate("axe.run(document, { resultTypes: ['violations'] })")
    return [
        f"{fault['id']}: {fault['help']}: {fault['nodes'][0]['html'][:200]}"
        for fault in audit["violations"]
        if fault["impact"] in SERIOUS
    ]


RUN = Run("dvc repro", {"seed": 1, "loss": {"mse": 1.0}}, {"seed": "1", "commit": "abc"})
LOOKS = [(width, scheme) for width in (400, 800, 1400) for scheme in ("light", "dark")]


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def files(data, paths, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    films = films_of(data / "frames.zarr")
    dim = [film._replace(maps=[one._replace(frames=one.frames // 10) for one in film.maps if one.kind == "dolp"])
           for film in films[:1]]  # fmt: skip
    return {
        "dim": write_player(folder / "dim.html", "dim", dim, {}),
        "report": write_report(paths, ["e2v"], RUN, folder),
        "viewer": write_player(folder / "view.html", "frames.zarr", films, {"command": "polarnet view frames.zarr"}),
    }


def picture(page, role):
    return page.evaluate(f"document.querySelector('[data-role={role}] canvas').toDataURL()")


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["report", "viewer"])
def test_the_page_works_alone_cuts_nothing_off_in_light_or_dark_and_axe_finds_no_serious_fault(browser, files, name):
    pytest.importorskip("axe_playwright_python", reason="pip install axe-playwright-python")
    with opened(browser, files[name], 1400, "light") as (page, problems):
        for width, scheme in LOOKS:
            wear(page, width, scheme)
            assert page.evaluate(CUT_OFF) == [], (width, scheme)
            if (width, scheme) in ((800, "light"), (400, "dark")):
                assert axe_serious(page) == []
        assert problems == []


def test_the_time_slider_and_play_change_the_picture_and_its_time_and_pause_stops(browser, files):
    with opened(browser, files["viewer"], 800, "light") as (page, _):
        before, time = picture(page, "panes"), page.inner_text("[data-role=ms]")
        assert page.input_value("[data-role=time]") == page.get_attribute("[data-role=time]", "max") != "0"
        page.locator("[data-role=time]").focus()
        page.keyboard.press("ArrowLeft")
        assert picture(page, "panes") != before
        assert page.inner_text("[data-role=ms]") != time
        page.click("[data-role=play]")
        page.wait_for_function("document.querySelector('[data-role=time]').value > 1")
        page.click("[data-role=play]")
        time = page.input_value("[data-role=time]")
        page.wait_for_timeout(400)
        assert page.input_value("[data-role=time]") == time


def test_the_error_of_a_constant_tenth_less_is_read_at_the_cursor(browser, files):
    """`ours` of the fixture is .9 of the truth, so its error is a tenth of the true DoLP beside it."""
    with opened(browser, files["report"], 1400, "light") as (page, _):
        page.select_option("[data-role=quantity]", label="error of DoLP")
        page.locator("[data-role=panes]").focus()
        page.keyboard.press("ArrowDown")
        captions = (text.split("\n") for text in page.locator(".panes figcaption").all_inner_texts())
        values = {caption[0]: caption[-1] for caption in captions}
        ours = next(value for title, value in values.items() if title.startswith("ours"))
        assert float(ours) == pytest.approx(0.1 * float(values["True DoLP"]), abs=0.03)
        assert "True DoLP" in page.inner_text("[data-role=values]")


def test_scaled_to_the_scene_the_colours_end_at_its_dolp_and_values_stay(browser, files):
    """The film has a tenth of the fixture's DoLP, so no pixel is above 0.1."""
    with opened(browser, files["dim"], 1400, "light") as (page, problems):
        before, legend = picture(page, "panes"), page.inner_text("[data-role=legend]")
        assert legend.split() == ["DoLP", "0", "1"]
        page.check("[data-role=scale]")
        assert picture(page, "panes") != before
        end = float(page.inner_text("[data-role=legend]").split()[-1])
        assert 0.02 < end < 0.12
        page.locator("[data-role=panes]").focus()
        page.keyboard.press("ArrowDown")
        assert 0 < float(page.locator(".panes figcaption span").first.inner_text()) <= end + 0.02
        assert problems == []


def test_zoom_is_shared_by_all_pictures_and_a_button_beside_a_scene_opens_it_in_the_player(browser, files):
    with opened(browser, files["report"], 1400, "light") as (page, _):
        assert page.locator(".chart svg").count() == 1
        page.locator("[data-role=zoom]").fill("3")
        transforms = page.evaluate(
            "[...document.querySelectorAll('.panes canvas')].map((c) => getComputedStyle(c).transform)"
        )
        assert len(transforms) > 3
        assert {transform.split(",")[0] for transform in transforms} == {"matrix(3"}
        button = page.locator("button[data-scene]").last
        button.click()
        settle(page)
        number = int(page.input_value("[data-role=scene]"))
        names = page.locator("[data-role=scene] option").all_inner_texts()
        assert names[number] == button.get_attribute("data-scene")
