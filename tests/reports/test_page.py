import dataclasses
import json
import re
import shutil

import pytest

from polarnet.reports.page import write_report
from polarnet.reports.provenance import Run

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


def test_the_page_needs_no_other_file_and_no_network(page):
    sources = re.findall(r'(?:src|srcset|href)="([^"]*)"', page)
    assert sources
    assert all(source.startswith(("data:", "#")) for source in sources)
    assert not re.search(r"<script|<link|@import|url\(", page)


def test_every_link_leads_to_a_section(page):
    targets = re.findall(r'href="#(\w+)"', page)
    assert len(targets) == 9
    assert all(f'<section id="{target}">' in page for target in targets)


def test_every_picture_says_what_it_shows(page):
    assert all(re.search(r'alt="[^"]+"', tag) for tag in re.findall(r"<img[^>]*>", page))


def test_the_network_is_best_here_and_the_papers_table_stands_beside(page):
    ours = re.search(r'<tr class="m-ours">.*?</tr>', page)[0]
    assert '<td class="best">' in ours
    assert "15.56" in page
    assert "27.48" in page


def test_the_page_says_which_networks_are_behind_its_rows(page):
    assert "ours: the paper&#39;s network, events to DoLP" in page  # training
    assert "E2V: FireNet, events to intensity" in page
    assert "<dt>ours: the paper&#39;s network</dt><dd>The DoLP network in use. The network of the paper" in page
    assert '<th scope="row">E2V: FireNet</th>' in page
    assert "olarnet&#39;s own network" not in page


def test_a_baseline_that_no_row_uses_is_neither_drawn_nor_explained(page):
    text = re.sub(r"data:image/[^\"]+", "", page)  # base64, in which any three letters may stand by chance
    assert "E2P" not in text
    assert "2 networks trained on them" in page


def test_the_papers_figures_are_told_from_those_of_the_run(page):
    published = re.search(r'<aside class="published">.*?</aside>', page, re.DOTALL)[0]
    assert "Published figures of the paper, not of this run." in published
    assert "15.56" in published
    assert "27.48" in published
    assert '<tr class="m-ours">' not in published
    assert "15.56" not in page.replace(published, "")


def test_without_lpips_the_table_has_no_such_column_and_the_page_no_warning(page):
    assert "LPIPS was left out" not in page
    assert 'class="warning"' not in page
    assert "LPIPS (" not in page
    assert "none: benchmark.lpips is false" in page


def test_parameters_are_listed_with_their_full_keys(page):
    assert "<code>networks.paper.channels</code></td><td>[32, 64]" in page
    assert "<code>lpips.path</code></td><td>null" in page


def test_text_from_files_is_escaped(page):
    assert "&lt;b&gt;Ann&lt;/b&gt;" in page
    assert "<b>Ann</b>" not in page


def test_skipped_files_are_named(page):
    assert "broken.jpg" in page
    assert "cannot be read: ends early" in page


def test_a_network_without_aolp_is_not_shown_in_colour(page):
    assert "recovers DoLP alone" in page


def test_two_pictures_lie_beside_the_page_for_use_elsewhere(folder):
    assert sorted(path.name for path in folder.iterdir()) == ["comparison.png", "index.html", "overview.png"]


def test_a_benchmark_without_panels_and_without_ours_still_gives_a_page(paths, tmp_path):
    benchmark = tmp_path / "benchmark"
    shutil.copytree(paths.benchmark, benchmark, ignore=shutil.ignore_patterns("panels"))
    metrics = json.loads((benchmark / "metrics.json").read_text())
    del metrics["ours"]
    (benchmark / "metrics.json").write_text(json.dumps(metrics))
    page = write_report(dataclasses.replace(paths, benchmark=benchmark), ["e2v"], RUN, tmp_path / "report").read_text()
    assert "kept no window of the network" in page
    assert 'class="card"' not in page


def test_the_same_artefacts_give_the_same_page(paths, page, tmp_path):
    assert write_report(paths, ["e2v"], RUN, tmp_path).read_text() == page


def test_a_further_test_set_has_its_table_and_its_pictures(paths, tmp_path):
    benchmark = tmp_path / "benchmark"
    shutil.copytree(paths.benchmark, benchmark)
    shutil.copytree(paths.benchmark, benchmark / "sets" / "measured")
    page = write_report(dataclasses.replace(paths, benchmark=benchmark), ["e2v"], RUN, tmp_path / "report").read_text()
    assert page.count("Measured polarization") >= 3  # heading, caption, pictures
    assert "Scenes whose polarization a camera measured" in page
    assert "ours is better in" in page
    assert "10.40" in page  # GFLOP of ours
