"""Write the result blocks of README.md and docs/*.md from docs/results: python -m studies.docs [--check].

A block lies between `<!-- results:NAME -->` and `<!-- /results:NAME -->`. docs/tables.yaml describes each block:

- `file`: NAME of docs/results/NAME.json; a YAML file below docs/ (its list is `entries`); or `records`, for the
  machines and commits of all measurements;
- `section`: the part of the file whose commit the block names (the whole file if it is left out);
- `rows`: a path such as `test/tables` to a mapping (a row for each entry, whose key is `name`) or to a list; or a
  mapping from `label` to `name`, for rows that are chosen by hand;
- `without`: values by key; a row that has all of them is left out;
- `columns`: a format string for each heading, over the row's values and the whole file. `$name` and `$label` are
  replaced before, so `{test[$name][mse]:.4f}` looks into the file. A missing value is printed as "-";
- `caption`: a format string over the whole file; `{origin}` names the commit.
"""

import argparse
import json
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from string import Template
from typing import Any

from ruamel.yaml import YAML

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"(<!-- results:([\w-]+) -->).*?(<!-- /results:\2 -->)", re.DOTALL)
MARKER = re.compile(r"<!-- /?results:(?P<name>[\w-]+) -->")
KEYS = {"file", "section", "rows", "without", "columns", "caption"}

ROOT_OF = "rms"
"""Before a format: the square root of the value, such as {mse:rms.2f}."""

Results = Mapping[str, Any]


class Value:
    """A value as a format string prints it: "-" if missing; lists and mappings are joined by commas; RMS of an MSE."""

    def __init__(self, value: Any):
        self.value = value

    def __getitem__(self, key: str | int) -> "Value":
        if isinstance(self.value, list):
            return Value(self.value[int(key)])
        return Value(self.value.get(key) if isinstance(self.value, Mapping) else None)

    def __format__(self, form: str) -> str:
        value = self.value
        if isinstance(value, Mapping):
            return ", ".join(f"`{key}: {Value(one)}`" for key, one in value.items())
        if isinstance(value, list):
            return ", ".join(format(Value(one), form) for one in value)
        if value is None:
            return "-"
        if form.startswith(ROOT_OF):
            return format(value**0.5, form.removeprefix(ROOT_OF))
        return str(value).lower() if isinstance(value, bool) else format(value, form)

    def __str__(self) -> str:
        return format(self)


class Values(dict[str, Any]):
    """Values by name for `str.format_map`; a name that is not there is a missing value."""

    def __getitem__(self, key: str) -> Value:
        return Value(self.get(key))


def read_tables(root: Path) -> dict[str, dict[str, Any]]:
    """The blocks of docs/tables.yaml by name; ValueError for one with an unknown key or without a file."""
    tables = YAML(typ="safe").load(root / "docs" / "tables.yaml")
    for name, table in tables.items():
        if unknown := set(table) - KEYS:
            raise ValueError(f"docs/tables.yaml, {name}: expected keys of {', '.join(sorted(KEYS))}, got {unknown}")
        if "file" not in table:
            raise ValueError(f"docs/tables.yaml, {name}: expected the key file, the name of a file in docs/results")
    return tables


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
            units = record.get("bf16_units") or None  # older records do not have them
            machine = {"machine": record["machine"], "cores": record["cores"], "units": units, "versions": versions}
            letter = chr(ord("A") + len(machines))
            letter = machines.setdefault(json.dumps(machine), {"letter": letter, **machine})["letter"]
            sections.append(f"{section}: {letter}, load {record['load']:.1f}, `{record['commit'][:10]}`")
        if sections:
            measured[path.stem] = "<br>".join(sections)
    return {"machines": list(machines.values()), "measured": measured}


def block_text(table: Mapping[str, Any], results: Results) -> str:
    """Markdown of a block for the content of its file."""
    section = table.get("section")
    if not results or (section and section not in results):
        return "Not measured yet."
    parts = []
    if "columns" in table:
        parts.append(markdown(table["columns"], kept_rows(table, results), results))
    record = results.get("records", {}).get(section) or results
    origin = f"Commit `{record['commit'][:10]}`." if "commit" in record else ""
    if caption := table.get("caption", "{origin}").format_map(Values({**results, "origin": origin})):
        parts.append(caption.strip())
    return "\n\n".join(parts)


def kept_rows(table: Mapping[str, Any], results: Results) -> list[dict[str, Any]]:
    """The rows of a table but for those that its key `without` leaves out."""
    unwanted = table.get("without", {})
    rows = rows_of(table["rows"], results)
    return [row for row in rows if not unwanted or any(row.get(key) != value for key, value in unwanted.items())]


def rows_of(rows: str | Mapping[str, str], results: Results) -> Iterator[dict[str, Any]]:
    """The rows of a table, each with `name` and `label`; KeyError for a path that leads nowhere."""
    if isinstance(rows, Mapping):
        yield from ({"label": label, "name": name} for label, name in rows.items())
        return
    place: Any = results
    for key in rows.split("/"):
        place = place[key]
    named = place.items() if isinstance(place, Mapping) else enumerate(place, start=1)
    yield from ({"name": str(key), "label": str(key), **one} for key, one in named)


def markdown(columns: Mapping[str, str], rows: list[dict[str, Any]], results: Results) -> str:
    """A GitHub table: numbers to the right, text and the names of the rows (the first column) to the left."""
    cells = [[_cell(form, row, results) for form in columns.values()] for row in rows]
    numeric = [k > 0 and all(row[k][:1] in "+-0123456789" for row in cells) for k in range(len(columns))]
    rule = "|".join("---:" if right else "---" for right in numeric)
    return "\n".join([f"| {' | '.join(columns)} |", f"|{rule}|", *(f"| {' | '.join(row)} |" for row in cells)])


def _cell(form: str, row: Mapping[str, Any], results: Results) -> str:
    named = Template(form).safe_substitute(name=row["name"], label=row["label"])
    text = " ".join(named.format_map(Values({**results, **row})).split())
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


def _with_blocks(text: str, page: Path, tables: Mapping[str, Mapping[str, Any]], root: Path) -> str:
    def rewritten(block: re.Match[str]) -> str:
        start, name, end = block.groups()
        if name not in tables:
            raise ValueError(f"{page}: docs/tables.yaml has no block {name}; expected one of {', '.join(tables)}")
        return f"{start}\n\n{block_text(tables[name], read_file(root, tables[name]['file']))}\n\n{end}"

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
