"""The documentation site: generated pages, and a build without warnings or requests to other hosts."""

import re
import subprocess
import sys

import pytest
from ruamel.yaml import YAML

from studies.site import generated_pages, parameters_page


def test_the_page_of_parameters_has_a_row_for_each_value_of_params_yaml(project_root):
    values = YAML(typ="safe").load(project_root / "params.yaml")
    page = parameters_page()
    assert all(f"## {name}\n" in page for name, value in values.items() if isinstance(value, dict))
    assert all(f"| `{key}` |" in page for key in values["emulate"])
    assert "| `limit` | `null` | integer > 0 or null | largest number of pictures from the folder" in page


def test_the_python_reference_lists_the_modules_of_a_folder():
    assert "::: polarnet.events.stream\n" in generated_pages()["api/events.md"]


@pytest.mark.site
def test_the_site_builds_without_warnings_and_loads_nothing_from_other_hosts(project_root, tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    run = subprocess.run(command, cwd=project_root, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    loaded = re.compile(
        r"<(?:script|img|iframe)[^>]*src=\"?(?:https?:)?//|<link[^>]*stylesheet[^>]*href=\"?(?:https?:)?//"
    )
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 40
    assert not [page.name for page in pages if loaded.search(page.read_text())]
