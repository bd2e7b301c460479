"""The documentation site: generated pages, and a build without warnings or requests to other hosts."""

import re
import subprocess
import sys

import pytest
from ruamel.yaml import YAML

from studies.browser import chromium_path
from studies.site import ROOT, generated_pages, parameters_page


def test_the_page_of_parameters_has_a_row_for_each_value_of_params_yaml(project_root):
    values = YAML(typ="safe").load(project_root / "params.yaml")
    page = parameters_page()
    assert all(f"## {name}\n" in page for name, value in values.items() if isinstance(value, dict))
    assert all(f"| `{key}` |" in page for key in values["emulate"])
    assert "| `limit` | `null` | integer > 0 or null | largest number of pictures from the folder" in page


def test_the_python_reference_lists_the_modules_of_a_folder():
    assert "::: polarnet.events.stream\n" in generated_pages()["api/events.md"]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("documentation") / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return folder


@pytest.mark.site
def test_the_site_builds_without_warnings_and_loads_nothing_from_other_hosts(site):
    loaded = re.compile(
        r"<(?:script|img|iframe)[^>]*src=\"?(?:https?:)?//|<link[^>]*stylesheet[^>]*href=\"?(?:https?:)?//"
    )
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    assert not [page.name for page in pages if loaded.search(page.read_text())]


@pytest.mark.site
def test_examples_of_docstrings_are_code_on_the_pages_of_the_reference(site):
    page = (site / "api" / "metrics.html").read_text()
    assert page.count('<div class="highlight">') == 5
    assert "<blockquote>" not in page


@pytest.mark.site
def test_search_and_the_player_of_the_home_page_work_in_a_folder_without_a_server(site):
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install 'polarnet[dev]'")
    if chromium_path() is None:
        pytest.skip("no Chromium was found: install Debian's chromium")
    with playwright.sync_playwright() as started:
        page = started.chromium.launch(executable_path=chromium_path()).new_page(
            viewport={"width": 1400, "height": 900}
        )
        problems = []
        page.on("console", lambda message: problems.append(message.text))
        page.on("request", lambda request: problems.extend([request.url] if request.url.startswith("http") else []))
        page.goto((site / "index.html").as_uri())
        page.locator("input[name=query]").press_sequentially("Malus")
        assert "Malus" in page.locator(".md-search-result__item").first.inner_text()
        page.keyboard.press("Escape")
        page.frame_locator("iframe[title]").locator(".player[data-ready=yes]").wait_for()
        assert problems == []
