import re
import shlex

import fsspec
import pytest
from part_fixtures import flip

from polarnet.cli import main, parse
from polarnet.cli.commands import command_parser
from polarnet.storage.events import EventStore


@pytest.fixture
def store(tmp_path, make_random_events):
    """Two sequences with events behind each polarizer."""
    path = tmp_path / "two.zarr"
    writer = EventStore.create(path, ["lake", "road"], 4, 6, {})
    for name in writer.sequences:
        writer.write(name, [make_random_events(1, 50, 999, 4, 6)] * 4, 1000)
    writer.finish()
    return path


COMMANDS = next(action.choices for action in command_parser()._actions if action.dest == "command")


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_ends_with_examples_that_it_understands(name):
    examples = re.findall(rf"polarnet {name}\b[^&|\n]*", COMMANDS[name].epilog or "")
    assert examples
    for example in examples:
        assert parse(shlex.split(example)[1:]).command == name


def test_doctor_names_versions_device_and_what_to_do_about_missing_weights(capsys):
    assert main(["doctor"]) == 0
    printed = capsys.readouterr().out
    for word in ("polarnet", "torch", "device", "threads", "bf16", "LPIPS      vgg", "memory", "disk"):
        assert word in printed


@pytest.mark.parametrize("file", ["x/c/0", "t/zarr.json", "zarr.json"])
def test_verify_of_a_folder_and_of_a_url_names_file_and_sequence_of_a_flipped_or_missing_byte(store, capsys, file):
    bucket, url = fsspec.filesystem("memory"), "memory://bucket/two.zarr"
    bucket.put(str(store), "/bucket/two.zarr", recursive=True)
    try:
        for place in (store, url):
            assert main(["verify", str(place)]) == 0
            assert f"{place}: intact" in capsys.readouterr().out
        flip(store / "part-00001" / file)
        bucket.rm(f"/bucket/two.zarr/part-00001/{file}")
        for place in (store, url):
            assert main(["verify", str(place)]) == 1
            printed = capsys.readouterr().out
            assert f"part-00001/{file} is not as it was written; it holds road" in printed
            assert "lake" not in printed
    finally:
        bucket.rm("/bucket", recursive=True)


def test_verify_of_something_else_says_what_was_expected(tmp_path, capsys):
    assert main(["verify", str(tmp_path / "nothing.zarr")]) == 1
    assert "there is no Zarr v3 group" in capsys.readouterr().out


def test_a_name_that_is_not_utf_8_is_refused_before_any_work(capsys):
    with pytest.raises(SystemExit) as ending:
        main(["recover", "camera\udcff.raw"])
    assert ending.value.code == 2
    assert "'camera\\udcff.raw': expected a name in UTF-8; rename the file" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["preset", "smoke"], ["benchmark", "--event-budget"]])
def test_a_command_on_a_clone_says_so_elsewhere(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    assert main(command) == 1
    assert "run this command inside a clone" in capsys.readouterr().err
