import subprocess

import torch

from polarnet.reports.artefacts import facts, read_results
from polarnet.storage.frames import FrameStore


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
