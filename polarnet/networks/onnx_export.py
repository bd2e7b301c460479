"""Export of a DoLP network to ONNX: one window of one stream, with the state as named inputs and outputs.

The metadata of the file describes its inputs and outputs as JSON, so a program can run it with ONNX Runtime alone.
"""

import importlib.util
import inspect
import json
import logging
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from polarnet.events.representations import REPRESENTATIONS, channels_of
from polarnet.networks.base.checkpoint import trained_window_us
from polarnet.runtime.files import replaced
from polarnet.stokes import POLARIZER_ANGLES_DEG, Prediction
from polarnet.terminal.installation import installation

FORMAT = "polarnet-onnx-1"
KEY = "polarnet"  # key of the JSON in the file's metadata_props
OPSET = 20  # the first opset with GELU as one operator
TOLERANCE = 1e-4  # absolute and relative difference of an output from torch's, far above that of float32 rounding
CHECKED_WINDOWS = 5  # windows with events; one empty window follows
MAX_VALUE = 3  # largest absolute value in a random input image
SEED = 0
MEANINGS = {
    "dolp": "degree of linear polarization, not clamped to [0, 1]",
    "aolp": "angle of linear polarization, radians in [0, pi)",
    "log_variance": "logarithm of the expected squared error of dolp",
    "stokes": "S1 / S0 and S2 / S0, of which aolp is the angle",
}
"""Descriptions in the file of the fields of `Prediction`."""


class OneWindow(nn.Module):
    """Wrapper that passes the state of a network as separate tensors, as an ONNX graph requires."""

    def __init__(self, network: nn.Module):
        super().__init__()
        self.network = network

    def forward(self, events: Float[Tensor, "1 c h w"], *state: Tensor) -> tuple[Tensor, ...]:
        """Return the values of `outputs_by_name`."""
        return tuple(outputs_by_name(*self.network(events, list(state))).values())


def outputs_by_name(prediction: Prediction, state: Sequence[Tensor]) -> dict[str, Tensor]:
    """Predicted maps by their names in `Prediction`, then the new state as new_state_0, new_state_1, ..."""
    predicted = {name: field for name, field in prediction._asdict().items() if field is not None}
    return predicted | {f"new_state_{number}": tensor for number, tensor in enumerate(state)}


def export_network(
    network: nn.Module, metadata: Mapping[str, Any], path: str | os.PathLike[str], height: int, width: int
) -> None:
    """Write the result of `load_network` to `path` (.onnx) for one image size, once it passes `check_program`.

    The file contains the weights, and the same network gives the same bytes. ValueError for a size below one pixel or
    another suffix, FileNotFoundError without the folder of `path`, RuntimeError if packages are missing or the check
    fails; an existing file is then unchanged.
    """
    for name in ("onnx", "onnxruntime", "onnxscript"):
        if importlib.util.find_spec(name) is None:
            raise RuntimeError(f"ONNX files need {name}: {installation('export')}")
    path = Path(path)
    if path.suffix != ".onnx" or path.is_dir():
        raise ValueError(f"expected a file NAME.onnx to write, got {path}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent} is no folder; make it first, or write {path.name} somewhere else")
    if min(height, width) < 1:
        raise ValueError(f"expected a height and a width of at least 1 pixel, got {height}x{width}")
    windows = random_windows(metadata["in_channels"], height, width)
    program, description = _traced(network, metadata, windows[0])
    try:
        check_program(program, network, windows)
    except Exception as error:  # from torch.testing or ONNX Runtime, whose errors share no other base class
        raise RuntimeError(
            f"{path} is not written, because ONNX Runtime does not reproduce torch's outputs: {error}\n"
            f"Use the versions of torch, onnxscript and onnxruntime in constraints.txt"
        ) from None
    with replaced(path) as temporary:
        temporary.write_bytes(_file_content(program, description))


@torch.no_grad()
def check_program(
    program: Callable[..., Sequence[Tensor]], network: nn.Module, windows: Float[Tensor, "t 1 c h w"]
) -> None:
    """Run consecutive windows through ONNX Runtime and torch, each with its own state.

    Raises AssertionError with the name of an output that differs by more than `TOLERANCE`. The angle is compared as
    (s1, s2) of torch's length, because unpolarized light has no angle.
    """
    carried: Sequence[Tensor] = [torch.zeros_like(tensor) for tensor in network(windows[0])[1]]
    state = None
    for events in windows:
        prediction, state = network(events, state)
        expected = outputs_by_name(prediction, state)
        given = dict(zip(expected, program(events, *carried), strict=True))
        carried = [tensor for name, tensor in given.items() if name.startswith("new_state_")]
        if prediction.stokes is not None:
            angle, length = 2 * given["aolp"], prediction.stokes.norm(dim=1)
            given["aolp"] = torch.stack([length * angle.cos(), length * angle.sin()], dim=1)
            expected["aolp"] = prediction.stokes
        torch.testing.assert_close(given, expected, atol=TOLERANCE, rtol=TOLERANCE)


def random_windows(channels: int, height: int, width: int) -> Float[Tensor, "t 1 c h w"]:
    """Consecutive windows of random whole numbers that move by a pixel each time; the last window is empty."""
    generator = torch.Generator().manual_seed(SEED)
    image = torch.randint(-MAX_VALUE, MAX_VALUE + 1, (1, channels, height, width), generator=generator).float()
    return torch.stack([*(image.roll(k, dims=-1) for k in range(CHECKED_WINDOWS)), torch.zeros_like(image)])


def _traced(
    network: nn.Module, metadata: Mapping[str, Any], events: Float[Tensor, "1 c h w"]
) -> tuple[Any, dict[str, Any]]:
    """ONNX program of a network, and the description of inputs, outputs and state for users without polarnet."""
    with torch.no_grad():
        # Run the network at this size before tracing: it caches masks, and masks cached during tracing hold no values.
        prediction, state = network(events)
    encode = REPRESENTATIONS[metadata["representation"]]
    names = [f"state_{number}" for number in range(len(state))]
    description = {
        "format": FORMAT,
        "network": metadata["network"],
        "representation": metadata["representation"],
        "window_us": trained_window_us(metadata),
        "events": {
            "shape": list(events.shape),
            "polarizers_deg": POLARIZER_ANGLES_DEG,
            "images_of_each": channels_of(encode),
            "channel": "images_of_each * polarizer + image",
            "images": inspect.getdoc(encode),
        },
        "outputs": {name: MEANINGS[name] for name in outputs_by_name(prediction, [])},
        "state": [
            {"input": name, "output": f"new_{name}", "shape": list(tensor.shape), "start": 0.0}
            for name, tensor in zip(names, state, strict=True)
        ],
        "checkpoint": dict(metadata),
    }
    # torch warns about missing torchvision, which polarnet does not use, and about deprecated names of its own
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        program = torch.onnx.export(
            OneWindow(network).eval(),
            (events, *(torch.zeros_like(tensor) for tensor in state)),
            dynamo=True,
            input_names=["events", *names],
            output_names=list(outputs_by_name(prediction, state)),
            opset_version=OPSET,
            verbose=False,
        )
    return program, description


def _file_content(program: Any, description: Mapping[str, Any]) -> bytes:
    """Content of the file, with the description but without the metadata of tracing, such as paths on this machine."""
    import onnx

    model = program.model_proto
    graph = model.graph
    for part in (graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        part.ClearField("metadata_props")
    onnx.helper.set_model_props(model, {KEY: json.dumps(description)})
    return model.SerializeToString(deterministic=True)
