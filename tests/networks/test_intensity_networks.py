"""E2VID, FireNet and CISTA-TC: published sizes, published files, windows in order."""

import numpy as np
import pytest
import torch

from polarnet.networks.cista_tc.network import CistaTc
from polarnet.networks.e2v.network import ConvLstm, E2vid, FireNet, reflected


def official_tensors():
    """Names and shapes of E2VID_lightweight.pth.tar, written out from the authors' public code, filled at random."""
    generator = torch.Generator().manual_seed(0)
    shapes = {"head.conv2d.weight": (32, 5, 5, 5), "head.conv2d.bias": (32,)}

    def normalised(name, channels):
        for part in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{name}.{part}"] = (channels,)
        shapes[f"{name}.num_batches_tracked"] = ()

    for i, (inputs, outputs) in enumerate([(32, 64), (64, 128), (128, 256)]):
        shapes[f"encoders.{i}.conv.conv2d.weight"] = (outputs, inputs, 5, 5)
        normalised(f"encoders.{i}.conv.norm_layer", outputs)
        shapes[f"encoders.{i}.recurrent_block.Gates.weight"] = (4 * outputs, 2 * outputs, 3, 3)
        shapes[f"encoders.{i}.recurrent_block.Gates.bias"] = (4 * outputs,)
    for i in range(2):
        for part in (1, 2):
            shapes[f"resblocks.{i}.conv{part}.weight"] = (256, 256, 3, 3)
            normalised(f"resblocks.{i}.bn{part}", 256)
    for i, (inputs, outputs) in enumerate([(256, 128), (128, 64), (64, 32)]):
        shapes[f"decoders.{i}.transposed_conv2d.weight"] = (inputs, outputs, 5, 5)
        normalised(f"decoders.{i}.norm_layer", outputs)
    shapes["pred.conv2d.weight"] = (1, 32, 1, 1)
    normalised("pred.norm_layer", 1)
    return {
        f"unetrecurrent.{name}": 0.1 * torch.rand(shape, generator=generator) if shape else torch.tensor(7)
        for name, shape in shapes.items()
    }


def test_the_official_file_loads_and_every_tensor_is_where_it_belongs(tmp_path):
    theirs = official_tensors()
    torch.save({"arch": "E2VIDRecurrent", "model": {"num_bins": 5}, "state_dict": theirs}, tmp_path / "x.pth.tar")
    network = E2vid.load(tmp_path / "x.pth.tar")
    own = network.state_dict()
    assert {f"unetrecurrent.{name}" for name in own} == set(theirs)
    assert all(torch.equal(own[name], theirs[f"unetrecurrent.{name}"]) for name in own)
    assert (network.bins, network.training) == (5, False)


CONCATENATED = {  # another version of E2VID, whose decoders take the skip connections beside their inputs
    name: torch.cat([tensor, tensor]) if "transposed" in name else tensor for name, tensor in official_tensors().items()
}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"state_dict": CONCATENATED}, r"(?s)published size.*decoders\.0\.transposed_conv2d"),
        ({"state_dict": dict(list(official_tensors().items())[:-6])}, r"(?s)published size.*pred\.conv2d\.weight"),
        ({"weight": torch.zeros(1)}, r"x\.pth holds no E2VID: expected a tensor head\.conv2d\.weight"),
        ([1, 2], r"x\.pth holds no E2VID: expected a tensor head\.conv2d\.weight"),
    ],
)
def test_the_file_of_another_network_is_refused(tmp_path, content, message):
    torch.save(content, tmp_path / "x.pth")
    with pytest.raises(ValueError, match=message):
        E2vid.load(tmp_path / "x.pth")


@pytest.mark.parametrize("wrap", [lambda tensors: tensors, lambda tensors: {"state_dict": tensors}])
def test_a_file_gives_the_weights_and_the_number_of_bins(tmp_path, wrap):
    torch.save(wrap(FireNet(3).state_dict()), tmp_path / "x.pth")
    assert FireNet.load(tmp_path / "x.pth").bins == 3


@pytest.mark.shared
@torch.no_grad()
def test_cistas_published_weights_give_the_images_of_the_authors_network(shared):
    network = CistaTc.load(shared / "weights" / "cista_tc.pth.tar")
    assert sum(tensor.numel() for tensor in network.state_dict().values()) == 1_260_867
    with np.load(shared / "weights" / "cista_tc_check.npz") as check:
        voxels, images = torch.from_numpy(check["voxels"]), torch.from_numpy(check["images"])
    frames, _ = network.unroll(voxels[:, None])
    torch.testing.assert_close(frames[:, 0], images, atol=1e-5, rtol=0)


@pytest.mark.shared
@pytest.mark.parametrize("name", ["firenet_1000.pth.tar", "firenetplus_state_dict.pth"])
@torch.no_grad()
def test_published_firenets_brighten_where_events_are_on(shared, name):
    """An edge that moves right and fires ON events behind it: the events' side becomes brighter than the other."""
    network = FireNet.load(shared / "weights" / name)
    voxels = torch.zeros(10, 1, 5, 24, 32)
    for k in range(10):
        voxels[k, :, :, :, 3 + k : 5 + k] = 1.0
    frames, _ = network.unroll(voxels)
    assert frames[-1, 0, :, 4:12].mean() > frames[-1, 0, :, 20:].mean()


def test_sides_are_reflected_up_to_multiples_of_8_more_above_than_below():
    ramp = torch.arange(13.0).view(1, 1, 13, 1).expand(1, 1, 13, 16)
    top, left, padded = reflected(ramp)
    assert (top, left) == (2, 0)
    assert padded[0, 0, :, 0].tolist() == [2, 1, *range(13), 11]


@torch.no_grad()
def test_an_lstm_whose_forget_gate_is_open_and_input_gate_shut_keeps_its_memory():
    lstm = ConvLstm(2)
    torch.nn.init.zeros_(lstm.Gates.weight)
    lstm.Gates.bias.copy_(torch.tensor([-100.0, -100, 100, 100, 100, 100, 0, 0]))  # i, f, o, g
    memory = torch.rand(1, 2, 3, 3)
    output, memory_after = lstm(torch.rand(1, 2, 3, 3), (torch.zeros(1, 2, 3, 3), memory))
    torch.testing.assert_close(memory_after, memory)
    torch.testing.assert_close(output, memory.tanh())
