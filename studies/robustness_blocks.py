"""Result blocks on the scores of `studies.robustness`."""

from collections.abc import Iterator, Mapping
from statistics import geometric_mean
from typing import Any

from studies.earlier_weights import FACTORS, RATIOS, figures_of
from studies.network_blocks import score_columns
from studies.rate import ENDS, HELD, OURS, RATE_HZ, RATED
from studies.robustness import BLOCKS, CALIBRATED, CONSTANT
from studies.tables import Block, Columns, Results, Row


def _headline_rows(results: Results) -> Iterator[Row]:
    tables = {name: results["test"]["tables"][name]["rows"] for name in HEADLINE_SETS}
    for label, methods in HEADLINE_METHODS.items():
        yield {"label": label} | {
            name: min((rows[method] for method in methods), key=lambda scores: scores["mse"])
            for name, rows in tables.items()
        }


HEADLINE_SETS = {"photographs_large": "photographs", "measured": "measured scenes"}
HEADLINE_METHODS = {
    "mean DoLP of each frame, taken from the truth": ("oracle_mean",),
    "best constant": ("zeros", "train_mean", "constant_real"),
    "best intensity reconstruction": ("highpass+gain", "firenet_published+gain"),
    "polarnet": ("ours",),
}
"""Rows of the README's table and the methods they stand for; of several, the one with the smallest MSE on the set."""


def _headline_lines(results: Results) -> list[str]:
    tables = results["test"]["tables"]
    photographs, measured = (tables[name]["scenes"] for name in HEADLINE_SETS)
    sources = sum(name.startswith("measured.") for name in tables)
    return [
        f"The shipped weights on {photographs} photographs and {measured} measured scenes of {sources} sources. The "
        "best constant is zero, the mean DoLP of the training photographs, or that of the measured validation scenes."
    ]


ROBUSTNESS_ROWS = (
    "zeros",
    "train_mean",
    CONSTANT,
    "highpass+gain",
    "firenet_published+gain",
    OURS,
    CALIBRATED,
    BLOCKS,
)


def _robustness(key: str, form: str) -> Block:
    """One score of every method, relative to the oracle mean's, on every set of scenes and under every sensor."""
    return Block(
        "robustness", "test", "studies.robustness --write",
        lambda results: [
            {"name": name, **table, "value": {row: one[key] for row, one in table["rows"].items()}}
            for name, table in results["test"]["tables"].items()
        ],
        {"scenes": "`{name}`", "number": "{scenes}", "mean DoLP": "{mean_dolp:.3f}"}
        | {f"`{row}`": f"{{value[{row}]:{form}}}" for row in ROBUSTNESS_ROWS},
    )  # fmt: skip


def _compared(section: str) -> Block:
    """MSE relative to the oracle mean's of each network, by condition; a section's name begins with its split."""

    def rows(results: Results) -> Iterator[Row]:
        for name, table in results[section]["tables"].items():
            ratios = {row: table["rows"][row]["mse_over_oracle_mean"] for row in results[section]["weights"]}
            yield {"name": name, "scenes": table["scenes"], "value": ratios}

    def columns(results: Results) -> Columns:
        networks = {name: f"{{value[{name}]:.3f}}" for name in results[section]["weights"]}
        return {"scenes": "`{name}`", "number": "{scenes}"} | networks

    command = f"studies.robustness --split {section.partition('_')[0]} --weights NAME=FILE ... --write"
    return Block("robustness", section, command, rows, columns)


def _left_out_rows(results: Results) -> Iterator[Row]:
    """For each source of measured scenes, the network that all other validation scenes choose, and its MSE here."""
    networks = results["val"]["weights"]
    tables = {name: one for name, one in results["val"]["tables"].items() if name != "measured"}
    for name, table in tables.items():
        if name.startswith("measured."):
            others = {other: one["rows"] for other, one in tables.items() if other != name}
            chosen = min(networks, key=lambda network: mean_over_kinds(others, network))
            ratio = table["rows"][chosen]["mse_over_oracle_mean"]
            yield {"name": name, "scenes": table["scenes"], "chosen": chosen, "ratio": ratio}


def mean_over_kinds(tables: Mapping[str, Mapping[str, Any]], network: str) -> float:
    """Geometric mean of the network's MSE relative to the oracle mean's: within each kind of scenes, then over kinds.

    The kind is the first part of a condition's name, such as `measured` or `sensors`.
    """
    of_kind: dict[str, list[float]] = {}
    for name, rows in tables.items():
        of_kind.setdefault(name.partition(".")[0], []).append(rows[network]["mse_over_oracle_mean"])
    return geometric_mean(map(geometric_mean, of_kind.values()))


def _earlier_rows(results: Results) -> Iterator[Row]:
    """Earlier shipped weights, then today's."""
    yield from results["test"]["rows"]
    today = results["robustness"]
    commit = today["records"]["test"]["commit"]
    yield {"about": "today's", "commit": commit, **figures_of(today["test"]["tables"])}


def _off_by_rows(results: Results) -> Iterator[Row]:
    """The factor by which expected errors are off, by set of scenes and sensor."""
    for name, table in results["test"]["tables"].items():
        factors = {row: table["rows"].get(row, {}).get("error_factor") for row in (OURS, BLOCKS)}
        if None not in factors.values():
            yield {"name": name, "scenes": table["scenes"], "full": factors[OURS], "blocks": factors[BLOCKS]}


def _between_rows(results: Results) -> Iterator[Row]:
    """PSNR of frames between windows, by kind of scenes."""
    for name, table in results["test"]["tables"].items():
        if name.startswith(RATED):
            psnr = {row: one["psnr"] for row, one in table["rows"].items()}
            ends = psnr[OURS + ENDS]
            yield {
                "kind": name.removeprefix(f"{RATED}."), "scenes": table["scenes"], "ends": ends,
                "carried": ends - psnr[OURS], "held": ends - psnr[OURS + HELD],
            }  # fmt: skip


def _speed_rows(results: Results) -> Iterator[Row]:
    speed = results["speed"]
    for name in [name for name in speed if name.startswith(BETWEEN)]:
        size = name.removeprefix(BETWEEN)
        rates = {
            key + of_blocks: speed[f"windows_per_s_{kind}{size}{suffix}"]
            for key, kind in (("together", ""), ("alone", "alone_"))
            for of_blocks, suffix in (("", ""), ("_blocks", "_blocks_of_2"))
        }
        yield {"size": size.replace("x", " x "), **rates, "between": speed[name]}


BETWEEN = f"ms_per_{RATE_HZ}hz_frame_"

ROBUSTNESS_BLOCKS = {
    "headline": Block(
        "robustness", "test", "studies.robustness --write", _headline_rows,
        {"": "{label}"} | {
            heading: form for name, title in HEADLINE_SETS.items()
            for heading, form in score_columns(("mse", "psnr"), f"{name}[{{}}]", f"{title}: ").items()
        },
        caption="", lines=_headline_lines,
    ),
    "between": Block(
        "robustness", "test", "studies.robustness --write", _between_rows,
        {
            "scenes": "{kind}", "number": "{scenes}", "window ends, dB": "{ends:.2f}",
            "carried on, dB lost": "{carried:.2f}", "held, dB lost": "{held:.2f}",
        },
    ),
    "robustness-speed": Block(
        "robustness", "speed", "studies.network_speed --threads 2 --write", _speed_rows,
        {
            "sensor": "{size}", "windows/s of a file": "{together:.1f}",
            "of a file, blocks of 2x2": "{together_blocks:.1f}", "of a camera": "{alone:.1f}",
            "of a camera, blocks of 2x2": "{alone_blocks:.1f}",
            f"ms a frame between windows, {RATE_HZ} Hz": "{between:.2f}",
        },
        "Shipped weights in {speed[precision]} with {speed[threads]} threads. {origin}",
    ),
    "robustness": _robustness("mse_over_oracle_mean", ".2f"),
    "robustness-median": _robustness("median_over_oracle_mean", ".2f"),
    "robustness-trainings": _compared("val"),
    "robustness-mirrored": _compared("val_mirrored"),
    "robustness-mirrored-train": _compared("train_mirrored"),
    "robustness-shot-noise": _compared("val_shot_noise"),
    "robustness-left-out": Block(
        "robustness", "val", "studies.robustness --split val --weights NAME=FILE ... --write", _left_out_rows,
        {
            "source left out": "`{name}`", "number": "{scenes}", "chosen by all others": "{chosen}",
            "its MSE there": "{ratio:.3f}",
        },
    ),
    "robustness-earlier": Block(
        "earlier_weights", "test", "studies.earlier_weights", _earlier_rows,
        {"weights; expected errors": "{about}"}
        | {f"`{name}`": f"{{ratio[{name}]:.2f}}" for name in RATIOS}
        | {f"`{name}`, off by": f"{{factor[{name}]:.2f}}" for name in FACTORS}
        | {"commit": "`{commit:.10}`"},
        "Each row was measured at the commit that it names.",
        beside="robustness",
    ),
    "robustness-expected": Block(
        "robustness", "test", "studies.robustness --write", _off_by_rows,
        {"scenes": "`{name}`", "number": "{scenes}", f"`{OURS}`": "{full:.2f}", f"`{BLOCKS}`": "{blocks:.2f}"},
    ),
}  # fmt: skip
