"""Removing noise before recovery: python -m studies.noise [--write].

Photographs are simulated with `sensor=noisy` and with hot pixels; every event keeps its cause. For each way of cleaning
(`polarnet recover --hot-pixels found --background TIME`), the study counts what was removed by cause, and scores
methods on what is left. `--write` puts the figures into docs/results/noise.json.
"""

import dataclasses
import json
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from polarnet.benchmark.rows import predictions_of
from polarnet.benchmark.score import FrameScore, mean_scores, score_sequence
from polarnet.config.pipeline import context_of, made_set
from polarnet.config.tree import load
from polarnet.events.labels import LABELS
from polarnet.events.stream import Events
from polarnet.networks.weights import shipped_weights
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.recordings.noise import FOUND, Cleaner, Cleaning
from polarnet.runtime.machine import configure
from polarnet.simulation.sets import make_folder_set
from studies.measure import ROOT, arguments_of, command_line, machine_record, write_section
from studies.tables import Block, Results, Row

PHOTOGRAPHS = ("astronaut", "coffee", "rocket", "chelsea")
HOT = ("emulate.hot_pixel_share=0.001", "emulate.hot_pixel_rate_hz=100")
ROWS = ("highpass+gain", "ours")
FACTOR = 4.0
CLEANINGS = {
    "nothing": Cleaning(None, FACTOR, None),
    "hot pixels": Cleaning(FOUND, FACTOR, None),
    **{f"background, {ms} ms": Cleaning(None, FACTOR, 1000 * ms) for ms in (3, 10, 30)},
    "hot pixels and background, 10 ms": Cleaning(FOUND, FACTOR, 10_000),
}


def causes(channels: Sequence[Events]) -> Counter[str]:
    """Number of events by cause."""
    counts: Counter[str] = Counter()
    for events in channels:
        assert events.label is not None
        counts.update({name: int((events.label == number).sum()) for number, name in enumerate(LABELS)})
    return counts


def measured(work: Path, photographs: Sequence[Path]) -> dict[str, Any]:
    """By cleaning: the shares of signal and of noise that it removes, and scores by method."""
    config = load(ROOT, ["sensor=noisy", *HOT, "storage.labels=true"])
    configure(config.runtime, config.seed)
    (work / "pictures").mkdir()
    for photograph in photographs:
        (work / "pictures" / photograph.name).symlink_to(photograph)
    make_folder_set(work / "pictures", "photographs", work / "made", config.recipe, config.mapper)
    test_set, context = made_set("noisy", work / "made"), context_of(config, None, shipped_weights())
    before, after = Counter[str](), {name: Counter[str]() for name in CLEANINGS}
    rows: dict[str, list[FrameScore]] = {name: [] for name in CLEANINGS}
    for sequence in map(test_set.sequence, test_set.sequences):
        before += causes(sequence.events)
        for name, cleaning in CLEANINGS.items():
            clean = Cleaner(cleaning, None)(sequence.events, int(sequence.t_us[-1]))
            after[name] += causes(clean)
            predictions = predictions_of(ROWS, dataclasses.replace(sequence, events=clean), context)
            rows[name] += score_sequence(sequence, predictions, config.benchmark.warmup_windows, None, context.device)
    return {
        name: {
            "removed": {cause: 1 - after[name][cause] / count for cause, count in before.items() if count},
            "scores": mean_scores(rows[name], ("mse", "psnr", "corr")),
        }
        for name in CLEANINGS
    } | {"events": dict(before)}


def table_rows(results: Results) -> list[Row]:
    """A row for each cleaning."""
    return [{"cleaning": name, **results["noisy"][name]} for name in CLEANINGS]


def share(results: Mapping[str, Any]) -> list[str]:
    """The causes of the events, in a sentence."""
    events = results["noisy"]["events"]
    total = sum(events.values())
    return ["Events by cause: " + ", ".join(f"{name} {count / total:.1%}" for name, count in events.items()) + "."]


NOISE_BLOCK = Block(
    "noise",
    "noisy",
    "studies.noise",
    table_rows,
    {
        "removed": "{cleaning}",
        "of signal": "{removed[signal]:.1%}",
        "of shot noise": "{removed[shot]:.1%}",
        "of hot pixels": "{removed[hot]:.1%}",
        "high-pass, gains solved: PSNR": "{scores[highpass+gain][psnr]:.2f}",
        "corr.": "{scores[highpass+gain][corr]:.3f}",
        "ours: PSNR": "{scores[ours][psnr]:.2f}",
        "ours: corr.": "{scores[ours][corr]:.3f}",
    },
    lines=share,
)


def main() -> None:
    """Measure, print and perhaps write."""
    arguments = arguments_of(command_line(__doc__, "docs/results/noise.json"))
    record = machine_record(ROOT)
    photographs = [photo.path for photo in BUILTIN_PHOTOS if photo.path.stem in PHOTOGRAPHS]
    with tempfile.TemporaryDirectory() as folder:
        results = measured(Path(folder), photographs)
    print(json.dumps(results, indent=2))
    if arguments.write:
        print(write_section(ROOT, "noise", "noisy", results, record))


if __name__ == "__main__":
    main()
