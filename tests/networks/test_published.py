import pytest
import torch
from torch import nn

from polarnet.networks.base.published import PublishedNetwork


class Counter(PublishedNetwork):
    """Adds up its windows, times one weight for each bin."""

    label = "Counter"
    first_layer = "weight"

    def __init__(self, bins: int):
        super().__init__(bins)
        self.weight = nn.Parameter(torch.ones(1, bins))

    def forward(self, voxels, state=None):
        self.check_bins(voxels)
        total = (voxels * self.weight.view(1, -1, 1, 1)).sum(1) + (0 if state is None else state[0])
        return total, [total]

    @classmethod
    def own_names(cls, tensors):
        return {name.removeprefix("theirs."): tensor for name, tensor in tensors.items()}


@torch.no_grad()
def test_windows_pass_their_state_on():
    frames, state = Counter(2).unroll(torch.ones(3, 1, 2, 4, 5))
    assert frames[:, 0, 0, 0].tolist() == [2, 4, 6]
    assert torch.equal(state[0], frames[-1])


@pytest.mark.parametrize("wrap", [lambda tensors: tensors, lambda tensors: {"state_dict": tensors}])
def test_a_file_gives_the_weights_and_the_number_of_bins(tmp_path, wrap):
    torch.save(wrap({"theirs.weight": torch.tensor([[1.0, 2.0, 3.0]])}), tmp_path / "x.pth")
    network = Counter.load(tmp_path / "x.pth")
    assert (network.bins, network.training) == (3, False)
    assert network.weight.tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize("content", [{"bias": torch.zeros(1)}, [1, 2]])
def test_a_file_of_something_else_is_refused_with_the_tensor_that_it_lacks(tmp_path, content):
    torch.save(content, tmp_path / "x.pth")
    with pytest.raises(ValueError, match=r"x\.pth holds no Counter: expected a tensor weight"):
        Counter.load(tmp_path / "x.pth")


def test_another_number_of_bins_is_refused():
    with pytest.raises(ValueError, match="this Counter takes 2 bins, got 3"):
        Counter(2)(torch.zeros(1, 3, 4, 5))
