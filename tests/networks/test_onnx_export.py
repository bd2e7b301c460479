import contextlib
import importlib.util
import io
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import jaxtyping
import onnxruntime
import pytest
import torch

from polarnet.cli import main
from polarnet.config.tree import load
from polarnet.events.representations import event_counts
from polarnet.events.stream import Events
from polarnet.networks import onnx_export
from polarnet.networks.base.checkpoint import save_checkpoint
from polarnet.networks.onnx_export import check_program, random_windows
from polarnet.networks.paper.dolp_unet import DolpUNet, DolpUNetConfig
from polarnet.networks.polarnet.stokes_unet import StokesUNet
from polarnet.networks.registry import load_network

HEIGHT, WIDTH = 30, 44  # neither divides by 8
CONFIGS = {
    "paper": DolpUNetConfig(
        channels=[4, 8, 8], swin_depth=2, swin_window=4, swin_heads=[1, 2], residual_blocks=1, input_mixing="contrasts"
    ),
    "polarnet": replace(
        load(Path(__file__).resolve().parents[2]).networks.polarnet,
        channels=[8, 8, 8],
        memories=[0.0, 0.5],
        decays=[0.9],
        scales=[1, 3, 0],
        panorama_scale=5,
    ),
}
REPRESENTATIONS = {"paper": "event_tensor", "polarnet": "event_counts"}


def save_small(name: str, folder: Path) -> Path:
    """A checkpoint of a small network with random weights everywhere."""
    torch.manual_seed(0)
    config = CONFIGS[name]
    network = DolpUNet(config) if isinstance(config, DolpUNetConfig) else StokesUNet(config)
    tensors = {key: tensor + 0.1 * torch.randn(tensor.shape) for key, tensor in network.state_dict().items()}
    metadata = {
        "network": name,
        "config": asdict(config),
        "in_channels": 4 if name == "paper" else 8,
        "representation": REPRESENTATIONS[name],
        "data": {"events_from": {"scenes": {"synthesize": {"frame_rate_hz": 50.0}}}},
    }
    save_checkpoint(folder / f"{name}.safetensors", tensors, metadata)
    return folder / f"{name}.safetensors"


class Written(NamedTuple):
    """A file that `polarnet onnx` wrote from a checkpoint, and its printed line."""

    path: Path
    checkpoint: Path
    printed: str


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """Without the shape checks of jaxtyping, which make tracing several times slower."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def write_small(name: str, folder: Path) -> Written:
    checkpoint, path = save_small(name, folder), folder / "polarnet.onnx"
    with unchecked(), contextlib.redirect_stdout(io.StringIO()) as printed:
        size = ("--height", str(HEIGHT), "--width", str(WIDTH))
        assert main(["onnx", str(path), "--weights", str(checkpoint), *size]) == 0
    return Written(path, checkpoint, printed.getvalue())


@pytest.fixture(scope="module")
def of_each(tmp_path_factory) -> dict[str, Written]:
    """Tracing takes seconds, so each network is written once."""
    return {name: write_small(name, tmp_path_factory.mktemp(name)) for name in CONFIGS}


@pytest.fixture(params=list(CONFIGS))
def written(request, of_each) -> Written:
    return of_each[request.param]


@pytest.fixture
def small(of_each) -> Path:
    return of_each["polarnet"].checkpoint


@pytest.fixture
def never_traced(monkeypatch):
    """Whatever is refused is refused before the long part."""
    monkeypatch.setattr(onnx_export, "_traced", lambda *_: pytest.fail("traced"))


def program_in(path: Path) -> Callable[..., list[torch.Tensor]]:
    """The function in a file: events and state in, outputs in their order out."""
    session = onnxruntime.InferenceSession(path)
    names = [one.name for one in session.get_inputs()]

    def run(*inputs: torch.Tensor) -> list[torch.Tensor]:
        outputs = session.run(None, dict(zip(names, (each.numpy() for each in inputs), strict=True)))
        return [torch.from_numpy(output) for output in outputs]

    return run


def test_onnx_runtime_gives_what_torch_gives_window_after_window_and_one_weight_that_is_off_is_detected(written):
    equal = "ONNX Runtime's outputs equal torch's within 0.0001"
    assert re.search(rf"polarnet\.onnx, 0\.\d MB; {equal}\n", written.printed)
    network, metadata = load_network(written.checkpoint)
    windows = random_windows(metadata["in_channels"], HEIGHT, WIDTH)
    assert windows[:-1].any()
    check_program(program_in(written.path), network, windows)
    last = network.p1 if hasattr(network, "p1") else network.add
    with torch.no_grad():
        last.bias[0] += 0.001
    with pytest.raises(AssertionError, match=r"not close(?s:.*)item \['(aolp|dolp)'\]"):
        check_program(program_in(written.path), network, windows)


def test_the_file_says_what_it_takes_and_nothing_of_its_machine(written):
    path, checkpoint, _ = written
    session = onnxruntime.InferenceSession(path)
    about = json.loads(session.get_modelmeta().custom_metadata_map["polarnet"])
    metadata = load_network(checkpoint)[1]
    assert about["checkpoint"] == metadata
    assert about["window_us"] == 20_000
    assert about["representation"] == metadata["representation"]
    assert about["events"]["images_of_each"] * 4 == metadata["in_channels"]
    shapes = {"events": about["events"]["shape"], **{one["input"]: one["shape"] for one in about["state"]}}
    assert shapes == {one.name: one.shape for one in session.get_inputs()}
    assert shapes["events"] == [1, metadata["in_channels"], HEIGHT, WIDTH]
    assert [*about["outputs"], *(one["output"] for one in about["state"])] == [o.name for o in session.get_outputs()]
    assert set(path.parent.iterdir()) == {path, checkpoint, checkpoint.with_suffix(".json")}
    assert b".py" not in path.read_bytes()  # nothing of the machine that wrote it


@pytest.mark.parametrize("difference", [0.1, float("nan")])
def test_a_file_that_differs_from_torch_is_not_left_behind(of_each, tmp_path, monkeypatch, capsys, difference):
    right = program_in(of_each["polarnet"].path)

    def wrong(*inputs: torch.Tensor) -> list[torch.Tensor]:
        dolp, *others = right(*inputs)
        return [dolp + difference, *others]

    monkeypatch.setattr(onnx_export, "_traced", lambda *_: (wrong, {}))
    out, weights = tmp_path / "n.onnx", of_each["polarnet"].checkpoint
    size = ("--height", HEIGHT, "--width", WIDTH)
    message = r"not written, because ONNX Runtime does not reproduce torch's outputs: (?s:.*)item \['dolp'\]"
    assert re.search(message, refusal(capsys, out, "--weights", weights, *size))
    assert list(tmp_path.iterdir()) == []
    out.write_bytes(b"an earlier one")
    assert re.search(message, refusal(capsys, out, "--weights", weights, *size))
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [b"an earlier one"]


def refusal(capsys, *arguments: object) -> str:
    """Message with which the command fails."""
    assert main(["onnx", *map(str, arguments)]) == 1
    return capsys.readouterr().err


@pytest.mark.usefixtures("never_traced")
@pytest.mark.parametrize(
    ("out", "arguments", "message"),
    [
        ("n.pt", [], "expected a file NAME.onnx to write, got"),
        ("none/n.onnx", [], "no folder; make it first"),
        ("n.onnx", ["--height", 0], "at least 1 pixel, got 0x180"),
        ("n.onnx", ["--weights", "none.safetensors"], "none.safetensors is missing"),
        ("n.onnx", ["--weights", "best.pth"], "NAME.safetensors, got"),
    ],
)
def test_what_cannot_be_written_is_refused_before_the_work(small, tmp_path, capsys, out, arguments, message):
    assert message in refusal(capsys, tmp_path / out, "--weights", small, *arguments)


@pytest.mark.usefixtures("never_traced")
@pytest.mark.parametrize("absent", ["onnx", "onnxruntime", "onnxscript"])
def test_without_the_packages_the_extra_is_named(small, tmp_path, monkeypatch, capsys, absent):
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == absent else real(name))
    said = refusal(capsys, tmp_path / "n.onnx", "--weights", small)
    assert f"ONNX files need {absent}: run pip install -e '.[export]' in the clone" in said


def test_the_lines_on_the_page_run_as_they_stand(of_each, monkeypatch, project_root):
    monkeypatch.chdir(of_each["polarnet"].path.parent)
    snippet = re.search(r"```python\n(.*?)```", (project_root / "docs" / "network.md").read_text(), re.DOTALL)
    assert snippet is not None
    names: dict = {}
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(snippet[1], names)
    assert len(printed.getvalue().split()) == 2
    assert names["maps"]["dolp"].shape == (1, HEIGHT, WIDTH)

    columns = zip(("x", "y", "polarity"), (torch.int16, torch.int16, torch.int8), strict=True)
    x, y, p = (torch.from_numpy(names[name]).to(dtype) for name, dtype in columns)
    of = [torch.from_numpy(names["polarizer"] == number) for number in range(4)]
    t = torch.arange(len(x))
    images = [event_counts(Events(t[k], x[k], y[k], p[k], HEIGHT, WIDTH), 33_333) for k in of]
    assert torch.equal(torch.cat(images), torch.from_numpy(names["events"][0]))
