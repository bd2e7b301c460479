"""Output folders hold one run."""

import errno
import os
from pathlib import Path
from unittest import mock

import pytest

from polarnet.cli.outputs import MARKER, WORK, run_folder


def names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def write(folder, *files):
    with run_folder(folder, "recover") as partial:
        for file in files:
            (partial / file).parent.mkdir(parents=True, exist_ok=True)
            (partial / file).write_text(file)


def fail(folder, error, *files):
    with run_folder(folder, "recover") as partial:
        (partial / "png").mkdir()
        for file in files:
            (partial / file).parent.mkdir(exist_ok=True)
            (partial / file).touch()
        raise error


def test_files_move_into_the_folder_at_the_end_alone_and_a_second_run_leaves_nothing_of_the_first(tmp_path):
    out = tmp_path / "out"
    with run_folder(out, "recover") as partial:
        (partial / "0.png").touch()
        assert partial == tmp_path / "out.partial"
        assert not out.exists()
    assert names(tmp_path) == ["out/0.png", f"out/{MARKER}"]
    assert not partial.exists()
    write(out, "png/1.png", "video.mp4")
    assert names(tmp_path) == ["out/png/1.png", f"out/{MARKER}", "out/video.mp4"]


def test_a_folder_with_other_files_is_refused_and_untouched(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ValueError, match="contains files that `polarnet recover` did not write; name another folder"):
        write(tmp_path, "0.png")
    with run_folder(tmp_path / "out", "convert") as partial:
        (partial / "events.h5").touch()
    with pytest.raises(ValueError, match="`polarnet recover` did not write"):
        write(tmp_path / "out", "0.png")
    with pytest.raises(ValueError, match="expected a folder, got a file; name a folder"):
        write(tmp_path / "thesis.tex", "0.png")
    assert names(tmp_path) == ["out/events.h5", f"out/{MARKER}", "thesis.tex"]


def test_a_run_that_is_stopped_keeps_its_files_apart_and_the_next_run_replaces_them(tmp_path, capsys):
    with pytest.raises(ValueError, match="refused"):  # before its first file
        fail(tmp_path / "a" / "out", ValueError("refused"), f"{WORK}/imported")
    assert not any(tmp_path.iterdir())
    write(tmp_path / "out", "before.png")
    with pytest.raises(KeyboardInterrupt):
        fail(tmp_path / "out", KeyboardInterrupt(), "0.png")
    assert f"files of the unfinished run: {tmp_path / 'out.partial'}" in capsys.readouterr().err
    assert names(tmp_path) == ["out.partial/0.png", f"out.partial/{MARKER}", "out/before.png", f"out/{MARKER}"]
    write(tmp_path / "out", "after.png")
    assert names(tmp_path) == ["out/after.png", f"out/{MARKER}"]


def test_work_that_a_later_run_goes_on_from_stays_and_a_folder_of_another_user_is_refused(tmp_path, monkeypatch):
    (tmp_path / "out" / WORK).mkdir(parents=True)
    (tmp_path / "out" / WORK / "scenes").touch()
    write(tmp_path / "out", "metrics.json")
    assert names(tmp_path / "out") == ["metrics.json", MARKER, "work/scenes"]
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(ValueError, match="out: expected a folder that you may write"):
        write(tmp_path / "out", "png/1.png")
    assert names(tmp_path / "out") == ["metrics.json", MARKER, "work/scenes"]


def test_work_survives_a_run_that_ends_while_it_publishes(tmp_path, monkeypatch):
    (tmp_path / "out" / WORK).mkdir(parents=True)
    (tmp_path / "out" / WORK / "scenes").touch()
    with monkeypatch.context() as patched:
        patched.setattr("polarnet.cli.outputs.publish", mock.Mock(side_effect=OSError("full")))
        with pytest.raises(OSError, match="full"):
            write(tmp_path / "out", "metrics.json")
    write(tmp_path / "out", "metrics.json")
    assert names(tmp_path / "out") == ["metrics.json", MARKER, "work/scenes"]


def test_no_run_takes_the_folder_one_is_in_or_the_root(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in (".", "..", "/"):
        with pytest.raises(ValueError, match="expected a folder of its own, got the one you are in"):
            write(Path(folder))


def test_a_disk_full_at_the_first_byte_is_named_and_the_next_run_works(tmp_path, monkeypatch):
    write(tmp_path / "out", "before.png")

    def half(path, *_, **__):
        path.touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", half)
        with pytest.raises(OSError, match="out: No space left on device; make room"):
            write(tmp_path / "out", "after.png")
    assert names(tmp_path) == ["out/before.png", f"out/{MARKER}"]
    (tmp_path / "out.partial").mkdir()
    (tmp_path / "out.partial" / MARKER).touch()  # of a process that was killed then
    write(tmp_path / "out", "after.png")
    assert names(tmp_path) == ["out/after.png", f"out/{MARKER}"]
