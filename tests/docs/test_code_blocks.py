"""Every code block of README.md and docs/*.md: Python runs, and the parsers of the commands accept the command lines.

A block that cannot run here has a title that says why: ```python title="not run: ...".
"""

import contextlib
import importlib.util
import re
import shlex
import tomllib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from polarnet.cli import main, parse
from polarnet.config.experiments import check_overrides
from polarnet.config.tree import Config

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^ *```(\w*) *([^\n]*)\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
TESTED_ELSEWHERE = {"network.md": "networks/test_onnx_export.py", "recover.md": "recovery/test_recover.py",
                    "methods.md": "benchmark/test_new_method.py"}  # fmt: skip
"""Pages whose Python needs a network, a camera or a table; the named test runs it."""
SHELL = {"source", "xdg-open", "cd", "cp", "git", "done", "for"}
VARIABLES = {"$stage": "ingest", "$PWD": "/photographs"}


class Block(NamedTuple):
    page: Path
    language: str
    title: str
    text: str


def blocks(*languages: str) -> Iterator[Block]:
    """Blocks in the given languages that are meant to run."""
    for page in PAGES:
        for language, title, text in BLOCK.findall(page.read_text()):
            if language in languages and "not run: " not in title:
                yield Block(page, language, title, text)


def command_lines(text: str) -> Iterator[list[str]]:
    """Words of each command, without comments, the parts of pipes and lists apart."""
    for name, value in VARIABLES.items():
        text = text.replace(name, value)
    for line in text.replace("\\\n", " ").splitlines():
        reader = shlex.shlex(line, posix=True, punctuation_chars="|&;")
        reader.whitespace_split, command = True, []
        for word in [*reader, ";"]:
            if set(word) <= set("|&;"):
                command = command[1:] if command[:1] == ["do"] else command
                if command:
                    yield command
                command = []
            elif word != "...":
                command.append(word)


COMMANDS = [(block.page.name, words) for block in blocks("bash", "sh") for words in command_lines(block.text)]


@pytest.mark.parametrize(("page", "words"), COMMANDS, ids=[f"{page}: {' '.join(w)[:80]}" for page, w in COMMANDS])
def test_a_command_of_the_documentation_is_accepted_by_its_parser(page, words, monkeypatch):
    monkeypatch.chdir(ROOT)
    program, *arguments = words
    if program == "python":
        module, *rest = arguments[arguments.index("-m") + 1 :]
        assert importlib.util.find_spec(module) is not None
        if module.startswith("stages."):
            overrides = [word for word in rest if "=" in word and not word.startswith(("ablation=", "--"))]
            check_overrides(Config, ROOT, [_first_choice(word) for word in overrides])
    elif program == "polarnet":
        parse(arguments)
    elif program == "dvc":
        from dvc.cli import parse_args

        parse_args(arguments)
        values = [value for flag, value in pairwise(arguments) if flag == "-S"]
        check_overrides(Config, ROOT, [value for value in values if not value.startswith("+")])
    elif program == "make":
        targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(arguments) <= set(targets)
    elif program == "pip":
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        named = [name for word in arguments for name in re.findall(r"\[(.*)\]", word)]
        assert set(",".join(named).split(",")) <= {"", *extras}
    else:
        assert program in SHELL, f"{page}: no parser for {program}; give the block a title 'not run: REASON'"


def _first_choice(override: str) -> str:
    """The first point of a sweep over values; lists and mappings keep their commas."""
    key, _, value = override.partition("=")
    return override if value.startswith(("[", "{")) else f"{key}={value.partition(',')[0]}"


PYTHON_PAGES = sorted({block.page for block in blocks("python")} - {ROOT / "docs" / page for page in TESTED_ELSEWHERE})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files that blocks open: a small event store, a text recording, frames and a photograph."""
    folder = tmp_path_factory.mktemp("documentation")
    picture = np.random.default_rng(1).integers(0, 255, (12, 18, 3), np.uint8)
    picture = cv2.resize(picture, (600, 400), interpolation=cv2.INTER_LINEAR)
    for name in ("params.yaml", "conf"):
        (folder / name).symlink_to(ROOT / name)
    for name in ("coffee-00", "0", "1", "2"):
        cv2.imwrite(str(folder / f"{name}.png"), picture)
    numbers = np.random.default_rng(2).integers(0, [40, 30, 2], (500, 3))
    lines = [f"{0.001 * k:.6f} {x} {y} {p}" for k, (x, y, p) in enumerate(numbers)]
    (folder / "capture.csv").write_text("\n".join(["40 30", *lines]) + "\n")
    small = ["synthesize.sensor_height=60", "synthesize.sensor_width=80", "synthesize.duration_s=0.2"]
    with contextlib.chdir(folder):
        settings = [*small, "emulate.randomise={cutoff_hz: [100.0, 300.0]}"]
        assert main(["simulate", "coffee-00.png", *settings, "--no-preview", "--out", "out"]) == 0
        (folder / "data").mkdir()
        (folder / "data/events.zarr").symlink_to(folder / "out" / "events.zarr")
    return folder


@pytest.mark.parametrize("page", PYTHON_PAGES, ids=lambda page: page.name)
def test_the_python_of_a_page_runs_from_top_to_bottom(page, folder, monkeypatch):
    monkeypatch.chdir(folder)
    names: dict = {"__name__": "documentation"}
    own = [block for block in blocks("python") if block.page == page]
    for number, block in enumerate(own):
        exec(compile(block.text, f"{page.name}, block {number}", "exec"), names)
    assert len(names) > 2, "no block of the page imports or computes anything"


@pytest.mark.parametrize(("page", "test"), TESTED_ELSEWHERE.items())
def test_pages_that_another_test_runs_are_named_in_it(page, test):
    assert page in (ROOT / "tests" / test).read_text()


def test_each_message_of_the_page_on_troubleshooting_is_one_of_polarnets():
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    quoted = re.findall(r"^\| `([^`]*)` \|", page, re.MULTILINE)
    code = "\n".join(path.read_text() for path in (ROOT / "polarnet").rglob("*.py"))
    joined = re.sub(r'"\s*\n\s*f?"', "", code)  # literals over several lines
    plain = re.sub(r"\{[^{}]*\}", "...", joined)
    missing = [message for message in quoted if message.removesuffix("...") not in joined + plain]
    assert len(quoted) > 20
    assert not missing
