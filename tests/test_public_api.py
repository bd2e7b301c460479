"""The names that rooms export: typed, loaded on first use, each with an example that runs."""

import ast
import doctest
import importlib
import inspect
import subprocess
import sys
from itertools import zip_longest
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOT_LIBRARY = ("cli", "config")
"""Folders of polarnet that are the command line and the configuration."""
ROOMS = ("events", "metrics", "networks", "pictures", "recordings", "recovery", "reports", "simulation", "storage")


def docstrings(file):
    """Docstring by name of the public functions, classes and values at the top level of a file."""
    body = ast.parse(file.read_text()).body
    for node, after in zip_longest(body, body[1:]):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node.name, ast.get_docstring(node) or ""
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            yield node.targets[0].id, inspect.cleandoc(after.value.value) if text else ""


def public_names():
    """Module and name of everything that the `__init__` of a folder of the library exports."""
    for file in sorted(ROOT.glob("polarnet/*/__init__.py")):
        if file.parent.name in NOT_LIBRARY:
            continue
        yield from ((f"polarnet.{file.parent.name}", name) for name, _ in docstrings(file))
        lazy = [node for block in ast.parse(file.read_text()).body if isinstance(block, ast.If) for node in block.body]
        yield from ((node.module, name.name) for node in lazy for name in node.names)


def module_name(file: Path) -> str:
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


EXAMPLES = {
    (module_name(file), name): text
    for file in sorted(ROOT.glob("polarnet/**/*.py"))
    if ">>>" in file.read_text()
    for name, text in docstrings(file)
    if ">>>" in text
}


@pytest.mark.parametrize("room", ROOMS)
def test_every_exported_name_exists_and_is_listed(room):
    package = importlib.import_module(f"polarnet.{room}")
    assert package.__all__
    for name in package.__all__:
        assert getattr(package, name) is not None
        assert name in dir(package)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        package.nothing  # noqa: B018


def test_every_public_name_has_an_example():
    names = list(public_names())
    assert len(names) > 45
    assert [name for name in names if name not in EXAMPLES] == []


@pytest.mark.parametrize("name", EXAMPLES, ids=".".join)
def test_an_example_prints_what_its_docstring_says(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    example = doctest.DocTestParser().get_doctest(EXAMPLES[name], {}, name[1], None, None)
    assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example).failed == 0


def test_importing_the_rooms_loads_no_large_package():
    imports = "; ".join(f"import polarnet.{room}" for room in ROOMS)
    script = f"import sys; {imports}; print([name for name in ('torch', 'zarr', 'av', 'hydra') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True).stdout.strip() == "[]"
