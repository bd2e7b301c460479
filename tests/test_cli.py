import pytest
import torch

from polarnet.cli import main
from polarnet.events.store import EventStore
from polarnet.events.stream import Events


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


def test_doctor_names_versions_device_and_what_to_do_about_missing_weights(capsys):
    assert main(["doctor"]) == 0
    printed = capsys.readouterr().out
    for word in ("polarnet", "torch", "device", "threads", "bf16", "LPIPS      vgg", "memory", "disk"):
        assert word in printed


def test_the_stages_come_in_the_order_they_run_in(capsys, project_root, monkeypatch):
    monkeypatch.chdir(project_root / "tests")
    assert main(["stages"]) == 0
    assert capsys.readouterr().out.split() == [
        "ingest", "synthesize", "emulate", "weights", "train", "train_e2v", "sets", "benchmark", "report",
    ]  # fmt: skip


def test_verify_finds_a_flipped_byte_and_names_the_sequence(store, capsys):
    assert main(["verify", str(store)]) == 0
    chunk = next(path for path in (store / "events" / "x").rglob("*") if path.is_file() and path.name != "zarr.json")
    content = bytearray(chunk.read_bytes())
    content[len(content) // 3] ^= 1
    chunk.write_bytes(content)
    assert main(["verify", str(store)]) == 1
    assert "lake" in capsys.readouterr().out


def test_verify_of_something_else_says_what_was_expected(tmp_path, capsys):
    assert main(["verify", str(tmp_path / "nothing.zarr")]) == 1
    assert "there is no Zarr v3 group" in capsys.readouterr().err


@pytest.mark.parametrize("form", ["text", "hdf5"])
def test_export_and_import_give_the_same_store_back(store, tmp_path, form):
    if form == "hdf5":
        pytest.importorskip("h5py")
    assert main(["export", str(store), str(tmp_path / "files"), "--format", form]) == 0
    assert main(["import", str(tmp_path / "files"), str(tmp_path / "again.zarr")]) == 0
    files = {path.relative_to(store): path.read_bytes() for path in store.rglob("*") if path.is_file()}
    again = tmp_path / "again.zarr"
    assert files == {path.relative_to(again): path.read_bytes() for path in again.rglob("*") if path.is_file()}


def test_a_folder_that_is_no_project_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["preset", "smoke"]) == 1
    assert "run this inside a polarnet clone" in capsys.readouterr().err
