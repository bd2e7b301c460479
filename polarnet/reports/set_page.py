"""The page of one test set, written by `polarnet benchmark --scenes`: table, scenes and each method's predictions."""

from collections.abc import Sequence
from pathlib import Path

from polarnet.reports.artefacts import read_set
from polarnet.reports.figures import PanelScene, comparison_panel, dolp_bar
from polarnet.reports.legend import glossary, legend_of, lpips_about
from polarnet.reports.maps import encode_png, hue_wheel
from polarnet.reports.tables import (
    COSTS,
    ERROR_PARTS,
    PAPER_COMPARABILITY,
    PAPER_SOURCE,
    paired_lines,
    paper_table,
    score_table,
    standing,
)
from polarnet.reports.tiles import (
    TileRow,
    chart,
    data_uri,
    distribution,
    panel_tiles,
    polarization_tiles,
    reliability_chart,
    template,
)


def write_set_page(folder: Path, title: str, command: str, notes: Sequence[str]) -> Path:
    """Write index.html and comparison.png beside the metrics.json, details.json and panels in `folder`.

    `notes` are sentences for the reader of the table, such as the methods that did not run and the reasons.
    """
    results = read_set(folder)
    legend = legend_of(results.details["weights"])
    labels = legend.labels
    if results.panels:
        rows = [PanelScene(panel.sequence, panel.events, panel.truth_dolp, panel.dolp) for panel in results.panels]
        comparison_panel(rows, folder / "comparison.png", legend)
    page = template("set.html.jinja").render(
        title=title,
        command=command,
        notes=notes,
        details=results.details,
        scores=score_table(results.metrics, labels=labels),
        error_parts=score_table(results.metrics, columns=ERROR_PARTS, labels=labels),
        costs=score_table(results.metrics, columns=COSTS, labels=labels),
        standing=standing(results.metrics, labels),
        paired=paired_lines(results.details["paired"], labels=labels),
        labels=labels,
        rows=glossary(results.metrics, results.details["weights"]),
        lpips_about=lpips_about(results.details["lpips"]),
        paper_simulated=paper_table("simulated"),
        paper_real=paper_table("real"),
        paper_source=PAPER_SOURCE,
        comparability=PAPER_COMPARABILITY,
        distribution=distribution(results.details["scene_means"], legend),
        reliability=reliability_chart(results.details, legend),
        dolp_bar=chart(dolp_bar, "colour bar of DoLP from 0 to 1"),
        wheel=data_uri(encode_png(hue_wheel(192)), "png"),
        panels=[TileRow(panel.sequence, panel_tiles(panel, legend)) for panel in results.panels],
        polarization=[TileRow(panel.sequence, polarization_tiles(panel, legend)) for panel in results.panels],
    )
    path = folder / "index.html"
    path.write_text(page, encoding="utf-8")
    return path
