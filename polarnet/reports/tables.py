"""Benchmark scores as tables: selected, rounded and ranked once, then written as plain text or HTML."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

from polarnet.methods import is_rotating
from polarnet.reports.legend import LABELS, LPIPS_BACKBONES, in_order

Scores = Mapping[str, Mapping[str, Any]]
"""Method, then metric (data/benchmark/metrics.json). None marks a missing value; `<metric>_ci` holds an interval."""


@dataclass(frozen=True)
class Column:
    """Presentation of a metric in tables."""

    label: str
    decimals: int
    better: Literal["low", "high"]
    ranked: bool = True  # whether the best value is set in bold; costs are not ranked

    @property
    def heading(self) -> str:
        """Label with an arrow in the direction of improvement."""
        return f"{self.label} {'↓' if self.better == 'low' else '↑'}"

    def printed(self, value: float | int) -> str:
        """A value with the decimals of its column; a value that rounds to 0 has no sign."""
        return f"{value:z,.{self.decimals}f}"


COLUMNS: Mapping[str, Column] = {
    "mse": Column("MSE", 4, "low"),
    "psnr": Column("PSNR", 2, "high"),
    "ssim": Column("SSIM", 4, "high"),
    "lpips": Column("LPIPS", 4, "low"),
    "corr": Column("corr.", 3, "high"),
    "grad": Column("edges", 3, "high"),
    "aolp_deg": Column("AoLP err.", 1, "low"),
    "skill": Column("skill", 3, "high"),
    "ms_per_window": Column("ms / window", 1, "low", False),
}
PARTS_AND_COSTS = {
    "level_mse": Column("level", 4, "low"),
    "pattern_mse": Column("pattern", 4, "low"),
    "offset": Column("offset", 3, "low"),
    "no_offset_mse": Column("without offset", 4, "low"),
    "gflop": Column("GFLOP / window", 2, "low", False),
    "params": Column("parameters", 0, "low", False),
}
"""Parts of the MSE (level, the squared error of the frame's mean, and pattern, the remainder), the mean squared offset
of atanh(s1) and atanh(s2) and the MSE without it, and costs."""

WINDOW_RULE = (
    "A window is the events between two frames of the truth, start included and end excluded; its truth is the frame "
    "at its end."
)
ANOTHER_CAMERA = (
    "† Not ranked: another camera, one sensor behind a rotating polarizer, sees the same scenes and motions but other "
    "events than the rows with four polarizers."
)


class Cell(NamedTuple):
    """One value of a table."""

    text: str
    best: bool  # whether no ranked row has a better value in this column; all ties are best


class Row(NamedTuple):
    """One row of a table: a method and its values."""

    method: str
    label: str
    cells: tuple[Cell, ...]


class Table(NamedTuple):
    """The content of a table, without markup."""

    headings: tuple[str, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...]


def score_table(
    scores: Scores,
    columns: Mapping[str, Column] = COLUMNS,
    labels: Mapping[str, str] = LABELS,
    warmup_windows: float | int | None = None,
) -> Table:
    """Scores of the methods in the fixed order; a metric without any value gets no column.

    With `warmup_windows`, a note states which windows are scored. The LPIPS heading names the backbone from the rows'
    `lpips_backbone`. Rows of another camera are not ranked, and a note says so. Methods missing in `labels` come last,
    under their own key. ValueError without scores.
    """
    if not scores:
        raise ValueError("a table needs the scores of at least one method, got none")
    backbone = next((found for row in scores.values() if (found := row.get("lpips_backbone"))), None)
    if backbone and "lpips" in columns:
        columns = {**columns, "lpips": replace(columns["lpips"], label=f"LPIPS ({backbone})")}
    keys = [key for key in columns if any(row.get(key) is not None for row in scores.values())]
    methods = in_order(scores)
    ranked = [not is_rotating(method) for method in methods]
    cells = [_cells(columns[key], [scores[method].get(key) for method in methods], ranked) for key in keys]
    by_row = zip(methods, zip(*cells, strict=True), strict=True)
    rows = tuple(Row(method, labels.get(method, method), of_method) for method, of_method in by_row)
    notes = []
    if backbone and "lpips" in keys:
        notes.append(f"LPIPS ({backbone}): version 0.1 on the features of {LPIPS_BACKBONES[backbone]}.")
    if warmup_windows is not None:
        notes.append(f"{WINDOW_RULE} The first {warmup_windows} windows of each sequence count for no method.")
    if not all(ranked):
        notes.append(ANOTHER_CAMERA)
    return Table(tuple(columns[key].heading for key in keys), rows, tuple(notes))


def as_plain(table: Table) -> str:
    """Aligned columns for a terminal, best values marked with an asterisk, what it means and notes below."""
    grid = [["", *(heading + " " for heading in table.headings)]]
    grid += [[row.label, *(cell.text + ("*" if cell.best else " ") for cell in row.cells)] for row in table.rows]
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    lines = [
        "  ".join([line[0].ljust(widths[0]), *(x.rjust(width) for x, width in zip(line[1:], widths[1:], strict=True))])
        for line in grid
    ]
    lines.insert(1, "-" * len(lines[0]))
    return "\n".join([*(line.rstrip() for line in lines), "* the best of its column", *table.notes])


def _cells(column: Column, values: Sequence[float | int | None], ranked: Sequence[bool]) -> list[Cell]:
    """A cell for each row; the best is found as printed, so that rows with equal text are bold together."""
    texts = ["-" if value is None else column.printed(value) for value in values]
    known = [value for value, counts in zip(values, ranked, strict=True) if counts and value is not None]
    best = column.printed(min(known) if column.better == "low" else max(known)) if column.ranked and known else None
    return [Cell(text, counts and text == best) for text, counts in zip(texts, ranked, strict=True)]
