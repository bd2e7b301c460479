"""How many damaged files each reader survives: python tests/benchmarks/fuzz_recordings.py [--write] [--cases N]

Runs tests/recordings/test_fuzz.py with N cases a reader (minutes a reader) and counts those that ended in events or in
a RecordingError. `--write` puts the smallest count of all readers into docs/results/recordings.json, as
`fuzz.cases_per_reader`, unless one failed.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results" / "recordings.json"


def survived(cases: int, form: str) -> int | None:
    """Cases of a reader that passed; None where one failed. In a process of its own, for a crash would end it."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "fuzz.xml"
        test = f"tests/recordings/test_fuzz.py::test_a_damaged_file_ends_in_events_or_in_the_reason[{form}]"
        command = [sys.executable, "-m", "pytest", "-q", f"--junitxml={report}", test]
        environment = os.environ | {"POLARNET_FUZZ_CASES": str(cases)}
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
        if report.exists():
            for item in ElementTree.parse(report).iter("property"):
                if item.attrib["name"] == "cases":
                    return int(item.attrib["value"])
        print(f"{form}: exit status {done.returncode}\n{done.stdout[-1500:]}{done.stderr[:1500]}")
        return None


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="into docs/results/recordings.json")
    parser.add_argument("--cases", type=int, default=10_000, help="for each reader")
    parser.add_argument("--forms", nargs="*", default=[], help="only these readers; not with --write")
    arguments = parser.parse_args()
    if arguments.write and arguments.forms:
        parser.error("--write counts all readers; leave out --forms")
    from polarnet.recordings.recording import FORMATS

    found = {}
    for form in arguments.forms or FORMATS:
        cases = survived(arguments.cases, form)
        if cases is None:
            sys.exit(f"{form} did not pass")
        found[form] = cases
        print(f"{form:14s} {cases} cases passed", flush=True)
    print(f"{min(found.values())} cases a reader passed, of {len(found)} readers")
    if arguments.write:
        known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        known["fuzz"] = {"cases_per_reader": min(found.values())}
        RESULTS.parent.mkdir(parents=True, exist_ok=True)
        RESULTS.write_text(json.dumps(known, indent=2) + "\n")
        print(f"written to {RESULTS.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
