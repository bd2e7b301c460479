"""The notebooks of docs/notebooks run from top to bottom."""

import jupytext
import pytest
from nbclient import NotebookClient

pytestmark = pytest.mark.site
NOTEBOOKS = ("tutorial", "own_camera")


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_and_draws_its_last_figure(name, project_root, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(project_root))
    notebook = jupytext.read(project_root / "docs" / "notebooks" / f"{name}.py")
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert any("image/png" in output.get("data", {}) for output in notebook.cells[-1].outputs)
