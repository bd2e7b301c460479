"""A short test sequence, and every method with networks that nobody trained (fixture `checkpoints`)."""

from pathlib import Path

import pytest
import torch

from polarnet.benchmark.rows import Context
from polarnet.benchmark.sequences import TestSequence
from polarnet.config.tree import load
from polarnet.events.rotation import steady_rotation
from polarnet.events.stream import Events
from polarnet.methods import METHODS, ROWS
from polarnet.methods.complementary_filter import FilterConfig
from polarnet.methods.method import GainConfig, Setup
from polarnet.methods.rotating_polarizer import RotatingPolarizerConfig
from polarnet.networks.base.checkpoint import save_checkpoint
from polarnet.networks.cista_tc.network import CistaTc
from polarnet.networks.e2p.network import E2p
from polarnet.networks.e2v.network import E2vid, FireNet
from polarnet.networks.paper.dolp_unet import DolpUNet, DolpUNetConfig

HEIGHT, WIDTH = 18, 20
WINDOW_US = 1000
NETWORK = {
    "channels": [4, 8, 8],
    "swin_depth": 2,
    "swin_window": 4,
    "swin_heads": [2, 2],
    "residual_blocks": 1,
}
SECTIONS = {
    "cf": FilterConfig(0.5, 0.0, 0.1, -0.1, [-0.1, 1.2]),
    "highpass": FilterConfig(0.06, 0.06, 0.1, -0.1, [-0.5, 1.5]),
    "rotating_polarizer": RotatingPolarizerConfig(0.2, 0.2, 300.0, 60.0, 0.01, 0.1, 5, 1.3, 0.0026),
}
WITH_WEIGHTS_HERE = [name for name in ROWS if name != "registered"]  # which needs network polarnet
REGISTRATION = load(Path(__file__).resolve().parents[1]).methods.registration


def random_events(generator, windows=4, count=300):
    """Events of one polarizer over the whole sensor."""
    t = torch.randint(windows * WINDOW_US, (count,), generator=generator).sort().values
    x = torch.randint(WIDTH, (count,), generator=generator).to(torch.int16)
    y = torch.randint(HEIGHT, (count,), generator=generator).to(torch.int16)
    p = (2 * torch.randint(2, (count,), generator=generator) - 1).to(torch.int8)
    return Events(t, x, y, p, HEIGHT, WIDTH)


@pytest.fixture(scope="session")
def make_sequence():
    def make(name="a", scene=None, windows=4, seed=0):
        generator = torch.Generator().manual_seed(seed)
        dolp, s0 = torch.rand(2, windows, HEIGHT, WIDTH, generator=generator)
        return TestSequence(
            name,
            scene or name,
            [random_events(generator, windows) for _ in range(4)],
            WINDOW_US * torch.arange(windows + 1),
            dolp,
            3.1 * torch.rand(windows, HEIGHT, WIDTH, generator=generator),
            s0,
            rotating=random_events(torch.Generator().manual_seed(1 + seed), windows, 4000),
        )

    return make


@pytest.fixture
def sequence(make_sequence):
    return make_sequence()


def write_checkpoints(folder):
    """Networks that nobody trained, by section, in files as the training stages write them and as their authors did."""
    torch.manual_seed(0)
    metadata = {"network": "paper", "config": NETWORK, "in_channels": 4, "representation": "event_tensor"}
    files = {}
    for name in ("ours", "paper"):
        files[name] = folder / f"{name}.safetensors"
        save_checkpoint(files[name], DolpUNet(DolpUNetConfig(**NETWORK)).state_dict(), metadata)
    for name, build in {"firenet": FireNet, "e2vid": E2vid, "e2p": E2p}.items():
        files[name] = folder / f"{name}.safetensors"
        save_checkpoint(files[name], build(5).state_dict(), {"network": name, "config": {"bins": 5}, "in_channels": 5})
    files["e2v"] = files["firenet"]
    for name, build in {"firenet": FireNet, "firenetplus": FireNet, "e2vid": E2vid, "e2p": E2p}.items():
        files[f"{name}_published"] = folder / f"{name}.pth.tar"
        torch.save({"state_dict": build(5).state_dict()}, files[f"{name}_published"])
    files["cista_tc"] = folder / "cista_tc.pth.tar"
    torch.save({"state_dict": CistaTc(5).state_dict()}, files["cista_tc"])
    return files


@pytest.fixture(scope="session")
def make_setup(checkpoints):
    """The setup of a section, with changes."""

    def make(section, **changes):
        values = {
            "config": SECTIONS.get(section),
            "weights": checkpoints.get(section),
            "gain": GainConfig(10, 5, 20_000, 0.1, 0.0),
            "registration": REGISTRATION,
            "device": torch.device("cpu"),
            "precision": "fp32",
            "rotation": steady_rotation(500.0),
        }
        return Setup(**{**values, **changes})

    return make


@pytest.fixture(scope="session")
def make_context(make_setup):
    """All methods; `changes` are those of the setups of some sections."""

    def make(train_mean=0.25, **changes):
        sections = [method.section for method in METHODS.values()]
        setups = {section: make_setup(section, **changes.get(section, {})) for section in sections}
        return Context(train_mean, setups, torch.device("cpu"))

    return make


@pytest.fixture
def context(make_context):
    return make_context()
