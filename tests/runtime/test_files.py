import errno
import hashlib
import os
import shutil
import subprocess
import sys
from multiprocessing import get_context

import pytest

from polarnet.runtime import files
from polarnet.runtime.files import SUMS, changed_files, check_name, check_seal, claimed, publish, replaced, seal, sha256


def test_the_hash_of_parts_is_that_of_their_concatenation(tmp_path):
    (tmp_path / "b").write_bytes(b"bc" * 500_000)
    assert sha256(b"a", tmp_path / "b", b"d") == hashlib.sha256(b"a" + b"bc" * 500_000 + b"d").hexdigest()
    assert sha256() == hashlib.sha256().hexdigest()


def test_a_file_is_replaced_once_its_new_content_is_whole_and_an_error_leaves_the_old_one(tmp_path):
    file = tmp_path / "file.json"
    file.write_text("old")
    with replaced(file) as temporary:
        temporary.write_text("new")
        assert file.read_text() == "old"
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("file.json", "new")]

    def fill_the_disk():
        with replaced(file) as temporary:
            temporary.write_text("ha")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fill_the_disk()
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("file.json", "new")]


@pytest.fixture
def sealed(tmp_path):
    (tmp_path / "below").mkdir()
    for name in ("a", "below/b"):
        (tmp_path / name).write_text(f"content of {name}")
    assert "SHA256SUMS is missing, so that nothing says whether" in changed_files(tmp_path)[0]
    seal(tmp_path)
    assert changed_files(tmp_path) == []
    return tmp_path


def test_the_checksums_of_a_folder_are_those_of_coreutils_and_changed_and_missing_files_are_named(sealed):
    assert subprocess.run(["sha256sum", "--check", "--strict", SUMS], cwd=sealed, capture_output=True).returncode == 0
    (sealed / "a").write_text("other")
    (sealed / "below" / "b").unlink()
    changed, missing = changed_files(sealed)
    assert changed.startswith(f"{sealed / 'a'} is not the file that")
    assert missing.startswith(f"{sealed / 'below' / 'b'} is missing")
    assert changed_files(sealed, ["below/b"]) == [missing]
    with pytest.raises(ValueError, match="a is not the file"):
        check_seal(sealed)


@pytest.mark.parametrize("emptied", ["all", "one"])
def test_a_seal_must_name_every_file(sealed, emptied):
    lines = (sealed / SUMS).read_text().splitlines(keepends=True)
    (sealed / SUMS).write_text("" if emptied == "all" else lines[1])
    assert changed_files(sealed)[0].startswith(f"{sealed / 'a'} is not in {sealed / SUMS}")
    (sealed / ".DS_Store").touch()  # hidden files hold no results
    seal(sealed)
    assert changed_files(sealed) == []


@pytest.mark.parametrize(
    "name", ["", "..", "/tmp/x", "a/../../b", "a\\b", "a\nb", "a\u2028b", "a\u202eb", "\ud800", "x" * 300]
)
def test_a_name_that_could_be_a_place_is_refused(name):
    with pytest.raises(ValueError, match="expected a name without slashes"):
        check_name(name)
    assert check_name("lake 01 ü") == "lake 01 ü"


class Killed(BaseException):
    """Stands for SIGKILL."""


@pytest.mark.parametrize("exchange", [True, False])
def test_a_published_folder_is_the_old_one_or_the_new_one_whenever_the_process_dies(tmp_path, monkeypatch, exchange):
    rename, deaths = os.rename, 0
    monkeypatch.setattr(files, "_exchanged", files._exchanged if exchange else lambda one, other: False)
    for dies_at in range(10):
        shutil.rmtree(tmp_path)
        names = ["out", "out.partial", "out.old", *["out.old.tmp"] * exchange]  # a user's copy, and one of a killed run
        for name in names:
            (tmp_path / name).mkdir(parents=True)
            (tmp_path / name / "a").write_text(name)
        renames = iter(range(10))

        def dying(source, target, renames=renames, dies_at=dies_at):
            if next(renames) == dies_at:
                raise Killed
            rename(source, target)

        monkeypatch.setattr(os, "rename", dying)
        try:
            publish(tmp_path / "out.partial", tmp_path / "out")
        except Killed:
            deaths += 1
        monkeypatch.setattr(os, "rename", rename)
        with files.claimed(tmp_path / "out"):
            assert (tmp_path / "out" / "a").read_text() in ("out", "out.partial")
    assert deaths == (1 if exchange else 2)
    assert (tmp_path / "out" / "a").read_text() == "out.partial"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "out.old"]


def test_a_temporary_file_that_is_a_link_changes_no_file_elsewhere_and_two_do_not_write_one_file(tmp_path):
    (tmp_path / "victim").write_text("precious")
    (tmp_path / "file.tmp").symlink_to(tmp_path / "victim")
    with replaced(tmp_path / "file") as temporary:
        temporary.write_text("new")
        second = get_context("fork").Process(target=replace, args=(tmp_path / "file",))
        second.start()
        second.join()
        assert second.exitcode == 1
    assert (tmp_path / "victim").read_text() == "precious"
    assert (tmp_path / "file").read_text() == "new"


def replace(file):
    with pytest.raises(ValueError, match="file: another process is writing it"), replaced(file):
        pass
    sys.exit(1)


def test_bytes_are_on_the_disk_before_the_rename_and_the_name_after_it(tmp_path, monkeypatch):
    calls, fsync, rename = [], os.fsync, os.rename
    paths = {}

    def opened(path, flags, *mode, open_file=os.open):
        handle = open_file(path, flags, *mode)
        paths[handle] = os.fspath(path)
        return handle

    monkeypatch.setattr(os, "open", opened)
    monkeypatch.setattr(os, "fsync", lambda handle: (calls.append(paths[handle]), fsync(handle)))
    monkeypatch.setattr(os, "rename", lambda one, other: (calls.append("rename"), rename(one, other)))
    (tmp_path / "out.tmp" / "below").mkdir(parents=True)
    (tmp_path / "out.tmp" / "below" / "b").write_text("b")
    publish(tmp_path / "out.tmp", tmp_path / "out")
    place = calls.index("rename")
    assert {*calls[:place]} == {f"{tmp_path}/{name}" for name in ("out.tmp", "out.tmp/below", "out.tmp/below/b")}
    assert calls[place + 1 :] == [str(tmp_path)]


def test_a_device_or_a_folder_is_not_replaced_by_a_file(tmp_path):
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for name in ("folder", "pipe"):
        with pytest.raises(ValueError, match=rf"{name}: expected the name of a file, got a folder or a device"):
            replaced(tmp_path / name).__enter__()
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize("shortage", [errno.ENOSPC, errno.EFBIG])
@pytest.mark.parametrize("kind", [OSError, RuntimeError])
def test_a_shortage_names_the_place_and_what_to_do(tmp_path, shortage, kind):
    words = f"file write failed, error message = '{os.strerror(shortage)}'"  # as h5py says it, without a number
    error = OSError(shortage, os.strerror(shortage)) if kind is OSError else RuntimeError(words)
    with (
        pytest.raises(OSError, match=rf"{tmp_path}/new: {os.strerror(shortage)}; make room"),
        claimed(tmp_path / "new"),
    ):
        raise error
