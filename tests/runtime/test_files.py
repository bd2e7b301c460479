import hashlib
import subprocess

import pytest

from polarnet.runtime.files import SUMS, changed_files, check_seal, replaced, seal, sha256


def test_the_hash_of_parts_is_that_of_their_concatenation(tmp_path):
    (tmp_path / "b").write_bytes(b"bc" * 500_000)
    assert sha256(b"a", tmp_path / "b", b"d") == hashlib.sha256(b"a" + b"bc" * 500_000 + b"d").hexdigest()
    assert sha256() == hashlib.sha256().hexdigest()


def test_a_file_is_replaced_once_its_new_content_is_whole(tmp_path):
    file = tmp_path / "file.json"
    file.write_text("old")
    with replaced(file) as temporary:
        temporary.write_text("new")
        assert file.read_text() == "old"
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("file.json", "new")]


def test_an_error_leaves_the_old_file_alone(tmp_path):
    file = tmp_path / "file.json"
    file.write_text("old")

    def fill_the_disk():
        with replaced(file) as temporary:
            temporary.write_text("ha")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fill_the_disk()
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("file.json", "old")]


@pytest.fixture
def sealed(tmp_path):
    (tmp_path / "below").mkdir()
    for name in ("a", "below/b"):
        (tmp_path / name).write_text(f"content of {name}")
    assert changed_files(tmp_path) == []
    seal(tmp_path)
    assert changed_files(tmp_path) == []
    return tmp_path


def test_the_checksums_of_a_folder_are_those_of_coreutils(sealed):
    assert subprocess.run(["sha256sum", "--check", "--strict", SUMS], cwd=sealed, capture_output=True).returncode == 0


def test_a_changed_and_a_missing_file_are_named(sealed):
    (sealed / "a").write_text("other")
    (sealed / "below" / "b").unlink()
    changed, missing = changed_files(sealed)
    assert changed.startswith(f"{sealed / 'a'} is not the file that")
    assert missing.startswith(f"{sealed / 'below' / 'b'} is missing")
    assert changed_files(sealed, ["below/b"]) == [missing]
    with pytest.raises(ValueError, match="a is not the file"):
        check_seal(sealed)
