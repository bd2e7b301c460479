"""Commands and stages need no network: they succeed where every connection fails."""

import json
import subprocess
import sys

import pytest
from test_simulate import SMALL

pytestmark = pytest.mark.thorough

APART = ["unshare", "--net", "--map-root-user"]
"""Runs a command in a network namespace of its own, whose one interface is down."""
SIZE = ["synthesize.sensor_height=60", "synthesize.sensor_width=90", "synthesize.duration_s=0.3"]
REST = [word for word in SMALL if not word.startswith(("synthesize.", "ingest."))]
WORK = """
import json, os, sys
paths, words = map(json.loads, sys.argv[1:])
sys.path[:0] = paths
from polarnet.cli import main
from preloaded import run_stage
assert main(["demo", "--out", "demo", *words]) == 0
for stage in ("ingest", "synthesize"):
    pictures = ["ingest.height=120", "ingest.width=180", "ingest.dead_leaves=0"]
    folders = [f"paths.data={os.getcwd()}/data", f"hydra.run.dir={os.getcwd()}/logs/{stage}"]
    done = run_stage(paths[0], stage, [*words, *pictures, *folders])
    assert done.returncode == 0, done.stdout
"""


@pytest.fixture
def apart():
    """The command; skips where the system gives no namespace."""
    try:
        subprocess.run([*APART, "true"], check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no network namespace here: {getattr(error, 'stderr', None) or error}")
    return APART


def test_simulation_recovery_and_stages_need_no_network(apart, project_root, tmp_path):
    paths = [str(project_root), str(project_root / "tests"), *sys.path]
    words = [json.dumps(paths), json.dumps([*SIZE, *REST])]
    done = subprocess.run([*apart, sys.executable, "-c", WORK, *words], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {"index.html", "recovered.mp4"} <= {path.name for path in (tmp_path / "demo" / "recovered").iterdir()}
    assert (tmp_path / "data" / "frames.zarr" / "zarr.json").exists()
