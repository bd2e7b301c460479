"""Size and wording of the code base: python -m studies.house [--uses WORD] [--write]

Counts the files and lines of every folder, the lines of function bodies and the uses of retired words in this clone.
`studies.new_baselines` counts the files of a new baseline, `studies.measure tests` the minutes of the tests. --write
puts the figures into docs/results/house.json.
"""

import ast
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from statistics import median, quantiles
from typing import Any

from polarnet.reports.provenance import git
from studies.measure import arguments_of, command_line, machine_record, read_results, write_section

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("polarnet", "stages", "studies", "tests", "conf", "docs")
BASELINE_FILES = ("polarnet", "params.yaml", "dvc.yaml", "conf", "stages")
"""Where a baseline is added; its tests, documentation and weights are not counted."""
TEXT = (".py", ".md", ".yaml", ".toml")
RETIRED = {
    "MOST_, LEAST_, LARGEST_, GREATEST_": r"\b_?(?:MOST|LEAST|LARGEST|GREATEST)_\w+",
    "window for the sensor": r"\bwindow_(?:height|width)\b|\bsensor window\b",
    "mosaic for the panorama": r"\bmosaic_(?:prior|noise|drift|renewal|scale|share)\b|\bablation=mosaic\b|\[mosaic\]",
    "picture_of for scenes": r"\bpicture_of\b",
    "evened for drawn towards one polarization": r"\b(?:un)?evened\b",
    "private names": r"\b_shoot\w*|\b_settle\w*|\b_hand_back\w*|\b_check_taken\b|\bOF_LOG_VARIANCE\b"
    r"|\bkept_in_memory\b",
    "participles as names": r"\b(?:found|seen|told|shown|kept|made)\b(?=(?:: [^\"'\n]*)? = )",
    "what as a noun phrase": r"(?:\"\"\"|# )What (?!.*\?)",
    "of before a noun": r"(?:\"\"\"|# )Of (?!.*\?)|help=f?\"(?:of|where) ",
}
"""Retired words of the glossary and the expression that finds each."""
HERE = ("studies/house.py", "tests/studies/test_house.py", "docs/results", "CHANGELOG.md")
"""Not searched: this list, its test, measured text, and the history of releases."""


def body_lines(source: str) -> list[int]:
    """Number of lines of every function body: from its first statement to its last, without the docstring.

    Comments and blank lines inside the span count; a body that consists of its docstring alone has 0 lines. A nested
    function counts by itself and as part of the function around it.
    """
    lengths = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
            lengths.append(1 + (body[-1].end_lineno or 0) - body[0].lineno if body else 0)
    return lengths


def retired_uses(text: str) -> dict[str, int]:
    """Number of uses of each retired word in a text."""
    return {name: len(re.findall(pattern, text)) for name, pattern in RETIRED.items()}


def folder_sizes(files: Mapping[str, str]) -> dict[str, dict[str, int]]:
    """Files and lines of each folder and of each folder below polarnet/, by path of the file."""
    sizes: dict[str, dict[str, int]] = {}
    for path, text in sorted(files.items()):
        top, *rest = path.split("/")
        inner = [f"{top}/{rest[0]}"] if top == "polarnet" and len(rest) > 1 else []
        for folder in (top, *inner):
            size = sizes.setdefault(folder, {"files": 0, "lines": 0})
            size["files"] += 1
            size["lines"] += text.count("\n")
    return sizes


def touched_files(root: Path, commit: str) -> int:
    """Number of files of the package and its configuration that a commit changes or adds."""
    others = (":!*.safetensors", ":!*/weights/*.json")
    paths = git(root, "diff", "--name-only", f"{commit}~1", commit, "--", *BASELINE_FILES, *others)
    if not paths:
        raise ValueError(f"expected a commit that changes {', '.join(BASELINE_FILES)}, got {commit}")
    return len(paths.splitlines())


def tracked_texts(root: Path) -> Iterator[tuple[str, str]]:
    """Path and content of every tracked text file."""
    for path in git(root, "ls-files").splitlines():
        if path.endswith(TEXT) and not path.startswith(HERE) and (root / path).exists():
            yield path, (root / path).read_text(encoding="utf-8")


def figures(root: Path) -> dict[str, Any]:
    """Section `house` of docs/results/house.json."""
    texts = dict(tracked_texts(root))
    package = {path: text for path, text in texts.items() if path.startswith("polarnet/") and path.endswith(".py")}
    bodies = [length for text in package.values() for length in body_lines(text)]
    baselines = read_results(root, "house").get("baselines", {})
    uses = total(retired_uses(text) for text in texts.values())
    return {
        "package_lines": sum(text.count("\n") for text in package.values()),
        "top_level_modules": sum(path.count("/") == 1 and not path.endswith("__.py") for path in package),
        "dvc_yaml_lines": texts["dvc.yaml"].count("\n"),
        "body_median": median(bodies),
        "body_p90": round(quantiles(bodies, n=10)[-1]),
        **{f"files_per_{kind}_baseline": one["files"] for kind, one in baselines.items()},
        "retired_words": sum(uses.values()),
        "retired": {name: count for name, count in uses.items() if count},
        "test_minutes": read_results(root, "pipeline").get("test_minutes"),
        "folders": folder_sizes({path: text for path, text in texts.items() if path.split("/")[0] in FOLDERS}),
    }


def total(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Sums of several counts by key."""
    sums = dict.fromkeys(RETIRED, 0)
    for count in counts:
        sums = {key: sums[key] + count[key] for key in sums}
    return sums


def main() -> None:
    """Print the figures, and write them if asked."""
    parser = command_line(__doc__, "docs/results/house.json")
    parser.add_argument(
        "--uses", metavar="WORD", choices=[*RETIRED, "all"], help="list the lines that use a retired word"
    )
    options = arguments_of(parser)
    if options.uses:
        for path, text in tracked_texts(ROOT):
            for number, line in enumerate(text.splitlines(), 1):
                words = [name for name, count in retired_uses(line).items() if count]
                if options.uses in words or (words and options.uses == "all"):
                    print(f"{path}:{number}: {line.strip()}")
        return
    measured = figures(ROOT)
    print(json.dumps(measured, indent=2))
    if options.write:
        print(f"wrote {write_section(ROOT, 'house', 'house', measured, machine_record(ROOT))}")


if __name__ == "__main__":
    main()
