"""Behaviour of the readers on damaged files: python -m studies.fuzz_recordings [--write] [--cases N]

Each reader gets N damaged copies of a small file (hypothesis; tests/recordings/damaged_files.py) in its own process, a
thousand at a time, and one line reports the outcomes. A file that ends in anything but events or a RecordingError is
reduced to a minimal case and kept in outputs/fuzz with a description.

outputs/fuzz also holds the finished cases, so that an interrupted run resumes while commit and tree are unchanged.
`--write` puts each reader's cases into docs/results/recordings.json as `fuzz.readers.NAME`, and the smallest number
over all readers as `fuzz.cases_per_reader`. Readers that did not run keep their figures and the commit of these
figures.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from polarnet.recordings.formats import isolated
from polarnet.recordings.recording import FORMATS
from studies.measure import arguments_of, command_line, machine_record, read_results, uncommitted, write_section

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "outputs" / "fuzz"
BATCH = 1000  # cases that one line reports
PATIENCE_S = 5  # with libraries that a damaged file sends round in circles; the file takes a millisecond


def run_cases(form: str, first: int, cases: int) -> None:
    """In a process of its own: a line of JSON for each batch from number `first` on."""
    sys.path[:0] = [str(ROOT / "tests" / "recordings"), str(ROOT / "tests")]
    from damaged_files import DAMAGE, EVENTS, Sample
    from recording_fixtures import random_events

    isolated.PATIENCE_S = PATIENCE_S
    with tempfile.TemporaryDirectory() as folder:
        sample = Sample(form, Path(folder), random_events(0, EVENTS, 300_000, 260, 346))
        for batch in range(first, -(-cases // BATCH)):
            try:
                endings = run_batch(sample, DAMAGE, batch, min(BATCH, cases - batch * BATCH))
            except Exception:
                failed = KEPT / f"{form}.failed"
                shutil.rmtree(failed, ignore_errors=True)
                (shutil.copytree if sample.path.is_dir() else shutil.copy)(sample.path, failed)
                (KEPT / f"{form}.txt").write_text(traceback.format_exc())
                sys.exit(f"{form}: an ending that is none; see {failed} and {form}.txt beside it")
            print(json.dumps({"batches": batch + 1, "endings": endings}), flush=True)


def run_batch(sample: Any, damage_of: st.SearchStrategy, batch: int, cases: int) -> Counter[str]:
    """How the cases that the batch's number draws end; whatever a reader raises beyond RecordingError."""
    endings: Counter[str] = Counter()

    @seed(batch)
    @settings(max_examples=cases, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(damage_of, st.integers(0, 50), st.booleans(), st.integers(1, 100))
    def one_case(damage: Any, number: int, says_format: bool, chunk_events: int) -> None:
        endings[sample.ending(damage, number, says_format, chunk_events)] += 1

    one_case()
    return endings


def fuzz(form: str, cases: int, state: str) -> dict[str, Any]:
    """Cases and endings of a reader, printed and kept as they come; those kept of the same `state` are not run again.

    Exits with what the reader's process said where it ended in another way.
    """
    results_file = KEPT / f"{form}.json"
    progress = json.loads(results_file.read_text()) if results_file.exists() else {}
    if progress.get("state") != state or progress["cases"] > cases or progress["cases"] % BATCH:
        progress = {"state": state, "batches": 0, "cases": 0, "seconds": 0.0, "endings": {}}
    command = [sys.executable, "-m", "studies.fuzz_recordings", "--one", form, str(progress["batches"]), str(cases)]
    start, before_s = time.monotonic(), progress["seconds"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            one = json.loads(line)
            endings = Counter(progress["endings"]) + Counter(one["endings"])
            progress |= {"batches": one["batches"], "cases": endings.total(), "endings": dict(sorted(endings.items()))}
            progress["seconds"] = round(before_s + time.monotonic() - start, 1)
            results_file.write_text(json.dumps(progress))
            print(
                f"{form:14s} {progress['cases']:6d} cases in {progress['seconds']:6.1f} s: {progress['endings']}",
                flush=True,
            )
    if process.returncode:
        sys.exit(f"{form}: after {progress['cases']} cases its process ended with status {process.returncode}")
    return progress


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/recordings.json")
    parser.add_argument("--cases", type=int, default=10_000, help="for each reader")
    parser.add_argument("--readers", nargs="*", choices=list(FORMATS), default=list(FORMATS))
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    arguments = arguments_of(parser)
    KEPT.mkdir(parents=True, exist_ok=True)
    if arguments.one:
        form, first, cases = arguments.one
        run_cases(form, int(first), int(cases))
        return
    record = machine_record(ROOT)
    state = f"{record['commit']} {uncommitted(ROOT)}"
    results = {form: fuzz(form, arguments.cases, state) for form in arguments.readers}
    print(f"{min(one['cases'] for one in results.values())} cases a reader passed, of {len(results)} readers")
    if arguments.write:
        readers = read_results(ROOT, "recordings").get("fuzz", {}).get("readers", {}) | {
            form: {key: one[key] for key in ("cases", "endings", "seconds")} | {"commit": record["commit"]}
            for form, one in results.items()
        }
        least = min(readers[form]["cases"] if form in readers else 0 for form in FORMATS)
        path = write_section(ROOT, "recordings", "fuzz", {"cases_per_reader": least, "readers": readers}, record)
        print(f"written to {path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
