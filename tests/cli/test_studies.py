"""The event budget as its command runs it, on the small simulated sequences."""

import json

import matplotlib.image
import pytest
from test_simulate import SMALL

from polarnet.cli import studies
from polarnet.config.tree import load
from polarnet.storage.frames import Contents, FrameStore


@pytest.fixture(scope="module")
def config(project_root, simulated, tmp_path_factory):
    """A pipeline whose only test sequence is the simulated d-0."""
    source = FrameStore.open(simulated.frames)
    splits = {name: "test" if name == "d-0" else "train" for name in source.sequences}
    path = tmp_path_factory.mktemp("studied") / "frames.zarr"
    first = source.frames("d-0")
    frames = FrameStore.create(path, Contents(splits, source.attributes), *first.dolp.shape[1:])
    for name in splits:
        sequence = source.frames(name)
        frames.write(name, sequence.t_us, sequence.intensity, sequence.dolp, sequence.aolp)
    frames.finish()
    height, width = first.dolp.shape[1:]
    own = [
        f"paths.scenes={simulated.scenes}", f"paths.events={simulated.events}", f"paths.frames={path}",
        f"synthesize.sensor_height={height}", f"synthesize.sensor_width={width}", "synthesize.duration_s=0.2",
        "benchmark.warmup_windows=1",
    ]  # fmt: skip
    return load(project_root, [*SMALL, *own])


@pytest.mark.thorough
def test_the_event_budget_asks_its_questions_on_the_test_sequences_alone(config, checkpoints, tmp_path):
    results = studies.run_event_budget(config, tmp_path / "out", ["oracle_mean", "ours"], None, checkpoints["paper"])
    assert results["sequences"] == ["d-0"]
    assert {path.name for path in (tmp_path / "out").glob("figure_11*")} == {
        f"figure_11{part}_simulated.{kind}" for part in "ab" for kind in ("png", "pdf")
    }
    assert set(results["since_start"]) == set(results["window_length"]) == {"oracle_mean", "ours"}
    assert [entry["window_us"] for entry in results["window_length"]["ours"]] == list(studies.WINDOW_LENGTHS_US)
    assert json.loads((tmp_path / "out" / "event_budget.json").read_text()) == results
    assert matplotlib.image.imread(tmp_path / "out" / "event_budget.png").std() > 0
