from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from test_dolp_unet import SMALL

from polarnet.networks.base.checkpoint import load_checkpoint, save_checkpoint
from polarnet.networks.paper.dolp_unet import DolpUNet
from polarnet.networks.registry import load_network
from polarnet.runtime.files import SUMS, seal


@pytest.fixture
def saved(tmp_path: Path) -> tuple[Path, DolpUNet]:
    """A checkpoint of a new network, and that network."""
    network = DolpUNet(SMALL, in_channels=8).eval()
    metadata = {"network": "paper", "config": asdict(SMALL), "in_channels": 8, "representation": "voxel_grid"}
    save_checkpoint(tmp_path / "n.safetensors", network.state_dict(), metadata)
    return tmp_path / "n.safetensors", network


@torch.no_grad()
def test_a_network_comes_back_from_its_checkpoint(saved):
    path, network = saved
    loaded, metadata = load_network(path)
    assert metadata["representation"] == "voxel_grid"
    assert not loaded.training
    events = torch.randn(1, 8, 12, 16)
    assert torch.equal(loaded(events)[0].dolp, network(events)[0].dolp)


DAMAGES = {
    "half": (
        lambda path: path.with_suffix(".json").unlink(),
        r"n\.json is missing; a checkpoint is NAME\.safetensors and",
    ),
    "other": (lambda path: path.write_bytes(path.read_bytes()[:-1] + b"?"), r"is not the file that n\.json describes"),
    "list": (lambda path: path.with_suffix(".json").write_text("[1, 2]"), "expected a polarnet-checkpoint-2"),
    "cut": (lambda path: path.with_suffix(".json").write_text("{"), "is not JSON"),
    "deep": (lambda path: path.with_suffix(".json").write_text("[" * 10**5), "is not JSON"),
    "long": (lambda path: path.with_suffix(".json").write_text("9" * 5000), "is not JSON"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_pair_that_is_damaged_is_refused(saved, damage):
    change, message = DAMAGES[damage]
    change(saved[0])
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load_network(saved[0])


def test_every_digit_is_covered_by_a_hash_and_a_seal_must_vouch_for_both_files(saved, tmp_path):
    record = saved[0].with_suffix(".json")
    text = record.read_text()
    for place in (place for place, letter in enumerate(text) if letter.isdigit()):
        record.write_text(text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :])
        with pytest.raises(ValueError):
            load_checkpoint(saved[0])
    record.write_text(text)
    (saved[0].parent / SUMS).touch()
    with pytest.raises(ValueError, match=r"n\.json is not in .*SHA256SUMS"):
        load_checkpoint(saved[0])
    seal(saved[0].parent)
    load_checkpoint(saved[0])
    torch.save({"a": torch.zeros(1)}, tmp_path / "n.pth")
    with pytest.raises(ValueError, match=r"NAME\.safetensors, got .*n\.pth"):
        load_checkpoint(tmp_path / "n.pth")


@pytest.mark.parametrize("value", [float("nan"), float("-inf")])
def test_weights_that_are_not_finite_are_refused_by_name(saved, value):
    tensors, metadata = load_checkpoint(saved[0])
    tensors["p1.bias"][0] = value
    save_checkpoint(saved[0], tensors, metadata)
    with pytest.raises(ValueError, match=r"n\.safetensors: expected finite weights, p1\.bias has NaN or infinity"):
        load_network(saved[0])


OTHER_CONFIG = {key: value for key, value in asdict(SMALL).items() if key != "swin_depth"} | {"layers": 3}


@pytest.mark.parametrize(("changes", "message"), [
    ({"network": "firenet"}, "holds a 'firenet'; expected a DoLP network, one of paper"),
    ({"config": OTHER_CONFIG}, r"(?s)another version of networks\.paper: .*(layers.*swin_depth|swin_depth.*layers)"),
    ({"network": []}, r"\.json: expected the name of a network and its config"),
    ({"config": None}, r"\.json: expected the name of a network and its config"),
    ({"config": OTHER_CONFIG | {"c": 1}}, r"\.json: config of another version of .*: .*; .*; train again$"),
    ({"representation": []}, r"\.json: expected in_channels of 1 to 1024 and a representation of event_tensor"),
    ({"data": []}, r"\.json: config of another .*: data: expected a record of the training, got '\[\]'"),
    ({"data": {"events_from": {"scenes": None}}}, r"scenes: expected a record of the training, got 'None'"),
    *(({"data": {"events_from": {"scenes": {"synthesize": {"frame_rate_hz": rate}}}}}, "frame_rate_hz: expected 0.001")
      for rate in (0, -30, "30", float("inf"), [1], 1e-300)),
    ({"in_channels": 4}, r"c1\.weight should be \(4, 4, 3, 3\) .*, is \(4, 8, 3, 3\) .* \(1 tensors"),
])  # fmt: skip
def test_a_checkpoint_of_another_network_is_refused_with_what_differs(saved, changes, message):
    tensors, metadata = load_checkpoint(saved[0])
    save_checkpoint(saved[0], tensors, metadata | changes)
    with pytest.raises(ValueError, match=message):
        load_network(saved[0])
    save_checkpoint(saved[0], tensors | {"c1.weight": tensors["c1.weight"].half()}, metadata)
    with pytest.raises(ValueError, match=r"c1\.weight should be .* torch\.float32, is .* torch\.float16"):
        load_network(saved[0])
