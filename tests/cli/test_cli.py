import re
import shlex
from pathlib import Path

import fsspec
import pytest
import torch
from part_fixtures import flip

from polarnet.cli import _options, _parser, main
from polarnet.events.stream import Events
from polarnet.storage.events import EventStore


@pytest.fixture
def store(tmp_path):
    """One sequence with one event behind each polarizer."""
    path = tmp_path / "events.zarr"
    writer = EventStore.create(path, ["lake"], 4, 6, {})
    one = Events(
        torch.tensor([500]),
        torch.tensor([5]).short(),
        torch.tensor([3]).short(),
        torch.tensor([1]).to(torch.int8),
        4,
        6,
    )
    writer.write("lake", [one] * 4, 1000)
    writer.finish()
    return path


COMMANDS = next(action.choices for action in _parser()._actions if action.dest == "command")


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_ends_with_examples_that_it_understands(name):
    examples = re.findall(rf"polarnet {name}\b[^&|\n]*", COMMANDS[name].epilog or "")
    assert examples
    for example in examples:
        assert _options(shlex.split(example)[1:]).command == name


def test_doctor_names_the_rows_that_can_use_a_file_of_weights(tmp_path, capsys):
    import torch

    from polarnet.networks.e2p.network import E2p

    torch.save({"state_dict": E2p(5, aolp_channels=2).state_dict()}, tmp_path / "e2p.pth")
    assert main(["doctor", "--weights", str(tmp_path / "e2p.pth")]) == 0
    printed = capsys.readouterr().out
    assert "e2p.pth: row e2p_published (E2P, published weights), 512,790 parameters" in printed
    assert "firenet" not in printed
    (tmp_path / "x.pth").write_bytes(b"nothing")
    assert main(["doctor", "--weights", str(tmp_path / "x.pth")]) == 1
    assert "no method can use it" in capsys.readouterr().err


def test_doctor_names_versions_device_and_what_to_do_about_missing_weights(capsys):
    assert main(["doctor"]) == 0
    printed = capsys.readouterr().out
    for word in ("polarnet", "torch", "device", "threads", "bf16", "LPIPS      vgg", "memory", "disk"):
        assert word in printed


def test_verify_finds_a_flipped_byte_and_names_the_sequence(store, capsys):
    assert main(["verify", str(store)]) == 0
    flip(store / "part-00000.zip", "events/x/c/0")
    assert main(["verify", str(store)]) == 1
    assert "lake" in capsys.readouterr().out


@pytest.fixture
def two(tmp_path):
    """Two sequences with an event behind each polarizer."""
    path = tmp_path / "two.zarr"
    writer = EventStore.create(path, ["lake", "road"], 4, 6, {})
    one = Events(
        torch.tensor([500]), *(torch.tensor([1], dtype=d) for d in (torch.int16, torch.int16, torch.int8)), 4, 6
    )
    for name in writer.sequences:
        writer.write(name, [one] * 4, 1000)
    writer.finish()
    return path


COLUMNS = ("events/x", "events/y", "events/t", "events/p", "ms_to_idx")


def assert_verify_names_the_road(place: str | Path, column: str, capsys) -> None:
    assert main(["verify", str(place)]) == 1
    printed = capsys.readouterr().out
    assert f"road, column {column} is unreadable" in printed
    assert "lake" not in printed


@pytest.mark.parametrize("column", COLUMNS)
def test_verify_of_a_folder_and_of_a_url_names_the_sequence_with_a_flipped_byte(two, capsys, column):
    bucket, url = fsspec.filesystem("memory"), "memory://bucket/two.zarr"
    bucket.put(str(two), "/bucket/two.zarr", recursive=True)
    try:
        for place in (two, url):
            assert main(["verify", str(place)]) == 0
            assert f"{place}: intact" in capsys.readouterr().out
        flip(two / "part-00001.zip", f"{column}/c/0" if column.startswith("events") else f"{column}/c/0/0")
        bucket.pipe_file("/bucket/two.zarr/part-00001.zip", (two / "part-00001.zip").read_bytes())
        for place in (two, url):
            assert_verify_names_the_road(place, column, capsys)
    finally:
        bucket.rm("/bucket", recursive=True)


def test_verify_names_a_sequence_whose_file_is_missing_from_a_bucket(two, capsys):
    bucket = fsspec.filesystem("memory")
    bucket.put(str(two), "/bucket/two.zarr", recursive=True)
    try:
        bucket.rm("/bucket/two.zarr/part-00001.zip")
        assert main(["verify", "memory://bucket/two.zarr"]) == 1
        printed = capsys.readouterr().out
        assert "road, part-00001.zip is unreadable" in printed
        assert "lake" not in printed
    finally:
        bucket.rm("/bucket", recursive=True)


def test_a_name_that_is_not_utf_8_is_refused_before_any_work(capsys):
    with pytest.raises(SystemExit) as ending:
        main(["recover", "camera\udcff.raw"])
    assert ending.value.code == 2
    assert "'camera\\udcff.raw': expected a name in UTF-8; rename the file" in capsys.readouterr().err


def test_verify_of_something_else_says_what_was_expected(tmp_path, capsys):
    assert main(["verify", str(tmp_path / "nothing.zarr")]) == 1
    assert "there is no Zarr v3 group" in capsys.readouterr().out


@pytest.mark.parametrize("command", [["preset", "smoke"], ["benchmark", "--event-budget"]])
def test_a_command_on_a_clone_says_so_elsewhere(tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    assert main(command) == 1
    assert "run this command inside a clone" in capsys.readouterr().err
