"""Planning tables of docs/scaling.md: measured costs multiplied by the number of pictures."""

from collections.abc import Mapping

from polarnet.config.experiments import preset_values
from studies.measure import ROOT
from studies.tables import Block, Results, Row

PICTURES = (10**3, 10**4, 10**6)
MIB_PER_GB = 1e9 / 2**20
HEADINGS = {"cost": "{cost}", **{f"{pictures:,} pictures": f"{{n{pictures}:,g}}" for pictures in PICTURES}}


def multiplied(costs: Mapping[str, float]) -> list[Row]:
    """A row for each cost of one picture, with a column for each number of pictures, to three digits."""
    return [{"cost": name, **{f"n{n}": float(f"{n * cost:.3g}") for n in PICTURES}} for name, cost in costs.items()]


def simulation_rows(results: Results) -> list[Row]:
    """Core hours by stage, then size and number of files, with one sequence of each picture."""
    measured = results["paper_set"]
    pictures = {"ingest": measured["sequences"] / measured["sequences_per_picture"]}
    hours = {
        f"core hours of `{stage}`": minutes / 60 / pictures.get(stage, measured["sequences"])
        for stage, minutes in measured["stage_core_minutes"].items()
    }
    return multiplied({
        **hours,
        "GB of events": measured["event_store_mib"] / MIB_PER_GB / measured["sequences"],
        "files of events, frames and scenes": measured["files"] / measured["sequences"],
    })  # fmt: skip


def training_rows(results: Results) -> list[Row]:
    """Hours of one epoch of each network over all windows."""
    values = preset_values(ROOT, "experiment", "paper")
    windows = values["synthesize.duration_s"] * values["synthesize.frame_rate_hz"]
    networks = results["throughput"]["networks"]
    return multiplied({
        f"hours of an epoch of `{name}`": windows / one["shipped"]["train_frames_per_s"] / 3600
        for name, one in networks.items()
    })  # fmt: skip


def scoring_rows(results: Results) -> list[Row]:
    """Hours of `polarnet benchmark --scenes`, with the rows that were timed."""
    figures = dict(results["scenes"])
    rows = len(figures.pop("rows"))
    [(name, minutes)] = figures.items()
    return multiplied({f"hours to score {rows} rows": minutes / 60 / int(name.split("_")[1])})


PLANNING_BLOCKS = {
    "planning-simulation": Block(
        "emulation", "paper_set", "studies.emulation", simulation_rows, HEADINGS,
        "From a set of {paper_set[sequences]:,} sequences that was made and measured. {origin}",
    ),
    "planning-training": Block(
        "network", "throughput", "studies.training", training_rows, HEADINGS,
        "Every window is visited once; LPIPS is not in the loss. On {throughput[threads]} threads. {origin}",
    ),
    "planning-scoring": Block(
        "speed", "scenes", "studies.speed scenes", scoring_rows, HEADINGS,
        "{origin}",
    ),
}  # fmt: skip
