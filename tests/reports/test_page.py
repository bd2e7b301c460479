import dataclasses
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch

from polarnet.reports.artefacts import Run, facts, read_results
from polarnet.reports.legend import GENERAL
from polarnet.reports.page import verdict, write_report, write_set_page
from polarnet.reports.player import Film, Map, player_data
from polarnet.storage.frames import FrameStore

RUN = Run(
    "dvc repro",
    {"seed": 1, "loss": {"mse": 1.0}, "networks": {"paper": {"channels": [32, 64]}}, "lpips": {"path": None}},
    {"seed": "1", "commit": "abc"},
)


@pytest.fixture(scope="module")
def folder(paths, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    assert write_report(paths, ["e2v"], RUN, folder) == folder / "index.html"
    return folder


@pytest.fixture(scope="module")
def page(folder):
    return (folder / "index.html").read_text()


def test_the_page_needs_no_other_file_names_no_other_network_and_has_no_warning(page):
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    sources = re.findall(r'(?<!xlink:)(?:src|srcset|href)="([^"]*)"', markup)
    assert all(source.startswith(("data:", "#")) for source in sources)
    assert not re.search(r"<script[^>]* src=|<link|@import|url\((?!#)", page.split("<script>")[0])
    for absent in ("olarnet&#39;s own network", "<b>Ann</b>", 'class="warning"', "LPIPS ("):
        assert absent not in page


def test_one_sentence_says_how_good_ours_is_beside_the_best_other_method_of_its_camera_and_the_oracle(page):
    lead = re.search(r'<p class="lead">(.*?)</p>', page)[1]
    assert re.fullmatch(
        r"The paper&#39;s network recovers DoLP with a mean squared error of 0\.0\d+ on 2 simulated scenes, 1 of them "
        r"generated: \d+\xa0% lower than the best other method of this camera \(E2V: FireNet\) and \d+\xa0% lower than "
        r"the oracle mean, which needs the truth\.",
        lead,
    )
    metrics = {name: {"mse": mse} for name, mse in (("rotating_polarizer", 0.01), ("cf", 0.1), ("ours", 0.05))}
    assert verdict(metrics, "3 scenes", GENERAL).endswith(
        "3 scenes: 50\xa0% lower than the best other method of this camera (CF)."
    )


def test_the_first_table_has_the_computed_scores(page):
    first = re.search(r"<table.*?</table>", page, re.DOTALL)[0]
    scores = ["MSE ↓", "PSNR ↑", "SSIM ↑", "corr. ↑", "edges ↑", "AoLP err. ↓", "skill ↑", "ms / window ↓"]
    assert re.findall(r'scope="col">([^<]*)<', first) == ["Method", *scores]
    assert 'class="best"' in re.search(r'<tr class="m-ours">.*?</tr>', first, re.DOTALL)[0]
    assert '<th scope="row">E2V: FireNet</th>' in first


@pytest.mark.parametrize(
    "texts",
    [
        # trainings: epoch 2 of 3 has the smallest validation MSE, .04
        ('">the paper&#39;s network</td>', '">FireNet</td>', 'Epochs">3</td>', 'Best epoch">2</td>', 'dB">11.00</td>'),
        ("<dt>ours: the paper&#39;s network</dt><dd>The DoLP network in use.",),
        ("loss:\n  mse: 1.0", "lpips:\n  path:\n", "none: benchmark.lpips is false"),
        ("&lt;b&gt;Ann&lt;/b&gt;", "broken.jpg", "cannot be read: ends early"),
    ],
)
def test_the_page_shows_networks_parameters_as_in_params_yaml_and_escaped_text_of_files(page, texts):
    assert all(text in page for text in texts)


def test_the_player_has_the_scenes_and_the_worst_ones_lead_to_it(page, folder):
    player = json.loads(re.search(r'data-role="data">(.*?)</script>', page)[1])
    for scene in player["scenes"]:
        kinds = {(one["source"], one["kind"]) for one in scene["maps"]}
        assert kinds == {
            ("Events", "events"), ("truth", "s0"), ("truth", "aolp"), ("truth", "dolp"),
            ("ours: the paper's network", "dolp"), ("E2V: FireNet", "dolp"), ("E2V: FireNet", "aolp"),
        }  # fmt: skip
    assert len(player["scenes"]) == 2
    assert player["scenes"][0]["name"].startswith("tree")  # photographs come before generated pictures
    assert sorted(re.findall(r'data-scene="([^"]*)"', page)) == ["leaf-00", "tree-00"]
    assert sorted(path.name for path in folder.iterdir()) == [
        "comparison_simulated.pdf", "comparison_simulated.png", "index.html",
    ]  # fmt: skip


def test_a_benchmark_without_panels_and_without_ours_still_gives_a_page(paths, tmp_path):
    benchmark = tmp_path / "benchmark"
    shutil.copytree(paths.benchmark, benchmark, ignore=shutil.ignore_patterns("panels"))
    metrics = json.loads((benchmark / "sets" / "simulated" / "metrics.json").read_text())
    del metrics["ours"]
    (benchmark / "sets" / "simulated" / "metrics.json").write_text(json.dumps(metrics))
    page = write_report(dataclasses.replace(paths, benchmark=benchmark), ["e2v"], RUN, tmp_path / "report").read_text()
    assert 'class="player"' not in page
    assert '<p class="lead">E2V: FireNet recovers DoLP' in page


def test_the_same_artefacts_give_the_same_page_and_a_log_shows_its_progress(paths, page, tmp_path, progress_log):
    assert write_report(paths, ["e2v"], RUN, tmp_path).read_text() == page
    assert any(line.startswith("page: 100%") for line in progress_log())


def test_a_further_test_set_has_its_table_and_its_pictures(paths, tmp_path):
    benchmark = tmp_path / "benchmark"
    shutil.copytree(paths.benchmark, benchmark)
    shutil.copytree(paths.simulated, benchmark / "sets" / "measured")
    page = write_report(dataclasses.replace(paths, benchmark=benchmark), ["e2v"], RUN, tmp_path / "report").read_text()
    assert "<h3>Measured polarization</h3>" in page
    assert '"name":"Measured polarization: tree-00"' in page  # in the player
    assert "Scenes whose polarization a camera measured" in page
    assert "10.40" in page  # GFLOP of ours


def test_the_strips_of_a_page_with_many_scenes_stay_within_their_bytes(monkeypatch):
    frames = np.random.default_rng(1).integers(0, 256, (12, 24, 36), dtype=np.uint8)
    films = [Film(f"scene {k}", range(12), [Map("truth", "dolp", frames)]) for k in range(3)]
    alone = player_data(films)
    assert {len(scene["ms"]) for scene in alone["scenes"]} == {12}
    size = sum(len(one["strip"]) for scene in alone["scenes"] for one in scene["maps"])
    monkeypatch.setattr("polarnet.reports.player.MAX_STRIP_BYTES", size // 2)
    assert {len(scene["ms"]) for scene in player_data(films)["scenes"]} <= {4, 5, 6}


def test_the_page_of_a_set_shows_the_table_and_what_was_left_out(paths, tmp_path):
    folder = tmp_path / "results"
    shutil.copytree(paths.simulated, folder)
    notes = ["e2vid was left out: run `dvc repro`."]
    set_page = write_set_page(folder, "my <holidays>", "polarnet benchmark --scenes x", notes).read_text()
    assert (folder / "comparison_results.png").exists()
    for text in (
        "my &lt;holidays&gt;", "oracle mean", "<dt>E2V: FireNet</dt>",
        "<dt>ours: the paper&#39;s network</dt><dd>best.safetensors (sha256 5ca1ab1e5ca1ab1e)</dd>",
        "e2vid was left out: run <code>dvc repro</code>.",
        "Sequences of 24x36 pixels (height x width), 0.2 s at 30 frames a second.",
    ):  # fmt: skip
        assert text in set_page
    assert "LPIPS (" not in set_page
    assert "`" not in set_page.split("<main>")[1].split("<script")[0]


def test_a_panel_holds_the_truth_of_the_window_it_names(data, paths):
    for panel in read_results(paths.simulated).panels:
        frames = FrameStore.open(data / "frames.zarr").frames(panel.sequence)
        assert int(frames.t_us[panel.window + 1]) == panel.t_us
        assert torch.equal(frames.dolp[panel.window + 1], panel.truth.dolp)
        assert set(panel.predictions) == {"zeros", "oracle_mean", "e2v", "ours"}
        assert [row for row, one in panel.predictions.items() if one.aolp is not None] == ["e2v"]


def test_edited_code_is_said_but_what_the_pipeline_writes_is_no_edit(tmp_path):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
        subprocess.run(["git", *identity, *arguments], cwd=tmp_path, check=True, capture_output=True)

    for name in ("code.py", "dvc.lock"):
        (tmp_path / name).write_text("1\n")
    git("init", "--quiet")
    git("add", ".")
    git("commit", "--quiet", "--message", "one")
    (tmp_path / "dvc.lock").write_text("2\n")
    assert len(facts(tmp_path)["commit"]) == 40
    (tmp_path / "code.py").write_text("2\n")
    assert facts(tmp_path)["commit"].endswith(", with uncommitted changes")
