"""The page of one test set, written by `polarnet benchmark --scenes`: table, scenes and each method's predictions."""

from collections.abc import Sequence
from pathlib import Path

from polarnet.reports.artefacts import read_set
from polarnet.reports.legend import legend_of
from polarnet.reports.results import results_context, write_comparison
from polarnet.reports.tiles import template


def write_set_page(folder: Path, title: str, command: str, notes: Sequence[str]) -> Path:
    """Write index.html and comparison.png beside the metrics.json, details.json and panels in `folder`.

    `notes` are sentences for the reader of the table, such as the methods that did not run and the reasons.
    """
    results = read_set(folder)
    legend = legend_of(results.details["weights"])
    write_comparison(folder / "comparison.png", results, legend)
    page = template("set.html.jinja").render(
        results_context(results, legend), title=title, command=command, notes=notes, labels=legend.labels
    )
    path = folder / "index.html"
    path.write_text(page, encoding="utf-8")
    return path
