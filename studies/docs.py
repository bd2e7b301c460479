"""Write the result blocks of README.md and docs/*.md from docs/results: python -m studies.docs [--check].

A block lies between `<!-- results:NAME -->` and `<!-- /results:NAME -->`; docs/tables.yaml has a `Table` for each.
"""

import argparse
import functools
import json
import operator
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from string import Formatter, Template
from typing import Any, NamedTuple

from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"(<!-- results:([\w-]+) -->).*?(<!-- /results:\2 -->)", re.DOTALL)
MARKER = re.compile(r"<!-- /?results:(?P<name>[\w-]+) -->")
ROOT_OF = "rms"
"""Before a format: the square root of the value, such as {mse:rms.2f}."""

Results = Mapping[str, Any]


class Cells(Formatter):
    """Format strings over results: "-" for a missing value; lists and mappings joined by commas; RMS of an MSE."""

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> tuple[Any, str]:
        """The value at a path such as test[rows][ours], or None if there is none, and the path."""
        value: Any = kwargs
        for key in re.findall(r"[^\[\]]+", field_name):
            if isinstance(value, list):
                value = value[int(key)]
            else:
                value = value.get(key) if isinstance(value, Mapping) else None
        return value, field_name

    def format_field(self, value: Any, format_spec: str) -> str:
        """Text of a value."""
        if isinstance(value, Mapping):
            return ", ".join(f"`{key}: {self.format_field(one, '')}`" for key, one in value.items())
        if isinstance(value, list):
            return ", ".join(self.format_field(one, format_spec) for one in value)
        if value is None:
            return "-"
        if format_spec.startswith(ROOT_OF):
            return format(value**0.5, format_spec.removeprefix(ROOT_OF))
        return str(value).lower() if isinstance(value, bool) else format(value, format_spec)


class Table(NamedTuple):
    """A block: a table with a caption, or one of them."""

    file: str
    """NAME of docs/results/NAME.json; a YAML file below docs/, whose list is `entries`; or `records` of all files."""
    section: str = ""
    """The part of the file whose commit the block names; the whole file if it is left out."""
    rows: str | Mapping[str, str] = ""
    """A path such as `test/tables` to a mapping (a row for each entry, whose key is `name`) or to a list; or a mapping
    from `label` to `name`, for rows that are chosen by hand."""
    without: tuple[str, str] | None = None
    """Key and value of rows that are left out."""
    columns: Mapping[str, str] = {}
    """A format string for each heading, over the row's values and the whole file. `$name` and `$label` are replaced
    before, so `{test[$name][mse]:.4f}` looks into the file. A missing value is printed as "-"."""
    caption: str = "{origin}"
    """A format string over the whole file; `{origin}` names the commit."""


def read_tables(root: Path) -> dict[str, Table]:
    """The blocks of docs/tables.yaml by name; TypeError for one with an unknown key or without a file."""
    tables = YAML(typ="safe").load(root / "docs" / "tables.yaml")
    return {name: Table(**table) for name, table in tables.items()}


def read_file(root: Path, name: str) -> dict[str, Any]:
    """Content of docs/results/NAME.json, `entries` of a YAML file below docs/, or `records`; empty if there is none."""
    if name == "records":
        return records_of(root)
    if name.endswith(".yaml"):
        return {"entries": YAML(typ="safe").load(root / "docs" / name)}
    path = root / "docs" / "results" / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def records_of(root: Path) -> dict[str, Any]:
    """`machines`, each with a letter, and `measured`: by file of docs/results, its sections with machine and commit."""
    machines: dict[str, dict[str, Any]] = {}
    measured = {}
    for path in sorted((root / "docs" / "results").glob("*.json")):
        sections = []
        for section, record in json.loads(path.read_text(encoding="utf-8")).get("records", {}).items():
            versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
            units = ", ".join(record["bf16_units"]) or "none"
            machine = {"machine": record["machine"], "cores": record["cores"], "units": units, "versions": versions}
            letter = chr(ord("A") + len(machines))
            letter = machines.setdefault(json.dumps(machine), {"letter": letter, **machine})["letter"]
            sections.append(f"{section}: {letter}, load {record['load']:.1f}, `{record['commit'][:10]}`")
        if sections:
            measured[path.stem] = "<br>".join(sections)
    return {"machines": list(machines.values()), "measured": measured}


def block_text(table: Table, results: Results) -> str:
    """Markdown of a block for the content of its file."""
    if not results or (table.section and table.section not in results):
        return "Not measured yet."
    record = results.get("records", {}).get(table.section) or results
    origin = f"Commit `{record['commit'][:10]}`." if "commit" in record else ""
    caption = Cells().format(table.caption, **{**results, "origin": origin}).strip()
    return "\n\n".join(filter(None, [markdown(table, results) if table.columns else "", caption]))


def rows_of(table: Table, results: Results) -> Iterator[dict[str, Any]]:
    """The rows of a table, each with `name` and `label`; KeyError for a path that leads nowhere."""
    if isinstance(table.rows, Mapping):
        yield from ({"label": label, "name": name} for label, name in table.rows.items())
        return
    place: Any = functools.reduce(operator.getitem, table.rows.split("/"), results)
    for key, one in place.items() if isinstance(place, Mapping) else enumerate(place, start=1):
        if table.without is None or one.get(table.without[0]) != table.without[1]:
            yield {"name": str(key), "label": str(key), **one}


def markdown(table: Table, results: Results) -> str:
    """A GitHub table: numbers to the right, text and the names of the rows (the first column) to the left."""
    cells = [[_cell(form, row, results) for form in table.columns.values()] for row in rows_of(table, results)]
    numeric = [all(cell[:1] in "+-0123456789" for cell in column) for column in zip(*cells, strict=True)]
    numeric[:1] = [False]
    rule = "|".join("---:" if right else "---" for right in numeric)
    return "\n".join([f"| {' | '.join(table.columns)} |", f"|{rule}|", *(f"| {' | '.join(row)} |" for row in cells)])


def _cell(form: str, row: Mapping[str, Any], results: Results) -> str:
    named = Template(form).safe_substitute(name=row["name"], label=row["label"])
    text = " ".join(Cells().format(named, **{**results, **row}).split())
    return "-" if text.startswith("- ") else text  # a unit behind a missing value says nothing


def update_pages(root: Path, check: bool) -> list[Path]:
    """Rewrite every block from its committed results, and return the changed files.

    With `check` nothing is written, and the list names the outdated files. ValueError for a block that is not closed
    or that docs/tables.yaml does not describe.
    """
    tables = read_tables(root)
    pages = [root / "README.md", root / "CONTRIBUTING.md", *sorted((root / "docs").glob("*.md"))]
    changed = []
    for page in filter(Path.exists, pages):
        old = page.read_text(encoding="utf-8")
        new = _with_blocks(old, page, tables, root)
        if new != old:
            changed.append(page)
            if not check:
                page.write_text(new, encoding="utf-8")
    return changed


def _with_blocks(text: str, page: Path, tables: Mapping[str, Table], root: Path) -> str:
    def rewritten(block: re.Match[str]) -> str:
        start, name, end = block.groups()
        if name not in tables:
            raise ValueError(f"{page}: docs/tables.yaml has no block {name}; expected one of {', '.join(tables)}")
        return f"{start}\n\n{block_text(tables[name], read_file(root, tables[name].file))}\n\n{end}"

    if open_marker := MARKER.search(BLOCK.sub("", text)):
        name = open_marker["name"]
        raise ValueError(f"{page}: expected <!-- results:{name} --> ... <!-- /results:{name} -->; close each block")
    return BLOCK.sub(rewritten, text)


def main() -> int:
    """Update the blocks, or with --check only name the files that are out of date; the status says whether any is."""
    parser = argparse.ArgumentParser(prog="python -m studies.docs", description=(__doc__ or "").split(":")[0])
    parser.add_argument("--check", action="store_true", help="change nothing; fail if a table is out of date")
    check = parser.parse_args().check
    changed = update_pages(ROOT, check)
    for path in changed:
        print(f"{path}: {'out of date; run `python -m studies.docs`' if check else 'updated'}")
    return 1 if changed and check else 0


if __name__ == "__main__":
    sys.exit(main())
