"""The documentation site and the notebooks: no warnings, no requests to other hosts."""

import re
import subprocess
import sys

import jupytext
import pytest
from nbclient import NotebookClient

pytestmark = pytest.mark.site
LOADED = re.compile(r"<(?:script|img|iframe)[^>]*src=\"?(?:https?:)?//|<link[^>]*stylesheet[^>]*href=\"?(?:https?:)?//")


def test_the_site_builds_without_warnings_and_loads_nothing_from_other_hosts(project_root, tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    run = subprocess.run(command, cwd=project_root, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 25
    assert not [page.name for page in pages if LOADED.search(page.read_text())]
    reference = (tmp_path / "site" / "python.html").read_text()
    assert "<blockquote>" not in reference  # examples of docstrings are code


NOTEBOOKS = ("tutorial", "own_camera")


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_and_draws_its_last_figure(name, project_root, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(project_root))
    notebook = jupytext.read(project_root / "docs" / "notebooks" / f"{name}.py")
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert any("image/png" in output.get("data", {}) for output in notebook.cells[-1].outputs)
