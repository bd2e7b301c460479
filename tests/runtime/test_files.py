import hashlib

import pytest

from polarnet.runtime.files import replaced, sha256


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
