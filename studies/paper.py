"""The paper row by row, and its small experiment.

python -m studies.paper [--write]
python -m studies.paper --small DATA [--write]

The first command counts the rows of docs/paper_rows.yaml. The second reads the scores of a finished run of
experiment=paper_small in the folder DATA (`paths.data`), with the rows of the constants, of the filters, of E2VID
(`e2v`), of the network that the run trained (`paper`) and of the shipped one (`ours`). Both write to
docs/results/paper.json.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ruamel.yaml import YAML

from polarnet.config.experiments import preset_values
from studies.measure import ROOT, arguments_of, command_line, machine_record, read_results, write_section
from studies.tables import Results, Row

STATUSES = {
    "exact": "as the paper says",
    "chosen": "the paper leaves it open",
    "stated": "differs from the paper, or needs what it does not publish",
}


class PaperRow(NamedTuple):
    """One system, equation, parameter or experiment of the paper."""

    row: str
    paper: str
    """Section, and equation, figure or table."""
    status: str
    """A key of STATUSES."""
    where: tuple[str, ...]
    """Files, from the root of the repository."""
    test: str
    """Test below tests/: FILE::NAME."""
    values: Mapping[str, Any]
    """Keys of experiment=paper and their values."""
    note: str


def read_rows(root: Path) -> list[PaperRow]:
    """The rows of docs/paper_rows.yaml, in the order of the paper; TypeError for an unknown or a missing key."""
    entries = YAML(typ="safe").load(root / "docs" / "paper_rows.yaml")
    return [_row(**entry) for entry in entries]


def _row(
    row: str, paper: str, status: str, where: str | list[str], test: str, values: dict | None = None, note: str = ""
) -> PaperRow:
    files = (where,) if isinstance(where, str) else tuple(where)
    return PaperRow(row, paper, status, files, test, values or {}, " ".join(note.split()))


def counts(rows: Sequence[PaperRow]) -> dict[str, int]:
    """Number of rows in all and of each status."""
    of_status = {f"rows_{status}": sum(row.status == status for row in rows) for status in STATUSES}
    return {"rows_total": len(rows), **of_status}


def table_rows(results: Results) -> list[Row]:
    """The list as rows of the docs' table."""
    rows: list[Row] = []
    for row in read_rows(ROOT):
        values = ", ".join(f"`{key}: {_printed(value)}`" for key, value in row.values.items())
        files = ", ".join(f"[{Path(file).name}](../{file})" for file in row.where)
        test = row.test.partition("::")[0]
        rows.append({
            "row": row.row, "paper": row.paper, "status": row.status,
            "where": f"{files}{'; ' if values else ''}{values}",
            "note": row.note, "test": f"[{Path(test).stem}](../tests/{test})",
        })  # fmt: skip
    return rows


def duration_rows(lpips: Results) -> list[Row]:
    """Duration of the network's training in experiment=paper, from measured seconds a window.

    Seconds with VGG were measured in fp32; in bf16 they are those of the network and of VGG, measured apart.
    """
    paper, demo = lpips["cost"]["paper"], lpips["cost"]["demo"]
    network = read_results(ROOT, "network")["throughput"]["networks"]["paper"]["shipped"]
    vgg_s = (demo["step_ms"]["vgg"] - demo["step_ms"]["none"]) / 1000 / demo["frames"]
    seconds = {
        "fp32": paper["step_ms"]["vgg"] / 1000 / paper["frames"],
        network["precision"]: 1 / network["train_frames_per_s"] + vgg_s,
    }
    values = preset_values(ROOT, "experiment", "paper")
    share = 1 - values["ingest.val_fraction"] - values["ingest.test_fraction"]
    frames = values["synthesize.duration_s"] * values["synthesize.frame_rate_hz"]
    windows = round(values["ingest.limit"] * share) * values["train.epochs"] * round(frames)
    return [
        {"precision": precision, "windows": windows, "rate": 1 / one, "days": windows * one / 86_400}
        for precision, one in seconds.items()
    ]


SMALL_SCORES = ("mse", "psnr", "ssim", "lpips", "corr", "aolp_deg", "skill")
SMALL_ROWS = ("train_mean", "oracle_mean", "cf", "e2v", "paper", "ours")


def small_scores(data: Path) -> dict[str, dict[str, Any]]:
    """Scores of the rows of experiment=paper_small; ValueError names the rows that the run lacks."""
    metrics = json.loads((data / "benchmark" / "metrics.json").read_text())
    if missing := [row for row in SMALL_ROWS if row not in metrics]:
        raise ValueError(f"{data}: expected the rows {', '.join(SMALL_ROWS)}; {', '.join(missing)} missing")
    return {row: {score: scores[score] for score in SMALL_SCORES} for row, scores in metrics.items()}


def _printed(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def main() -> None:
    """Print the counts; with --write also keep them in docs/results/paper.json."""
    parser = command_line(__doc__, "docs/results/paper.json")
    parser.add_argument("--small", type=Path, metavar="DATA", help="data folder of a run of experiment=paper_small")
    options = arguments_of(parser)
    if options.small:
        scores = small_scores(options.small)
        print(json.dumps(scores, indent=1))
        if options.write:
            print(f"wrote {write_section(ROOT, 'paper', 'paper_small', scores, machine_record(ROOT))}")
        return
    counted = counts(read_rows(ROOT))
    print(", ".join(f"{name} {count}" for name, count in counted.items()))
    if options.write:
        path = write_section(ROOT, "paper", "rows", counted, machine_record(ROOT), counted)
        print(f"wrote {path}; `python -m studies.docs` brings it into docs/paper.md")


if __name__ == "__main__":
    main()
