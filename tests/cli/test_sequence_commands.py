"""Commands on stored sequences: inspect, video, convert of some, and recovery with truth."""

import av
import pytest

from polarnet.cli import main
from polarnet.storage.frames import FrameStore


def test_inspect_names_the_sequences_of_a_store(simulated, capsys):
    assert main(["inspect", str(simulated.events)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["a-0", "b-0", "c-0", "d-0"]
    assert all("0.200 s" in line and line.endswith(" events") for line in lines)
    assert main(["inspect", str(simulated.frames)]) == 0
    assert [line.split()[1] for line in capsys.readouterr().out.splitlines()] == ["train", "train", "train", "val"]


def test_video_shows_a_picture_for_each_true_frame_after_the_first(simulated, tmp_path, capsys):
    assert main(["video", str(simulated.events), "b-0", "--out", str(tmp_path / "b.mp4")]) == 0
    with av.open(str(tmp_path / "b.mp4")) as file:
        assert len([*file.decode(video=0)]) == len(FrameStore.open(simulated.frames).t_us("b-0")) - 1
    assert main(["video", str(simulated.events), "e-0"]) == 1
    assert "expected a sequence of a-0, b-0, c-0, d-0; got 'e-0'" in capsys.readouterr().err


def test_one_sequence_of_a_store_is_converted(simulated, tmp_path):
    pytest.importorskip("h5py")
    assert main(["convert", str(simulated.events), str(tmp_path / "files"), "--sequence", "b-0"]) == 0
    assert sorted(path.name for path in (tmp_path / "files").iterdir()) == ["b-0", "run.json"]


def test_truth_scores_a_recovery_and_reaches_its_video(simulated, tmp_path, capsys):
    command = ["recover", str(simulated.events), "--sequence", "b-0", "--method", "highpass", "--truth",
               "--write", "mp4", "--out", str(tmp_path / "out")]  # fmt: skip
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "scores      MSE 0." in printed
    assert "AoLP error" in printed
    assert "MSE of the true mean of each frame alone 0." in printed
    with av.open(str(tmp_path / "out" / "recovered.mp4")) as file:
        assert next(file.decode(video=0)).width > 700  # three columns of panels
    (tmp_path / "e.txt").write_text("4 4\n1 2 3 1\n")
    assert main(["recover", str(tmp_path / "e.txt"), "--mosaic", "90 45 / 135 0", "--method", "cf", "--truth"]) == 1
    assert "--truth: expected an event store" in capsys.readouterr().err
    assert main(["recover", str(simulated.events.parent), "--truth"]) == 1
    assert f"did you mean {simulated.events}?" in capsys.readouterr().err
