import pytest
import torch

from polarnet.baselines.complementary_filter import ComplementaryFilterConfig, HighPassConfig
from polarnet.baselines.e2p import E2p
from polarnet.baselines.e2vid import E2vid
from polarnet.baselines.firenet import FireNet
from polarnet.baselines.postprocessing import PostprocessingConfig
from polarnet.baselines.stokes_gain import GainConfig
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


@pytest.fixture(scope="session")
def checkpoints(tmp_path_factory):
    """Networks that nobody trained, in files as the training stages write them and as their authors did."""
    folder = tmp_path_factory.mktemp("checkpoints")
    torch.manual_seed(0)
    metadata = {"network": "paper", "config": NETWORK, "in_channels": 4, "representation": "event_tensor"}
    files = {}
    for row in ("ours", "paper"):
        files[f"{row}_checkpoint"] = folder / f"{row}.safetensors"
        save_checkpoint(folder / f"{row}.safetensors", DolpUNet(DolpUNetConfig(**NETWORK)).state_dict(), metadata)
    for row, build in {"firenet": FireNet, "e2vid": E2vid, "e2p": E2p}.items():
        files[f"{row}_checkpoint"] = folder / f"{row}.safetensors"
        description = {"network": row, "config": {"bins": 5}, "in_channels": 5}
        save_checkpoint(folder / f"{row}.safetensors", build(5).state_dict(), description)
    files["e2v_checkpoint"] = files["firenet_checkpoint"]
    for row, build in {"firenet": FireNet, "firenetplus": FireNet, "e2vid": E2vid}.items():
        files[f"{row}_published_checkpoint"] = folder / f"{row}.pth.tar"
        torch.save({"state_dict": build(5).state_dict()}, folder / f"{row}.pth.tar")
    return files


@pytest.fixture
def context(checkpoints):
    return Context(
        train_mean=0.25,
        cf=ComplementaryFilterConfig(0.5, 0.1, -0.1, [-0.1, 1.2], "fixed"),
        highpass=HighPassConfig(0.06, 0.06, 0.1, -0.1, [-0.5, 1.5], "fixed"),
        postprocessing=PostprocessingConfig(0.3, 1.0, False, 10, False),
        gain=GainConfig(10, 5, 20_000, 0.1, 0.0),
        **checkpoints,
        device=torch.device("cpu"),
        precision="fp32",
    )
