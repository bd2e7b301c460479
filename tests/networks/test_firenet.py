import pytest
import torch

from polarnet.networks.e2v.firenet import ConvGRU, FireNet


def test_it_has_the_published_number_of_parameters():
    assert sum(p.numel() for p in FireNet(bins=5).parameters()) == 37_777


@torch.no_grad()
def test_windows_at_once_are_windows_one_by_one_with_the_state_carried():
    torch.manual_seed(0)
    network, windows, state = FireNet(bins=5), torch.randn(4, 2, 5, 7, 9), None
    together, last = network.unroll(windows)
    for window, expected in zip(windows, together, strict=True):
        frame, state = network(window, state)
        assert torch.equal(frame, expected)
    assert all(torch.equal(a, b) for a, b in zip(last, state, strict=True))


@torch.no_grad()
def test_a_gru_that_always_updates_forgets_its_state():
    gru = ConvGRU(16)
    torch.nn.init.constant_(gru.update_gate.bias, 100.0)
    torch.nn.init.constant_(gru.reset_gate.bias, -100.0)
    x = torch.randn(1, 16, 5, 5)
    torch.testing.assert_close(gru(x, torch.randn(1, 16, 5, 5)), gru(x, None))


@pytest.mark.shared
@pytest.mark.parametrize("name", ["firenet_1000.pth.tar", "firenetplus_state_dict.pth"])
@torch.no_grad()
def test_published_weights_load(shared, name):
    network = FireNet.load(shared / "weights" / name)
    assert network.bins == 5
    frames, _ = network.unroll(torch.zeros(2, 1, 5, 16, 16))
    assert frames.isfinite().all()


@pytest.mark.shared
@torch.no_grad()
def test_published_firenet_brightens_where_events_are_on(shared):
    """An edge that moves right and fires ON events behind it: the events' side becomes brighter than the other."""
    network = FireNet.load(shared / "weights" / "firenet_1000.pth.tar")
    voxels = torch.zeros(10, 1, 5, 24, 32)
    for k in range(10):
        voxels[k, :, :, :, 3 + k : 5 + k] = 1.0
    frames, _ = network.unroll(voxels)
    assert frames[-1, 0, :, 4:12].mean() > frames[-1, 0, :, 20:].mean()
