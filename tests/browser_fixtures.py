"""Pages in headless Chromium: faults of the console, requests, cut-off elements, accessibility."""

import contextlib
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

SERIOUS = ("serious", "critical")
TIMEOUT_MS = 20_000
CUT_OFF = """() => [document.documentElement, ...document.querySelectorAll("section, table, figure, td, th, details")]
  .filter((one) => one.scrollWidth > one.clientWidth + 1 && one.clientWidth > 0)
  .filter((one) => !one.closest("thead") || getComputedStyle(one.closest("thead")).clipPath === "none")
  .map((one) => `${one.tagName} ${one.className} ${one.textContent.slice(0, 40)}`)"""
"""Elements whose content is wider than they are; 1 px for rounding. Headings for screen readers alone do not count."""


def chromium_path() -> str | None:
    """Debian's Chromium; None if it is not installed."""
    return shutil.which("chromium")


@contextlib.contextmanager
def opened(browser: Any, file: Path, width: int, scheme: str) -> Iterator[tuple[Any, list[str]]]:
    """The page in a tab of its own with every `details` open and every chart drawn, and the problems so far.

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
    """Open everything, draw all charts, and wait for the player."""
    page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    page.evaluate("document.querySelectorAll('img').forEach((image) => { image.loading = 'eager'; })")
    page.wait_for_function("[...document.images].every((image) => image.complete)")
    for chart in page.locator("[data-chart]").all():
        chart.scroll_into_view_if_needed()
    page.wait_for_function("[...document.querySelectorAll('[data-chart]')].every((one) => one.dataset.drawn)")
    page.wait_for_function("[...document.querySelectorAll('.player')].every((one) => one.dataset.ready === 'yes')")
    page.evaluate("scrollTo(0, 0)")


def wear(page: Any, width: int, scheme: str) -> None:
    """Show an open page at another width, in light or dark."""
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": 900})
    page.wait_for_timeout(150)  # charts follow the width and the colours


def cut_off(page: Any) -> list[str]:
    """Elements that do not fit, and charts wider than their place."""
    charts = page.evaluate(
        "[...document.querySelectorAll('[data-chart]')].filter((one) => one.scrollWidth > one.clientWidth + 1)"
        ".map((one) => one.dataset.chart)"
    )
    return page.evaluate(CUT_OFF) + charts


def axe_serious(page: Any) -> list[str]:
    """Serious and critical faults that axe-core finds, each with the first element; needs axe-playwright-python."""
    page.evaluate(Path(find_spec("axe_playwright_python").origin).with_name("axe.min.js").read_text(encoding="utf-8"))
    audit = page.evaluate("axe.run(document, { resultTypes: ['violations'] })")
    return [
        f"{fault['id']}: {fault['help']}: {fault['nodes'][0]['html'][:200]}"
        for fault in audit["violations"]
        if fault["impact"] in SERIOUS
    ]
