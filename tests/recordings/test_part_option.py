"""Commands that open a recording take --part where a file holds several, and refuse options without a meaning."""

import json

import pytest

from polarnet.cli import main
from polarnet.recordings.noise import read_hot_pixels
from polarnet.recordings.recording import read_recording

pytest.importorskip("rosbags", reason="the extra rosbag is not installed")

from studies.recording_files import two_arrays, write_bag

COMMANDS = {
    "inspect": ("--out", "out"),
    "view": ("--out", "out.html", "--no-browser"),
    "convert": ("out.h5",),
    "recover": (
        "--mosaic", "90 45 / 135 0", "--method", "highpass", "--window", "10ms", "--write", "zarr", "--out", "out",
    ),
}  # fmt: skip


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A bag of two topics, and the folder of a ROS 2 bag with one; both hold 400 events in 40 ms."""
    monkeypatch.chdir(tmp_path)
    rows = [(100 * k, k % 18, k * 7 % 12, 1 - 2 * (k % 2)) for k in range(400)]
    write_bag(tmp_path / "two.bag", 12, 18, two_arrays(rows), ("/left", "/right"))
    write_bag(tmp_path / "one", 12, 18, two_arrays(rows), plugin="SQLITE3")
    return tmp_path


@pytest.mark.parametrize("command", COMMANDS)
def test_a_file_of_several_recordings_is_read_with_its_part_alone(folder, capsys, command):
    assert main([command, "two.bag", *COMMANDS[command]]) != 0
    assert "say which topic of events to read, --part with one of /left, /right" in capsys.readouterr().err
    assert main([command, "two.bag", *COMMANDS[command], "--part", "/right"]) == 0
    if command == "convert":
        assert len(read_recording("out.h5").events) == 400


@pytest.mark.parametrize("command", COMMANDS)
def test_the_folder_of_a_bag_is_a_recording(folder, command):
    assert main([command, "one", *COMMANDS[command], "--height", "12", "--width", "18"]) == 0


def test_the_folder_of_a_bag_is_read_behind_a_rotating_polarizer(folder):
    assert main(["recover-rotating", "one", "--rate", "50", "--height", "12", "--out", "out"]) == 0
    assert json.loads((folder / "out" / "run.json").read_text())["command"] == "polarnet recover-rotating"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("inspect", "e.txt", "--part", "left"), "expected no part, which has no meaning for the format text"),
        (("view", "e.txt", "--sequence", "lake", "--no-browser"), "a recording: expected no --sequence"),
        (("recover", "e.txt", "--method", "highpass", "--sequence", "lake"), "a recording: expected no --sequence"),
        (("recover", "-", "--live", "--part", "left"), "--live: expected no --part"),
    ],
)
def test_options_without_a_meaning_are_refused(folder, capsys, words, message):
    (folder / "e.txt").write_text("18 12\n5 1 2 1\n")
    assert main([*words]) != 0
    assert message in capsys.readouterr().err


def test_inspect_writes_the_list_of_hot_pixels_that_recover_reads(folder, capsys):
    rows = [(10 * k, k // 2 % 18, k // 36 % 12, 1) if k % 2 else (10 * k, 3, 4, 1) for k in range(4000)]
    (folder / "e.txt").write_text("18 12\n" + "".join(f"{t} {x} {y} {p}\n" for t, x, y, p in rows))
    assert main(["inspect", "e.txt", "--out", "out"]) == 0
    assert "hot pixels  out/e.txt.hot.txt, for --hot-pixels" in capsys.readouterr().out
    assert read_hot_pixels(folder / "out" / "e.txt.hot.txt", 12, 18).sum() == 1
    (folder / "out" / "e.txt.hot.txt").rename(folder / "hot.txt")
    assert main(["recover", "e.txt", *COMMANDS["recover"], "--hot-pixels", "hot.txt", "--out", "recovered"]) == 0
    assert "events of 1 hot pixels" in capsys.readouterr().out
