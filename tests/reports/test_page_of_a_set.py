import shutil

import pytest

from polarnet.reports.page import write_set_page


@pytest.fixture(scope="module")
def page(paths, tmp_path_factory):
    folder = tmp_path_factory.mktemp("set") / "results"
    shutil.copytree(paths.simulated, folder)
    path = write_set_page(
        folder, "my <holidays>", "polarnet benchmark --scenes x", ["e2vid was left out: run `dvc repro`."]
    )
    assert (folder / "comparison.png").exists()
    return path.read_text()


def test_the_page_shows_the_table_the_papers_and_what_was_left_out(page):
    assert "my &lt;holidays&gt;" in page
    assert "e2vid was left out" in page
    assert "15.56" in page
    assert "LPIPS (" not in page
    assert "oracle mean" in page
    assert "<dt>ours: the paper&#39;s network</dt><dd>best.safetensors (sha256 5ca1ab1e5ca1ab1e)</dd>" in page
    assert "Published figures of the paper, not of this run." in page


def test_size_duration_and_networks_stand_on_the_page_and_no_backtick(page):
    assert "Sequences of 24x36 pixels (height x width), 0.2 s at 30 frames a second." in page
    assert "<dt>E2V: FireNet</dt>" in page
    assert "run <code>dvc repro</code>." in page
    assert "`" not in page.split("<main>")[1].split("<script")[0]
