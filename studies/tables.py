"""One writer for every table of docs/results: a format string for each column, and a caption."""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

Results = Mapping[str, Any]
Row = Mapping[str, Any]
Columns = Mapping[str, str]
"""Format string of each column by its heading: {"PSNR": "{scores[psnr]:.2f} dB"}."""


class Figure:
    """A value as a format string prints it: "-" if missing, mean ± standard deviation for several trainings."""

    def __init__(self, value: Any):
        self.value = value

    def __getitem__(self, key: str) -> "Figure":
        return Figure(self.value.get(key) if isinstance(self.value, Mapping) else None)

    def __format__(self, form: str) -> str:
        value = self.value
        if isinstance(value, list):
            value = {"mean": fmean(value) if value else None, "std": stdev(value) if len(value) > 1 else None}
        if isinstance(value, Mapping):
            spread = "" if value["std"] is None else f" ± {format(value['std'], form.lstrip('+'))}"
            return format(Figure(value["mean"]), form) + spread
        return "-" if value is None else format(value, form)


@dataclass(frozen=True)
class Block:
    """One generated block of a page: a table, lines below it, and a caption."""

    file: str
    """NAME of docs/results/NAME.json."""
    section: str
    """Key of the file without which the block has not been measured."""
    module: str
    """`python -m MODULE` measures it."""
    rows: Callable[[Results], Iterable[Row] | str] = lambda results: ""
    """Rows of the table; a string is a table in Markdown."""
    columns: Columns | Callable[[Results], Columns] = lambda results: {}
    caption: str = "{origin}"
    """Format string over the file's entries; `{origin}` names machine, versions and commit of the measurement."""
    lines: Callable[[Results], Iterable[str]] = lambda results: ()
    beside: str | None = None
    """NAME of a second file, whose content the functions above get under that key."""

    def results(self, folder: Path) -> dict[str, Any]:
        """Content of the block's file in `folder`, with that of the second file; empty if it does not exist."""
        file = folder / f"{self.file}.json"
        known = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
        if self.beside:
            known[self.beside] = json.loads((folder / f"{self.beside}.json").read_text(encoding="utf-8"))
        return known

    def text(self, results: Results) -> str:
        """The block's Markdown for the content of its file."""
        table = self.rows(results)
        if not isinstance(table, str):
            table = markdown(self.columns(results) if callable(self.columns) else self.columns, table)
        record = results.get("records", {}).get(self.section) or next(
            (one for one in (results, results[self.section]) if "machine" in one), None
        )
        caption = self.caption.format_map({**results, "origin": record and origin(record)})
        return "\n\n".join(part for part in (table, *self.lines(results), caption) if part)


def markdown(columns: Columns, rows: Iterable[Row]) -> str:
    """A GitHub table with numbers aligned to the right and text to the left."""
    cells = [[form.format_map(_Figures(row)) for form in columns.values()] for row in rows]
    numeric = [all(row[k][:1] in "+-0123456789" for row in cells) for k in range(len(columns))]
    rule = "|".join("---:" if right else "---" for right in numeric)
    return "\n".join([f"| {' | '.join(columns)} |", f"|{rule}|", *(f"| {' | '.join(row)} |" for row in cells)])


def listed(figures: Mapping[str, float], form: str) -> str:
    """Names and figures in one line: "ingest 0.1, train 3.4"."""
    return ", ".join(f"{name} {form.format(value)}" for name, value in figures.items())


class _Figures(dict[str, Any]):
    def __getitem__(self, key: str) -> Figure:
        return Figure(self.get(key))


def origin(record: Mapping[str, Any]) -> str:
    """The sentence below a table: number of cores, machine, load, versions and commit of a measurement.

    `record` is that of `studies.measure.machine_record`.
    """
    cores = "one core" if record["cores"] == 1 else f"{record['cores']} cores"
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    units = " and ".join(record.get("bf16_units", ()))  # older records do not have them
    where = f"{record['machine']}{units and f' with {units}'}, load {record['load']:.1f} before the start"
    return f"On {cores} ({where}; {versions}; commit `{record['commit'][:10]}`)."
