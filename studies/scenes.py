"""Choices of training scenes, compared without the test split.

python -m studies.scenes --photographs FOLDER --work FOLDER [--seeds N] [--threads N] [--write]

The photographs of the study's test split (`studies/study.py`) are left out. A third of the others is held out for
scoring; the pipeline's stages make each choice's scenes from the rest, train polarnet on them and score it. The choice
therefore sees no test photograph, and scores more scenes than the study's validation split has. Finished work in the
folder --work is reused. --write puts the scores into docs/results/scenes.json.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

from polarnet.pictures.manifest import read_manifest
from studies.measure import ABLATION_KEYS, arguments_of, command_line, machine_record, run_stage, write_section

ROOT = Path(__file__).resolve().parents[1]
HELD_OUT = 1 / 3  # share of the remaining photographs


class Choice(NamedTuple):
    """One way to make the training scenes."""

    about: str
    synthesis: tuple[str, ...] = ()


SHORT = ("train.epochs=1",)
"""Overrides of all trainings here and of the ablation's."""
CHOICES = {
    "shipped": Choice(
        "three variants of each photograph, a third drawn towards one polarization (`experiment=photographs`)"
    ),
    "none_evened": Choice("three variants, none drawn towards one polarization", ("variation.uniform_share=0",)),
}


def stage(name: str, arguments: argparse.Namespace, data: Path, *overrides: str) -> None:
    """Run one stage of the pipeline on the data of one choice."""
    common = (
        "experiment=photographs", "loss.lpips=0", f"paths.data={data}",
        f"runtime.threads={arguments.threads}",
    )  # fmt: skip
    run_stage(name, *common, *overrides)


def without_test_split(arguments: argparse.Namespace) -> Path:
    """A folder of links to the photographs that the study's test split does not have."""
    data = arguments.work / "all"
    stage("ingest", arguments, data, f"ingest.root={arguments.photographs}")
    folder = arguments.work / "photographs"
    folder.mkdir(exist_ok=True)
    for entry in read_manifest(data / "images").pictures:
        link = folder / entry.origin.replace("/", "_")
        if entry.split != "test" and not link.exists():
            link.symlink_to(arguments.photographs / entry.origin)
    return folder


def scored(name: str, seed: int, photographs: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """The scores of a choice and of the oracle mean on the photographs held out here, trained from a seed."""
    choice, run = CHOICES[name], f"{name}_{seed}"
    data, results, trained = (arguments.work / folder for folder in (name, f"benchmark_{run}", f"train_{run}"))
    fractions = (f"ingest.root={photographs}", f"ingest.test_fraction={HELD_OUT}")
    if not (data / "weights" / "loss.json").exists():
        for step in ("ingest", "synthesize", "emulate", "weights"):
            stage(step, arguments, data, *fractions, *choice.synthesis)
    if not (results / "metrics.json").exists():
        paths = (f"paths.train={trained}", f"paths.benchmark={results}")
        resume = f"paths.resume={arguments.work / 'resume' / run}"
        stage("train", arguments, data, f"seed={seed}", *SHORT, *paths, resume)
        stage("benchmark", arguments, data, "benchmark.methods=[oracle_mean,ours]", *paths)
    metrics = json.loads((results / "metrics.json").read_text())
    return {row: {key: scores.get(key) for key in ABLATION_KEYS} for row, scores in metrics.items()}


def parsed() -> argparse.Namespace:
    """The command line, with paths as every working directory understands them."""
    parser = command_line(__doc__, "docs/results/scenes.json")
    parser.add_argument("--photographs", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=2, help="trainings of each choice")
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    arguments = arguments_of(parser)
    arguments.photographs, arguments.work = arguments.photographs.resolve(), arguments.work.resolve()
    return arguments


def main() -> None:
    """Train and score every choice, print and perhaps write."""
    arguments = parsed()
    record = machine_record(ROOT)
    photographs = without_test_split(arguments)
    choices: dict[str, Any] = {}
    for seed in range(1, arguments.seeds + 1):
        for name in CHOICES:
            scores = scored(name, seed, photographs, arguments)
            row = choices.setdefault(name, {"seeds": []})
            row["seeds"].append(scores["ours"])
            choices["oracle_mean"] = {"seeds": [scores["oracle_mean"]]}
            print(name, seed, json.dumps(scores["ours"]), flush=True)
    if arguments.write:
        print(write_section(ROOT, "scenes", "choices", {"overrides": SHORT, "rows": choices}, record))


if __name__ == "__main__":
    main()
