import pytest
import torch

from polarnet.baselines.complementary_filter import ComplementaryFilterConfig, HighPassConfig
from polarnet.baselines.firenet import FireNet
from polarnet.evaluation.methods import Context, Recording
from polarnet.events.stream import Events
from polarnet.networks.checkpoint import save_checkpoint
from polarnet.networks.dolp_unet import DolpUNet, DolpUNetConfig

HEIGHT, WIDTH = 18, 20
WINDOW_US = 1000
NETWORK = {
    "channels": [4, 8, 8],
    "swin_depth": 2,
    "swin_window": 4,
    "swin_heads": [2, 2],
    "residual_blocks": 1,
    "input_mixing": "contrasts",
}


def random_events(generator, windows=4, count=300):
    """Events of one polarizer over the whole sensor."""
    t = torch.randint(windows * WINDOW_US, (count,), generator=generator).sort().values
    x = torch.randint(WIDTH, (count,), generator=generator).to(torch.int16)
    y = torch.randint(HEIGHT, (count,), generator=generator).to(torch.int16)
    p = (2 * torch.randint(2, (count,), generator=generator) - 1).to(torch.int8)
    return Events(t, x, y, p, HEIGHT, WIDTH)


@pytest.fixture
def make_recording():
    def make(name="a", scene=None, windows=4, seed=0):
        generator = torch.Generator().manual_seed(seed)
        dolp, s0 = torch.rand(2, windows, HEIGHT, WIDTH, generator=generator)
        return Recording(
            name,
            scene or name,
            [random_events(generator, windows) for _ in range(4)],
            WINDOW_US * torch.arange(windows + 1),
            dolp,
            3.1 * torch.rand(windows, HEIGHT, WIDTH, generator=generator),
            s0,
        )

    return make


@pytest.fixture
def recording(make_recording):
    return make_recording()


@pytest.fixture
def context(tmp_path):
    """Networks that nobody trained, in checkpoints as the training stages write them."""
    torch.manual_seed(0)
    network = DolpUNet(DolpUNetConfig(**NETWORK))
    metadata = {"network": "paper", "config": NETWORK, "in_channels": 4, "representation": "event_tensor"}
    save_checkpoint(tmp_path / "ours.safetensors", network.state_dict(), metadata)
    save_checkpoint(
        tmp_path / "e2v.safetensors", FireNet(5).state_dict(), {"network": "firenet", "config": {"bins": 5}}
    )
    return Context(
        train_mean=0.25,
        cf=ComplementaryFilterConfig(0.5, 0.1, -0.1, [-0.1, 1.2]),
        highpass=HighPassConfig(0.06, 0.06, 0.1, -0.1, [-0.5, 1.5]),
        e2v_checkpoint=tmp_path / "e2v.safetensors",
        ours_checkpoint=tmp_path / "ours.safetensors",
        device=torch.device("cpu"),
        precision="fp32",
    )
