import os

import pytest

from studies.walk import ROOT, WALKS, Walk, walked


def test_a_walk_counts_only_if_every_command_works_and_leaves_the_result(tmp_path):
    walk = Walk("a video", ("mkdir out", "printf 'ftyp' > out/video.mp4"), "out/video.mp4", b"ftyp")
    assert len(walked(walk, tmp_path, os.environ)) == 2
    with pytest.raises(RuntimeError, match="mkdir out: status 1"):
        walked(walk, tmp_path, os.environ)
    with pytest.raises(RuntimeError, match=r"expected out/video\.mp4 with b'moov'"):
        walked(walk._replace(commands=("true",), contains=b"moov"), tmp_path, os.environ)


def test_the_page_on_own_methods_shows_the_commands_of_the_walk():
    page = (ROOT / "docs" / "methods.md").read_text()
    assert "\n".join(WALKS["method"].commands) in page
