import pytest
import torch

from polarnet.networks.e2v.e2vid import ConvLstm, E2vid, reflected


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


def official_file(path, **model):
    settings = {"num_bins": 5, "skip_type": "sum", "num_encoders": 3, "base_num_channels": 32, "norm": "BN",
                "num_residual_blocks": 2, "recurrent_block_type": "convlstm", "use_upsample_conv": False}  # fmt: skip
    torch.save({"arch": "E2VIDRecurrent", "model": settings | model, "state_dict": official_tensors()}, path)
    return path


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return E2vid(5).eval()


def test_it_has_the_published_number_of_parameters(network):
    assert sum(p.numel() for p in network.parameters()) == 10_712_098


def test_the_official_file_loads_and_every_tensor_is_where_it_belongs(tmp_path):
    network = E2vid.load(official_file(tmp_path / "E2VID_lightweight.pth.tar"))
    own, theirs = network.state_dict(), official_tensors()
    assert {f"unetrecurrent.{name}" for name in own} == set(theirs)
    assert all(torch.equal(own[name], theirs[f"unetrecurrent.{name}"]) for name in own)
    assert network.bins == 5
    assert not network.training


@pytest.mark.parametrize("setting", [{"use_upsample_conv": True}, {"recurrent_block_type": "convgru"}])
def test_the_file_of_another_e2vid_is_refused(tmp_path, setting):
    with pytest.raises(ValueError, match=r"holds another E2VID: .*E2VID_lightweight.pth.tar"):
        E2vid.load(official_file(tmp_path / "other.pth.tar", **setting))


def test_a_file_without_a_tensor_or_of_something_else_is_refused(tmp_path):
    tensors = official_tensors()
    del tensors["unetrecurrent.pred.conv2d.weight"]
    torch.save({"state_dict": tensors}, tmp_path / "a.pth")
    with pytest.raises(ValueError, match=r"(?s)published size.*pred\.conv2d\.weight"):
        E2vid.load(tmp_path / "a.pth")
    torch.save({"weight": torch.zeros(1)}, tmp_path / "b.pth")
    with pytest.raises(ValueError, match="holds no E2VID"):
        E2vid.load(tmp_path / "b.pth")
    torch.save({"arch": "FireNet", "state_dict": tensors}, tmp_path / "c.pth")
    with pytest.raises(ValueError, match="its arch is 'FireNet'"):
        E2vid.load(tmp_path / "c.pth")


@torch.no_grad()
def test_windows_at_once_are_windows_one_by_one_with_the_state_carried(network):
    torch.manual_seed(1)
    windows, state = torch.randn(3, 2, 5, 18, 20), None
    together, last = network.unroll(windows)
    for window, expected in zip(windows, together, strict=True):
        frame, state = network(window, state)
        assert torch.equal(frame, expected)
    assert all(torch.equal(a, b) for a, b in zip(last, state, strict=True))
    assert together.shape == (3, 2, 18, 20)
    assert 0 < together.min() < together.max() < 1


@torch.no_grad()
def test_a_remembered_state_matters(network):
    window = torch.randn(1, 5, 16, 16)
    first, state = network(window)
    assert not torch.allclose(network(window, state)[0], first)


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
