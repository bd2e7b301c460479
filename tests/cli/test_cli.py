import contextlib
import os
import re
import shlex
import subprocess
import sys

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


def test_verify_of_something_else_says_what_was_expected_and_a_name_that_is_not_utf_8_is_refused(tmp_path, capsys):
    (tmp_path / "nothing.zarr").mkdir()
    assert main(["verify", str(tmp_path / "nothing.zarr")]) == 1
    assert "there is no Zarr v3 group" in capsys.readouterr().out
    with pytest.raises(SystemExit) as ending:
        main(["recover", "camera\udcff.raw"])
    assert ending.value.code == 2
    assert "'camera\\udcff.raw': expected a name in UTF-8; rename the file" in capsys.readouterr().err


MISSING = [
    "recover nofile", "recover . --truth nofile", "recover-rotating nofile", "inspect nofile", "view nofile",
    "video nofile", "replay nofile lake", "verify nofile", "simulate nofile seed=2", "convert nofile out.h5",
    "fit-sensor --name lab --flicker . nofile", "onnx out.onnx --weights nofile", "benchmark --scenes nofile",
    "benchmark --recordings nofile",
]  # fmt: skip


def test_an_input_that_does_not_exist_is_refused_before_any_library_is_imported(tmp_path, project_root):
    program = f"import sys; from polarnet.cli import main; print(*(main(line.split()) for line in {MISSING!r})); "
    program += "print(sorted({'torch', 'numpy', 'hydra', 'pydantic'} & {*sys.modules}))"
    environment = os.environ | {"PYTHONPATH": str(project_root)}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.stdout.splitlines() == [" ".join("1" for _ in MISSING), "[]"]
    assert done.stderr.splitlines() == [
        f"polarnet {line.split()[0]}: nofile: there is no such file or folder" for line in MISSING
    ]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("recovr x", "'benchmark'); did you mean 'recover'? (see polarnet --help)"),
        ("recover x --mosiac 1", "unrecognized arguments: --mosiac 1; did you mean '--mosaic'? (see polarnet recover"),
        ("recover x --write mp3", "did you mean 'mp4'?"),
        ("recover x --zzz", "unrecognized arguments: --zzz (see polarnet recover --help)"),
    ],
)
def test_a_mistyped_word_is_refused_in_one_line_with_the_closest_one(line, message, capsys):
    with pytest.raises(SystemExit) as ending:
        main(line.split())
    assert ending.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "close"),
    [
        ("recover . --method higpass", "highpass"),
        ("benchmark --scenes . senser=noisy", "sensor"),
        ("benchmark --scenes . sensor=nosy", "noisy"),
        ("benchmark --scenes . emulate.contrast_treshold_on=1", "contrast_threshold_on"),
        ("benchmark --scenes . --methods ourz", "ours"),
        ("preset smok", "smoke"),
    ],
)
def test_a_mistyped_method_setting_or_preset_is_refused_with_the_closest_one(line, close, project_root, capsys):
    with contextlib.chdir(project_root):
        assert main(line.split()) == 1
    assert f"did you mean {close!r}?" in capsys.readouterr().err


def test_a_command_on_a_clone_says_so_elsewhere(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["preset", "smoke"]) == 1
    assert "run this command inside a clone" in capsys.readouterr().err
