"""The generated tables: every figure comes from docs/results, and no block can be edited by hand."""

import math
import re
import shutil
from itertools import count

import pytest

from studies.blocks import BLOCKS
from studies.docs import block_text, update_results_blocks
from studies.network_blocks import best_reconstruction
from studies.tables import markdown, origin

BEFORE = "# title\n\n<!-- results:lpips -->\n<!-- /results:lpips -->\n\nafter\n"
NO_FIGURE = re.compile(r"On \S+ cores? \(.*?`\)\.|```.*?```|`[^`]*`|[Ss]eed \d", re.DOTALL)
"""Where a text names its machine and commit, and quotes output, overrides, commits and seeds."""
CONSTANTS = {"95", "0.1", "1.04", "23", "5", "1", "2", "3", "6"}
"""Confidence level, LPIPS's version, the paper's claim, reference cases, warm-up; counts of seeds and of sequences."""


@pytest.fixture
def project(tmp_path, project_root):
    shutil.copytree(project_root / "docs" / "results", tmp_path / "docs" / "results")
    (tmp_path / "README.md").write_text(BEFORE)
    return tmp_path


def changed(value, factors):
    """The same results with every number multiplied by a factor of its own."""
    if isinstance(value, dict):
        return {key: changed(entry, factors) for key, entry in value.items()}
    if isinstance(value, list):
        return [changed(entry, factors) for entry in value]
    return value if isinstance(value, bool) or not isinstance(value, int | float) else next(factors) * value


def figures(text):
    """Cells that hold a number, and numbers in sentences, without headings."""
    lines = NO_FIGURE.sub("", text).splitlines()
    cells = [cell.strip(" *") for line in lines if line.startswith("| ") for cell in line.split("|")[2:]]
    prose = [
        word
        for line in lines
        if not line.startswith("|")
        for word in re.findall(r"(?<![\w.])[+-]?\d(?:[\d.,]*\d)?(?:e-\d+)?", line)
    ]
    return [one for one in cells + prose if re.fullmatch(r"[+-]?[\d.,e%-]+( ± .*|<br>.*)?", one) and one != "-"]


@pytest.mark.parametrize("name", BLOCKS)
def test_every_figure_of_a_block_follows_its_file(name, project_root):
    block = BLOCKS[name]
    folder = project_root / "docs" / "results"
    if block.section not in (results := block.results(folder)):
        assert block_text(name, folder) == f"Not measured yet; `python -m {block.module}` measures it."
        return
    others = changed(results, (2 + k % 7 / 3 for k in count()))
    before, after = figures(block.text(results)), figures(block.text(others))
    assert {
        one for one, other in zip(before, after, strict=True) if one == other and re.search("[1-9]", one)
    } <= CONSTANTS


def test_a_table_aligns_numbers_marks_missing_ones_and_averages_several_trainings():
    rows = [{"name": "a", "scores": {"mse": [0.02, 0.03]}, "n": 1200}, {"name": "b", "scores": {}, "n": None}]
    columns = {"row": "`{name}`", "MSE": "{scores[mse]:.3f}", "gain": "{gain:+.1f} dB", "n": "{n:,}"}
    assert markdown(columns, rows).splitlines() == [
        "| row | MSE | gain | n |",
        "|---|---:|---:|---:|",
        "| `a` | 0.025 ± 0.007 | - dB | 1,200 |",
        "| `b` | - | - dB | - |",
    ]


def test_the_best_reconstruction_is_the_one_with_the_smallest_error():
    assert best_reconstruction({"cf": {"mse": 0.2}, "highpass": {"mse": 0.1}, "ours": {"mse": 0.01}}) == "highpass"


def test_an_expected_error_is_shown_as_a_factor():
    sets = {name: {"mse": 0.03, "log_error": math.log(1.5)} for name in ("simulated", "measured")}
    record = {"machine": "a processor", "cores": 2, "load": 0.1, "versions": {}, "commit": "abc"}
    text = BLOCKS["expected_errors"].text({"seed_1": {"sets": sets}, "records": {"seed_1": record}})
    assert "| seed 1 | 0.0300 | 1.50 | 0.0300 | 1.50 |" in text
    assert "Seed 1: On 2 cores (a processor" in text


def test_an_ablation_shows_the_unchanged_network_first_and_then_the_worst():
    rows = {name: {"mse": mse} for name, mse in (("sums", 0.04), ("scales", 0.05), ("nothing", 0.045))}
    table = markdown(BLOCKS["ablation"].columns, BLOCKS["ablation"].rows({"ablation": {"rows": rows}}))
    assert re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE) == ["nothing", "scales", "sums"]


def test_an_update_changes_the_block_alone_and_a_second_one_nothing(project):
    assert update_results_blocks(project, check=False) == [project / "README.md"]
    text = (project / "README.md").read_text()
    assert text.startswith("# title\n\n<!-- results:lpips -->\n\n| backbone |")
    assert text.endswith("\n\n<!-- /results:lpips -->\n\nafter\n")
    assert update_results_blocks(project, check=False) == []


def test_check_writes_nothing_and_notices_an_edit_by_hand(project):
    readme = project / "README.md"
    assert update_results_blocks(project, check=True) == [readme]
    assert readme.read_text() == BEFORE
    update_results_blocks(project, check=False)
    assert update_results_blocks(project, check=True) == []
    readme.write_text(readme.read_text().replace("| `vgg` | ", "| `vgg` | 9"))
    assert update_results_blocks(project, check=True) == [readme]


def test_pages_below_docs_are_updated_too(project):
    (project / "docs" / "pipeline.md").write_text(BEFORE)
    assert project / "docs" / "pipeline.md" in update_results_blocks(project, check=False)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("<!-- results:lpips -->\n", "close each block"),
        (BEFORE.replace("lpips", "dreams"), "no block results:dreams; expected one of headline"),
    ],
)
def test_a_block_that_is_open_or_unknown_is_an_error(project, text, error):
    (project / "README.md").write_text(text)
    with pytest.raises(ValueError, match=error):
        update_results_blocks(project, check=True)


def test_the_sentence_below_a_table_names_the_bf16_units_that_the_record_has():
    older = {"machine": "Xeon", "cores": 2, "load": 0.5, "versions": {"torch": "2.13.0"}, "commit": "0123456789ab"}
    end = ", load 0.5 before the start; torch 2.13.0; commit `0123456789`)."
    assert origin(older) == f"On 2 cores (Xeon{end}"
    assert origin({**older, "bf16_units": []}) == f"On 2 cores (Xeon{end}"
    assert origin({**older, "bf16_units": ["AMX", "AVX512-BF16"]}) == f"On 2 cores (Xeon with AMX and AVX512-BF16{end}"
