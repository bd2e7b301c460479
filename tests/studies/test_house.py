"""Counting functions of the study of the code base."""

import pytest

from polarnet.reports.provenance import git
from studies.house import RETIRED, body_lines, folder_sizes, retired_uses, touched_files

SOURCE = '''
def documented():
    """A docstring

    of three lines."""
    a = 1
    # a comment inside the body

    return a


def outer():
    def inner():
        return 1

    return inner


def protocol():
    """Only a docstring."""
'''


def test_a_body_counts_from_its_first_statement_to_its_last_without_the_docstring():
    assert sorted(body_lines(SOURCE)) == [0, 1, 4, 4]


@pytest.mark.parametrize(
    ("text", "word"),
    [  # retired on purpose: studies.house leaves this file out of its search
        ("MOST_EVENTS = 6.0", "MOST_, LEAST_, LARGEST_, GREATEST_"),
        ("motion.window_height", "window for the sensor"),
        ("mosaic_share: 0.5", "mosaic for the panorama"),
        ("    found = search(images)", "participles as names"),
        ("    kept: dict[str, int] = {}", "participles as names"),
        ('"""What the camera saw."""', "what as a noun phrase"),
        ('help="of the sensor"', "of before a noun"),
    ],
)
def test_a_retired_word_is_counted_once(text, word):
    assert retired_uses(text) == dict.fromkeys(RETIRED, 0) | {word: 1}


@pytest.mark.parametrize(
    "text", ["MAX_EVENTS = 6", "window_us", "mosaic: 90 45 / 135 0", "if a == found:", "# What now?"]
)
def test_words_of_the_glossary_are_not_counted(text):
    assert sum(retired_uses(text).values()) == 0


def test_a_folder_of_the_package_counts_for_itself_and_for_the_package():
    files = {"polarnet/stokes.py": "a\nb\n", "polarnet/events/stream.py": "a\n", "docs/a.md": "a\n"}
    assert folder_sizes(files) == {
        "docs": {"files": 1, "lines": 1},
        "polarnet": {"files": 2, "lines": 3},
        "polarnet/events": {"files": 1, "lines": 1},
    }


def test_touched_files_are_those_of_the_package_and_its_configuration(tmp_path):
    def commit(*files):
        for name in files:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(name)
        git(tmp_path, "add", ".")
        git(tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "--quiet", "--allow-empty", "-m", "one")

    git(tmp_path, "init", "--quiet")
    commit("README.md")
    commit("polarnet/networks/new.py", "polarnet/networks/weights/new.safetensors", "params.yaml", "tests/test_new.py")
    commit("polarnet/methods/new.py")
    assert touched_files(tmp_path, "HEAD~1") == 2
    assert touched_files(tmp_path, "HEAD") == 1
    with pytest.raises(ValueError, match=r"expected a commit that changes polarnet"):
        touched_files(tmp_path, "HEAD~2")
