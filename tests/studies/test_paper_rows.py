"""docs/paper_rows.yaml: every file, key, value and test that it names is there."""

import ast
import functools

import pytest
from ruamel.yaml import YAML

from polarnet.config.tree import load
from polarnet.pictures.manifest import split_by_content

STATUSES = ("exact", "chosen", "stated")


@pytest.fixture(scope="module")
def rows(project_root):
    return YAML(typ="safe").load(project_root / "docs" / "paper_rows.yaml")


@pytest.fixture(scope="module")
def paper(project_root):
    return load(project_root, ["experiment=paper"])


@functools.cache
def functions_of(path):
    return {node.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)}


def test_every_row_says_where_it_stands_and_its_files_and_test_are_there(rows, project_root):
    assert len(rows) >= 52
    assert len({row["row"] for row in rows}) == len(rows)
    for row in rows:
        assert set(row) <= {"row", "paper", "status", "where", "test", "values", "note"}, row["row"]
        assert row["status"] in STATUSES, row["row"]
        assert row["paper"][0] in "12345", row["row"]
        assert row["status"] == "exact" or row["note"], f"{row['row']}: a choice needs its reason"
    for row in rows:
        for file in [row["where"]] if isinstance(row["where"], str) else row["where"]:
            assert (project_root / file).is_file(), f"{row['row']}: {file}"
        path, _, name = row["test"].partition("::")
        assert name in functions_of(project_root / "tests" / path), f"{row['row']}: {row['test']}"


def test_every_value_of_the_list_is_that_of_the_paper_experiment(rows, paper):
    values = [pair for row in rows for pair in row.get("values", {}).items()]
    assert len(values) > 50
    for key, value in values:
        assert functools.reduce(getattr, key.split("."), paper) == value, key


def test_1100_photographs_are_1000_for_training_50_for_validation_and_50_for_testing(paper):
    hashes = [f"{number:064x}" for number in range(paper.ingest.limit)]
    splits = split_by_content(hashes, paper.ingest.val_fraction, paper.ingest.test_fraction)
    assert [splits.count(split) for split in ("train", "val", "test")] == [1000, 50, 50]
