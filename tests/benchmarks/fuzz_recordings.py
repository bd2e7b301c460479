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


def survived(cases: int, forms: list[str]) -> dict[str, int]:
    """Cases of each reader that passed; a reader that failed is left out."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "fuzz.xml"
        test = "tests/recordings/test_fuzz.py::test_a_damaged_file_ends_in_events_or_in_the_reason"
        chosen = [f"{test}[{form}]" for form in forms] or [test]
        command = [sys.executable, "-m", "pytest", "-q", f"--junitxml={report}", *chosen]
        environment = os.environ | {"POLARNET_FUZZ_CASES": str(cases)}
        subprocess.run(command, cwd=ROOT, env=environment, check=False)  # failures are what is counted
        found = {}
        for case in ElementTree.parse(report).iter("testcase"):
            values = {item.attrib["name"]: item.attrib["value"] for item in case.iter("property")}
            print(case.attrib["name"], values.get("cases", "FAILED or skipped"))
            if "cases" in values:
                found[values["form"]] = int(values["cases"])
    return found


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

    found = survived(arguments.cases, arguments.forms)
    missing = [form for form in arguments.forms or FORMATS if form not in found]
    if missing:
        sys.exit(f"not passed: {', '.join(missing)}")
    print(f"{min(found.values())} cases a reader passed, of {len(found)} readers")
    if arguments.write:
        known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        known["fuzz"] = {"cases_per_reader": min(found.values())}
        RESULTS.parent.mkdir(parents=True, exist_ok=True)
        RESULTS.write_text(json.dumps(known, indent=2) + "\n")
        print(f"written to {RESULTS.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
