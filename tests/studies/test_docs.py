"""The generated tables: every figure comes from docs/results, and no block can be edited by hand."""

import json

import pytest

import polarnet
from studies.docs import block_text, read_file, read_tables, update_pages

TABLES = """
speed:
  file: speed
  section: models
  rows: models
  columns: {model: "`{name}`", MSE: "{mse:.3f}", gain: "{gain:+.1f} dB", n: "{n:,}"}
  caption: "{count} models. {origin}"
chosen:
  file: speed
  section: models
  rows: {2 seeds: a}
  columns: {"": "{label}", MSE: "{models[$name][mse]:.1f}"}
  caption: ""
without:
  file: speed
  rows: models
  without: [n, 1200]
  columns: {model: "{name}"}
  caption: ""
"""
BEFORE = "# title\n\n<!-- results:speed -->\n<!-- /results:speed -->\n\nafter\n"
MACHINE = {"machine": "Xeon", "cores": 2, "bf16_units": []}
RECORD = {**MACHINE, "load": 0.5, "versions": {"torch": "2.13.0"}, "commit": "0123456789ab"}
CONSTANTS = ("zeros", "train_mean", "constant_real")
MODELS = {"a": {"mse": 0.0251, "n": 1200, "gain": None}, "b": {"mse": 0.5}}


@pytest.fixture
def project(tmp_path):
    (tmp_path / "docs" / "results").mkdir(parents=True)
    (tmp_path / "docs" / "tables.yaml").write_text(TABLES)
    results = {"models": MODELS, "count": 2, "records": {"models": RECORD}}
    (tmp_path / "docs" / "results" / "speed.json").write_text(json.dumps(results))
    (tmp_path / "README.md").write_text(BEFORE)
    return tmp_path


def test_a_table_has_a_row_for_each_entry_or_those_chosen_and_its_caption_names_the_commit(project):
    assert block_text(read_tables(project)["speed"], read_file(project, "speed")).splitlines() == [
        "| model | MSE | gain | n |",
        "|---|---:|---:|---:|",
        "| `a` | 0.025 | - | 1,200 |",
        "| `b` | 0.500 | - | - |",
        "",
        "2 models. Commit `0123456789`.",
    ]
    text = block_text(read_tables(project)["chosen"], read_file(project, "speed"))
    assert text == "|  | MSE |\n|---|---:|\n| 2 seeds | 0.0 |"
    assert block_text(read_tables(project)["speed"], {}).startswith("Not measured yet")
    assert block_text(read_tables(project)["without"], read_file(project, "speed")).splitlines()[2:] == ["| b |"]


def test_an_update_changes_the_block_alone_and_check_notices_an_edit_by_hand(project):
    readme = project / "README.md"
    assert update_pages(project, check=True) == [readme]
    assert readme.read_text() == BEFORE
    assert update_pages(project, check=False) == [readme]
    text = readme.read_text()
    assert text.startswith("# title\n\n<!-- results:speed -->\n\n| model |")
    assert text.endswith("\n\n<!-- /results:speed -->\n\nafter\n")
    assert update_pages(project, check=True) == []
    readme.write_text(text.replace("0.025", "0.001"))
    assert update_pages(project, check=True) == [readme]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("<!-- results:speed -->\n", "close each block"),
        (BEFORE.replace("speed", "dreams"), "no block dreams; expected one of speed"),
    ],
)
def test_a_block_that_is_open_or_unknown_is_an_error(project, text, error):
    (project / "README.md").write_text(text)
    with pytest.raises(ValueError, match=error):
        update_pages(project, check=True)


def test_every_block_is_measured_and_shown_and_each_machine_listed_once(project_root, project):
    pages = "".join(page.read_text() for page in [project_root / "README.md", *(project_root / "docs").glob("*.md")])
    for name, table in read_tables(project_root).items():
        text = block_text(table, read_file(project_root, table.file))
        assert "Not measured" not in text, name
        assert any(digit in text for digit in "123456789"), name
        assert f"<!-- results:{name} -->" in pages
        rows = [line.split(" | ") for line in text.splitlines()[2:] if line.startswith("| ")]
        assert all(set(column) != {"-"} for column in zip(*rows, strict=True)), f"{name}: a column without any value"
    assert read_file(project, "records") == {
        "machines": [{"letter": "A", "machine": "Xeon", "cores": 2, "units": "none", "versions": "torch 2.13.0"}],
        "measured": {"speed": "models: A, load 0.5, `0123456789`"},
    }
    listed = read_tables(project_root)["records"].rows.values()
    assert sorted(listed) == list(read_file(project_root, "records")["measured"])


def test_every_table_of_figures_has_a_commit_and_those_of_a_release_have_the_same(project_root):
    """Between releases, when the version ends in `.dev`, sections are measured one at a time."""
    without_figures = ("records", "inspection", "paper_rows.yaml")
    for name, table in read_tables(project_root).items():
        if table.file not in without_figures:
            assert table.section in read_file(project_root, table.file)["records"], name
    files = [read_file(project_root, path.stem) for path in (project_root / "docs" / "results").glob("*.json")]
    commits = {record["commit"] for file in files for record in file.get("records", {}).values()}
    if ".dev" not in polarnet.__version__:
        assert commits == {read_file(project_root, "release")["commit"]}


@pytest.mark.parametrize(
    ("scenes", "method", "constant"),
    [
        ("photographs_large", "firenet_published+gain", "train_mean"),
        ("measured", "firenet_published+gain", "constant_real"),
        ("sensors.noisy", "firenet_published+gain", "train_mean"),
    ],
)
def test_the_best_method_and_constant_of_the_readme_are_the_best(project_root, scenes, method, constant):
    """The block `abilities` of docs/tables.yaml names them; the oracle mean needs the truth and is neither."""
    rows = read_file(project_root, "robustness")["test"]["tables"][scenes]["rows"]
    block = read_tables(project_root)["abilities"].caption
    for best, others in ((method, ("highpass+gain", "firenet_published+gain")), (constant, CONSTANTS)):
        assert min(others, key=lambda row: rows[row]["mse"]) == best
        assert f"{{test[tables][{scenes}][rows][{best}][mse]:rms.2f}}" in block
