"""Benchmark results on one test set, as every page shows them: tables, figures, and rows of pictures."""

from pathlib import Path
from typing import Any

from polarnet.reports.artefacts import Artefacts, SetResults
from polarnet.reports.figures import PanelScene, comparison_panel, dolp_bar
from polarnet.reports.legend import Legend, glossary, lpips_about
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
)


def results_context(results: Artefacts | SetResults, legend: Legend) -> dict[str, Any]:
    """Template values of the results on the test set."""
    metrics, details, labels = results.metrics, results.details, legend.labels
    return {
        "metrics": metrics,
        "details": details,
        "scores": score_table(metrics, labels=labels),
        "error_parts": score_table(metrics, columns=ERROR_PARTS, labels=labels),
        "costs": score_table(metrics, columns=COSTS, labels=labels),
        "standing": standing(metrics, labels),
        "paired": paired_lines(details.get("paired", {}), labels=labels),
        "rows": glossary(metrics, details["weights"]),
        "lpips_about": lpips_about(details["lpips"]),
        "paper_simulated": paper_table("simulated"),
        "paper_real": paper_table("real"),
        "paper_source": PAPER_SOURCE,
        "comparability": PAPER_COMPARABILITY,
        "distribution": distribution(details["scene_means"], legend),
        "reliability": reliability_chart(details, legend),
        "dolp_bar": chart(dolp_bar, "colour bar of DoLP from 0 to 1"),
        "wheel": data_uri(encode_png(hue_wheel(192)), "png"),
        "panels": [TileRow(panel.sequence, panel_tiles(panel, legend)) for panel in results.panels],
        "polarization": [TileRow(panel.sequence, polarization_tiles(panel, legend)) for panel in results.panels],
    }


def write_comparison(path: Path, results: Artefacts | SetResults, legend: Legend) -> None:
    """Write a PNG of the panels' events, truth and predictions; no file if there are no panels."""
    if results.panels:
        rows = [PanelScene(panel.sequence, panel.events, panel.truth_dolp, panel.dolp) for panel in results.panels]
        comparison_panel(rows, path, legend)
