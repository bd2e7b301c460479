"""The faults that mutation testing puts into code."""

import ast

import pytest

from studies.mutation import ROOT, TESTS, edits, mutants_of


def mutated(code: str) -> set[str]:
    """The code after each possible change."""
    tree, texts = ast.parse(code), set()
    for node, field, value in edits(tree):
        original = getattr(node, field)
        setattr(node, field, value)
        texts.add(ast.unparse(tree))
        setattr(node, field, original)
    return texts


@pytest.mark.parametrize(("code", "mutants"), [
    ("a + b", {"a - b"}),
    ("a < b", {"a <= b", "a >= b"}),
    ("x[2]", {"x[3]", "x[1]"}),
    ("a and b", {"a or b"}),
    ("flag = True", {"flag = False"}),
    ("a if b else c", {"a if not b else c"}),
    ("def f():\n    return a", {"def f():\n    return None"}),
    ("raise ValueError(1 + 2)", set()),
    ("def f(a: X[1]) -> Y[2]:\n    pass", set()),
])  # fmt: skip
def test_a_mutant_differs_by_one_operator_number_condition_or_returned_value(code, mutants):
    assert mutated(code) == mutants


def test_the_same_seed_draws_the_same_mutants_and_each_differs_in_one_line():
    module = "polarnet/stokes.py"
    mutants = mutants_of(module, 5, seed=1)
    assert mutants == mutants_of(module, 5, seed=1) != mutants_of(module, 5, seed=2)
    code = ast.unparse(ast.parse((ROOT / module).read_text())).splitlines()
    for mutant in mutants:
        changed = [pair for pair in zip(code, mutant.source.splitlines(), strict=True) if pair[0] != pair[1]]
        assert [tuple(line.strip() for line in pair) for pair in changed] == [(mutant.before, mutant.after)]


def test_every_mutated_module_and_each_of_its_tests_exist():
    for module, tests in TESTS.items():
        assert (ROOT / module).is_file()
        assert all((ROOT / test).is_file() for test in tests if test.startswith("tests/"))
