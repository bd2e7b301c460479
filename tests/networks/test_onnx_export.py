import contextlib
import importlib.util
import io
import json
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import jaxtyping
import onnxruntime
import pytest
import torch
from test_dolp_unet import SMALL

from polarnet.cli import main
from polarnet.config.tree import load
from polarnet.events.representations import event_counts
from polarnet.events.stream import Events
from polarnet.networks import load_network, onnx_export
from polarnet.networks.base.checkpoint import save_checkpoint
from polarnet.networks.onnx_export import check_program, random_windows
from polarnet.networks.paper.dolp_unet import DolpUNet
from polarnet.networks.polarnet.stokes_unet import StokesUNet

HEIGHT, WIDTH = 30, 44  # neither divides by 8
POLARNET = replace(
    load(Path(__file__).resolve().parents[2]).networks.polarnet,
    channels=[8, 8, 8], memories=[0.0, 0.5], decays=[0.9], scales=[1, 3, 0], panorama_scale=5,
)  # fmt: skip
SIZE = ("--height", HEIGHT, "--width", WIDTH)


class Written(NamedTuple):
    """A file that `polarnet onnx` wrote from a checkpoint, and its printed line."""

    path: Path
    checkpoint: Path
    printed: str


def save_small(name: str, folder: Path) -> Path:
    """A checkpoint of a small network with random weights everywhere."""
    torch.manual_seed(0)
    network = DolpUNet(SMALL) if name == "paper" else StokesUNet(POLARNET)
    tensors = {key: tensor + 0.1 * torch.randn(tensor.shape) for key, tensor in network.state_dict().items()}
    metadata = {
        "network": name,
        "config": asdict(SMALL if name == "paper" else POLARNET),
        "in_channels": 4 if name == "paper" else 8,
        "representation": network.representation,
        "data": {"events_from": {"scenes": {"synthesize": {"frame_rate_hz": 50.0}}}},
    }
    save_checkpoint(folder / f"{name}.safetensors", tensors, metadata)
    return folder / f"{name}.safetensors"


@pytest.fixture(scope="module", params=["paper", "polarnet"])
def written(request, tmp_path_factory) -> Written:
    """Tracing takes seconds, so each network is written once, without the shape checks, which make it slower."""
    folder = tmp_path_factory.mktemp(request.param)
    checkpoint, path = save_small(request.param, folder), folder / "polarnet.onnx"
    jaxtyping.config.update("jaxtyping_disable", True)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["onnx", str(path), "--weights", str(checkpoint), *map(str, SIZE)]) == 0
    jaxtyping.config.update("jaxtyping_disable", False)
    return Written(path, checkpoint, printed.getvalue())


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


@pytest.mark.thorough
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


@pytest.mark.thorough
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


@pytest.mark.thorough
@pytest.mark.parametrize("difference", [0.1, float("nan")])
def test_a_file_that_differs_from_torch_is_not_left_behind(written, tmp_path, monkeypatch, capsys, difference):
    right = program_in(written.path)

    def wrong(*inputs: torch.Tensor) -> list[torch.Tensor]:
        dolp, *others = right(*inputs)
        return [dolp + difference, *others]

    monkeypatch.setattr(onnx_export, "_traced", lambda *_: (wrong, {}))
    message = r"not written, because ONNX Runtime does not reproduce torch's outputs: (?s:.*)item \['dolp'\]"
    for before in ([], [b"an earlier one"]):
        for content in before:
            (tmp_path / "n.onnx").write_bytes(content)
        assert re.search(message, refusal(capsys, tmp_path / "n.onnx", "--weights", written.checkpoint, *SIZE))
        assert [file.read_bytes() for file in tmp_path.iterdir()] == before


def refusal(capsys, *arguments: object) -> str:
    """Message with which the command fails."""
    assert main(["onnx", *map(str, arguments)]) == 1
    return capsys.readouterr().err


@pytest.mark.usefixtures("never_traced")
@pytest.mark.parametrize(("out", "arguments", "message"), [
    ("n.pt", [], "expected a file NAME.onnx to write, got"),
    ("none/n.onnx", [], "no folder; make it first"),
    ("n.onnx", ["--height", 0], "at least 1 pixel, got 0x180"),
    ("n.onnx", ["--weights", "none.safetensors"], "none.safetensors: there is no such file or folder"),
    ("n.onnx", ["--weights", "best.pth"], "NAME.safetensors, got"),
])  # fmt: skip
def test_what_cannot_be_written_is_refused_before_the_work(tmp_path, monkeypatch, capsys, out, arguments, message):
    small = save_small("polarnet", tmp_path)
    (tmp_path / "best.pth").touch()
    monkeypatch.chdir(tmp_path)
    assert message in refusal(capsys, tmp_path / out, "--weights", small, *arguments)


@pytest.mark.usefixtures("never_traced")
def test_without_the_packages_the_extra_is_named(tmp_path, monkeypatch, capsys):
    real, small = importlib.util.find_spec, save_small("polarnet", tmp_path)
    for absent in ("onnx", "onnxruntime", "onnxscript"):
        monkeypatch.setattr(importlib.util, "find_spec", lambda name, no=absent: None if name == no else real(name))
        said = refusal(capsys, tmp_path / "n.onnx", "--weights", small)
        assert f"ONNX files need {absent}: run pip install -e '.[export]' in the clone" in said


@pytest.mark.thorough
@pytest.mark.parametrize("written", ["polarnet"], indirect=True)
def test_the_lines_on_the_page_run_as_they_stand(written, monkeypatch, project_root):
    monkeypatch.chdir(written.path.parent)
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
