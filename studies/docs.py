"""Write the result blocks of README.md and docs/*.md from docs/results/NAME.json: python -m studies.docs [--check].

A block lies between `<!-- results:NAME -->` and `<!-- /results:NAME -->`; NAME-SECTION needs that section of NAME.json
alone.
"""

import argparse
import json
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from polarnet.reports.provenance import cores, measured_with, origin
from polarnet.reports.tables import (
    COLUMNS,
    COSTS,
    LABELS,
    SET_TITLES,
    as_markdown,
    paired_lines,
    score_table,
    standing,
)
from studies.recording_tables import recordings_block, recover_block
from studies.study_tables import (
    ablation_block,
    choices_block,
    designs_block,
    event_budget_block,
    expected_errors_block,
    headline_block,
    loss_sweep_block,
    lpips_block,
    study_block,
)

MARKER = re.compile(r"<!-- (?P<end>/?)results:(?P<name>[\w-]+) -->")


def update_results_blocks(root: Path, check: bool) -> list[Path]:
    """Rewrite every block from its committed results, and return the changed files.

    With `check` nothing is written, and the list names the outdated files. ValueError for a block that is not closed or
    has no renderer; FileNotFoundError where its results have not been measured.
    """
    changed = []
    for path in [root / "README.md", *sorted((root / "docs").glob("*.md"))]:
        if not path.exists():
            continue
        old = path.read_text(encoding="utf-8")
        new = _with_blocks(old, path, root / "docs" / "results")
        if new != old:
            changed.append(path)
            if not check:
                path.write_text(new, encoding="utf-8")
    return changed


def pipeline_block(results: Mapping[str, Any]) -> str:
    """The benchmark table of one measured run of the whole pipeline, and the run's duration.

    `results` is docs/results/pipeline.json as `studies.measure` writes it; `metrics` is data/benchmark/metrics.json.
    """
    metrics = results["metrics"]
    lines = [as_markdown(score_table(metrics)), ""]
    if any(key.endswith("_ci") for scores in metrics.values() for key in scores):
        lines += ["Means over the test scenes; below them the 95 % bootstrap interval over scenes.", ""]
    lines += [f"- {line}" for line in standing(metrics)]
    tests = f", `make test` {results['test_minutes']:.1f}" if "test_minutes" in results else ""
    lines += [
        "",
        f"`make repro` took {results['repro_minutes']:.1f} minutes after a set-up of {results['setup_minutes']:.1f}"
        f"{tests}, on {cores(results)} ({measured_with(results)}).",
    ]
    if stages := results.get("stage_minutes"):
        lines += ["", "Minutes by stage: " + ", ".join(f"{name} {value:.1f}" for name, value in stages.items()) + "."]
    return "\n".join(lines)


def benchmark_block(results: Mapping[str, Any]) -> str:
    """A table for each test set of docs/results/benchmark.json, and scene-by-scene comparisons of `ours`."""
    lines = []
    for name, title in SET_TITLES.items():
        if name not in results:
            continue
        about = results["about"][name]
        lines += [f"**{title}**: {about['scenes']} scenes, {about['frames']} frames", ""]
        lines += [as_markdown(score_table(results[name], {**COLUMNS, **COSTS})), ""]
        lines += [f"- {line}" for line in paired_lines(results["paired"][name])]
        gains = [
            f"{LABELS[row]} {results[name][f'{row}+gain']['psnr'] - scores['psnr']:+.2f} dB"
            for row, scores in results[name].items()
            if f"{row}+gain" in results[name]
        ]
        lines += [f"- PSNR that solved gains bring: {', '.join(gains)}."] if gains else []
        lines.append("")
    lines.append(origin(results))
    return "\n".join(lines)


def emulation_block(results: Mapping[str, Any]) -> str:
    """The pixel models' seconds and timing errors, golden cases and the paper set.

    `results` is docs/results/emulation.json as studies/emulation.py writes it; missing entries are left out.
    """
    models = [name for name, figures in results.items() if "seconds_1_thread" in _mapping(figures)]
    columns = [
        (key, label, digits) for key, label, digits in EMULATION_COLUMNS if any(key in results[m] for m in models)
    ]
    lines = [
        "| model | " + " | ".join(label for _, label, _ in columns) + " |",
        "|---" * (1 + len(columns)) + "|",
        *(
            f"| `{model}` | "
            + " | ".join(f"{results[model][key]:,.{n}f}" if key in results[model] else "-" for key, _, n in columns)
            + " |"
            for model in models
        ),
        "",
    ]
    if "golden_cases_passed" in results:
        lines += [f"Golden cases of v2e and ESIM met: {results['golden_cases_passed']} of {GOLDEN_CASES}.", ""]
    if paper := _mapping(results.get("paper_set")):
        text = f"A set of {paper['sequences']} sequences, from pictures to the event store on disk, took "
        text += f"{paper['minutes']:.1f} minutes with at most {paper['peak_mib']:,.0f} MiB of memory"
        if stages := paper.get("stage_minutes"):
            text += " (" + ", ".join(f"{name} {minutes:.1f}" for name, minutes in stages.items()) + ")"
        lines += [f"{text}.", ""]
    lines.append(origin(results))
    return "\n".join(lines)


def inspection_block(results: Mapping[str, Any]) -> str:
    """Output of `polarnet inspect` for a capture of the simulated rig."""
    return "\n".join(["```", *results["lines"], "```"])


def throughput_block(results: Mapping[str, Any]) -> str:
    """Training and inference speed of each network under each setting, and the distribution of torch's time.

    `results` is docs/results/network.json as studies/training.py writes it.
    """
    throughput, record = results["throughput"], results["records"]["throughput"]
    lines = [
        "| network | setting | precision | training, frames/s | inference, windows/s | GFLOP a window | "
        "share of the peak in training | in inference | inference at the peak, windows/s |",
        "|---" * 9 + "|",
    ]
    profiles = []
    for name, settings in throughput["networks"].items():
        for setting, row in settings.items():
            if setting == "shipped_over_naive":
                continue
            train, infer, gflop = row["train_frames_per_s"], row["infer_windows_per_s"], row["gflop_per_window"]
            peak = row["peak_gflop_per_s"]
            lines.append(
                f"| `{name}` | {setting} | {row['precision']} | {train:.2f} | {infer:.2f} | {gflop:.2f} | "
                f"{100 * TRAINING_FLOPS * train * gflop / peak:.0f} % | {100 * infer * gflop / peak:.0f} % | "
                f"{peak / gflop:.0f} |"
            )
            profiles += [
                f"| `{name}`, {setting}, {work} | " + ", ".join(f"{op} {share:.0f}" for op, share in shares) + " |"
                for work in ("train", "infer")
                if (shares := [(op, share) for op, share in row[f"{work}_profile"].items() if share >= 1])
            ]
    faster = [
        f"Shipped over naive, `{name}`: training {ratio['train_frames_per_s']:.2f}x, "
        f"inference {ratio['infer_windows_per_s']:.2f}x."
        for name, settings in throughput["networks"].items()
        if (ratio := settings["shipped_over_naive"])
    ]
    return "\n".join([
        *lines, "", *faster, "",
        "Percent of the time in torch's operations, of those with at least 1 %:", "",
        "| run | operations |", "|---|---|", *profiles, "",
        f"{throughput['threads']} thread(s) on {cores(record)} ({throughput['device']}; {measured_with(record)}).",
    ])  # fmt: skip


TRAINING_FLOPS = 3  # relative to a forward pass: backward multiplies once for the inputs and once for the weights

GOLDEN_CASES = 23  # 15 of v2e, 8 of ESIM
EMULATION_COLUMNS = (
    ("seconds_1_thread", "seconds, 1 thread", 3),
    ("seconds_2_threads", "2 threads", 3),
    ("mpixel_updates_per_s", "Mpixel updates / s", 0),
    ("mevents_per_s", "Mevents / s", 1),
    ("peak_mib", "peak MiB", 0),
    ("timing_error_ms_300fps", "timing error at 300 fps, ms", 3),
    ("timing_error_ms_120fps", "at 120 fps, ms", 3),
)
"""Key of a model's figures, heading, decimals."""

RENDERERS: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "pipeline": pipeline_block,
    "benchmark": benchmark_block,
    "emulation": emulation_block,
    "recordings": recordings_block,
    "recordings-recover": recover_block,
    "inspection": inspection_block,
    "network": headline_block,
    "network-seed_1": study_block,
    "expected_errors-seed_1": expected_errors_block,
    "network-ablation": ablation_block,
    "scenes-choices": choices_block,
    "designs-rows": designs_block,
    "event_budget-budget": event_budget_block,
    "network-throughput": throughput_block,
    "sweep": loss_sweep_block,
    "lpips-cost": lpips_block,
}
"""Renderer of each block by name."""

UNMEASURED = {
    "benchmark": "Not measured yet: `python -m studies.study --write` does it.",
    "emulation": "Not measured yet: `python -m studies.emulation --write` does it.",
    "recordings": "Not measured yet: `studies/{recordings,fuzz_recordings,rig}.py --write` do it.",
    "recordings-recover": "Not measured yet: `python -m studies.recover --write` does it.",
    "event_budget-budget": "Not measured yet: `python -m studies.study --write` does it.",
    "network": "Not measured yet: `python -m studies.study --write` does it.",
    "network-seed_1": "Not measured yet: `python -m studies.study --write` does it.",
    "expected_errors-seed_1": "Not measured yet: `python -m studies.study --write` does it.",
    "network-ablation": "Not measured yet: the sweep above and `python -m studies.measure ablation` do it.",
    "designs-rows": "Not collected yet: `python -m studies.designs` does it.",
    "scenes-choices": "Not measured yet: `python -m studies.scenes --write` does it.",
    "sweep": "Not measured yet: the sweep above and `python -m studies.measure sweep` do it.",
    "network-throughput": "Not measured yet: `python -m studies.training --write` does it.",
    "lpips-cost": "Not measured yet: `python -m studies.lpips --write` does it.",
}
"""Placeholder text of blocks that may appear in a document before their results exist."""


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _with_blocks(text: str, path: Path, results: Path) -> str:
    parts, position = [], 0
    markers = list(MARKER.finditer(text))
    for start, stop in zip(markers[::2], [*markers[1::2], None], strict=False):
        name = start["name"]
        if start["end"] or stop is None or not stop["end"] or stop["name"] != name:
            raise ValueError(f"{path}: expected <!-- results:{name} --> ... <!-- /results:{name} -->; close each block")
        parts += [text[position : start.end()], "\n\n", _rendered(name, path, results), "\n\n"]
        position = stop.start()
    return "".join([*parts, text[position:]])


def _rendered(name: str, path: Path, results: Path) -> str:
    if name not in RENDERERS:
        raise ValueError(f"{path}: no renderer for results:{name}; there are {', '.join(RENDERERS)}")
    stem, _, section = name.partition("-")
    file = results / f"{stem}.json"
    known = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    if not known or (section and section not in known):
        if name in UNMEASURED:
            return UNMEASURED[name]
        raise FileNotFoundError(
            f"{path} shows results:{name}, but {file} does not have it; run `python -m studies.measure`"
        )
    return RENDERERS[name](known).strip()


def main() -> int:
    """Update the blocks, or with --check only name the files that are out of date; the status says whether any is."""
    parser = argparse.ArgumentParser(prog="python -m studies.docs", description=(__doc__ or "").split(":")[0])
    parser.add_argument("--check", action="store_true", help="change nothing; fail if a table is out of date")
    check = parser.parse_args().check
    changed = update_results_blocks(Path(__file__).resolve().parents[1], check)
    for path in changed:
        print(f"{path}: {'out of date; run `python -m studies.docs`' if check else 'updated'}")
    return 1 if changed and check else 0


if __name__ == "__main__":
    sys.exit(main())
