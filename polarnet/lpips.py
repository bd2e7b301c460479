"""LPIPS v0.1, the learned perceptual distance (Zhang et al., CVPR 2018), and where its weights come from.

The backbones are torchvision's classifiers up to the last layer that LPIPS looks at, written out here so that
torchvision, whose builds often disagree with torch's, is not needed. polarnet ships no weights: see `find_weights`.
"""

import hashlib
import importlib.util
import json
import logging
import socket
import threading
import urllib.request
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import load_file, save
from torch import Tensor, nn

from polarnet.arrays import Array, as_tensor, check_floating, check_range
from polarnet.ranges import allowed, check_ranges

log = logging.getLogger(__name__)

SHIFT = (-0.030, -0.088, -0.188)  # of RGB in [-1, 1]; this and SCALE: LPIPS v0.1's scaling layer
SCALE = (0.458, 0.448, 0.450)
NORM_FLOOR = 1e-8  # under the root of a feature's length, whose slope at 0 would be infinite
MODELS_URL = "https://download.pytorch.org/models/"
REACH_TIMEOUT_S = 3.0  # a machine without a network must not wait
STALL_TIMEOUT_S = 30.0  # of a download that has begun


@dataclass(frozen=True)
class LpipsConfig:
    """Section `lpips` of params.yaml."""

    backbone: str = field(metadata=allowed(choices=("squeeze", "alex", "vgg")))
    """The paper uses vgg; squeeze is the smallest."""
    path: str | None
    """Weights file (.pth, .npz or .safetensors; torchvision's keys, with or without LPIPS's heads); null: search."""
    required: bool
    """Refuse to run without the weights."""

    def __post_init__(self):
        check_ranges(self)


class Fire(nn.Module):
    """SqueezeNet's block: a 1x1 bottleneck, then 1x1 and 3x3 convolutions side by side."""

    def __init__(self, channels: int, squeezed: int, expanded: int):
        super().__init__()
        self.squeeze = nn.Conv2d(channels, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h w"]:
        """Twice `expanded` channels of the same size."""
        x = self.squeeze(x).relu()
        return torch.cat([self.expand1x1(x), self.expand3x3(x)], dim=1).relu()


def squeezenet1_1() -> nn.Sequential:
    """torchvision's squeezenet1_1 `features`."""
    pool = nn.MaxPool2d(3, stride=2, ceil_mode=True)
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), pool),
        *(Fire(64, 16, 64), Fire(128, 16, 64), pool),
        *(Fire(128, 32, 128), Fire(256, 32, 128), pool),
        *(Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256)),
    )


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
    """A classifier, and which of its layers LPIPS v0.1 compares."""

    features: Callable[[], nn.Sequential]
    taps: tuple[int, ...]
    """Numbers of layers after which the features are compared."""
    channels: tuple[int, ...]
    """At each tap."""
    least_side: int
    """Pixels that an image must have for the last tap to see anything."""
    file: str
    """torchvision's name of the weights; its last part begins the file's sha256."""


BACKBONES = {
    "squeeze": Backbone(
        squeezenet1_1, (2, 5, 8, 10, 11, 12, 13), (64, 128, 256, 384, 384, 512, 512), 17, "squeezenet1_1-b8a52dc0.pth"
    ),
    "alex": Backbone(alexnet, (2, 5, 8, 10, 12), (64, 192, 384, 256, 256), 31, "alexnet-owt-7be5be79.pth"),
    "vgg": Backbone(vgg16, (4, 9, 16, 23, 30), (64, 128, 256, 512, 512), 16, "vgg16-397923af.pth"),
}


class Lpips(nn.Module):
    """LPIPS v0.1: differences of unit-length features, weighted per channel. Frozen; gradients reach the images only.

    Grey images are repeated to three channels. Under autocast the convolutions run in its precision, features are
    normalised and compared in float32.
    """

    def __init__(self, backbone: str):
        super().__init__()
        self.backbone = backbone
        self.layers = BACKBONES[backbone].features()
        self.heads = nn.ParameterList(torch.ones(n) for n in BACKBONES[backbone].channels)
        self.requires_grad_(False).eval()

    @classmethod
    def of(cls, backbone: str, tensors: Mapping[str, Tensor]) -> "Lpips":
        """From tensors under torchvision's and LPIPS's names; ValueError where they are not this backbone's."""
        state = {
            name.replace("features.", "layers."): (
                value.contiguous(memory_format=torch.channels_last) if value.ndim == 4 else value  # the faster layout
            )
            for name, value in tensors.items()
        }
        for i in range(len(BACKBONES[backbone].taps)):
            if (head := state.pop(f"lin{i}.model.1.weight", None)) is not None:
                state[f"heads.{i}"] = head.flatten()
        with torch.device("meta"):  # neither memory nor random numbers for weights that are replaced at once
            lpips = cls(backbone)
        try:
            lpips.load_state_dict(state, assign=True)
        except RuntimeError as error:
            raise ValueError(f"these are not the weights of LPIPS's {backbone} backbone: {error}") from None
        return lpips

    @classmethod
    def load(cls, folder: Path | str) -> "Lpips | None":
        """What stage `weights` left in `folder`; None where it found nothing (lpips.json says why)."""
        record = json.loads((Path(folder) / "lpips.json").read_text())
        if record["sha256"] is None:
            return None
        file = Path(folder) / "lpips.safetensors"
        if _sha256(file) != record["sha256"]:
            raise ValueError(f"{file} is not the file that lpips.json describes; run stage `weights` again")
        return cls.of(record["backbone"], load_file(file))

    def forward(
        self, a: Float[Array, "b h w"] | Float[Array, "b 3 h w"], b: Float[Array, "b h w"] | Float[Array, "b 3 h w"]
    ) -> Float[Tensor, " b"]:
        """Distance of each pair of images, grey or RGB in [0, 1], numpy or torch; 0 for equal ones.

        ValueError as `features`, and where `b`, the truth, is outside [0, 1].
        """
        check_range("b", as_tensor("b", b), 0, 1, "images")
        return self.distance(self.features(a), self.features(b))

    def features(self, images: Float[Array, "b h w"] | Float[Array, "b 3 h w"]) -> list[Float[Tensor, "b _c _h _w"]]:
        """Unit-length features of images in [0, 1] at each tap: what to keep of a truth that is compared often.

        TypeError for what is no array; ValueError for integers, and for images too small for the backbone.
        """
        images = as_tensor("images", images)
        check_floating("images", images)
        least = BACKBONES[self.backbone].least_side
        if min(images.shape[-2:]) < least:
            raise ValueError(
                f"LPIPS ({self.backbone}) needs images of {least} pixels a side, got {tuple(images.shape)}"
            )
        if images.ndim == 3:
            images = images[:, None].expand(-1, 3, -1, -1)
        x = (2 * images - 1 - images.new_tensor(SHIFT).view(3, 1, 1)) / images.new_tensor(SCALE).view(3, 1, 1)
        tapped = []
        for number, layer in enumerate(self.layers, start=1):
            x = layer(x)
            if number in BACKBONES[self.backbone].taps:
                found = x.float()
                tapped.append(found / (found.square().sum(dim=1, keepdim=True) + NORM_FLOOR).sqrt())
        return tapped

    def distance(
        self, a: list[Float[Tensor, "b _c _h _w"]], b: list[Float[Tensor, "b _c _h _w"]]
    ) -> Float[Tensor, " b"]:
        """LPIPS of two images from their `features`."""
        per_tap = [
            ((at_a - at_b).square().mean(dim=(-2, -1)) * head).sum(dim=1)
            for at_a, at_b, head in zip(a, b, self.heads, strict=True)
        ]
        return torch.stack(per_tap).sum(dim=0)


class Weights(NamedTuple):
    """What a search for weights found."""

    tensors: dict[str, Tensor] | None
    source: str | None
    """Name of the file."""
    reason: str | None
    """Why there are none."""


def find_weights(config: LpipsConfig) -> Weights:
    """Weights from `config.path`; else torchvision's file from torch's hub cache; else from the network into it.

    LPIPS's heads come from the same file, or else from the torchmetrics wheel.
    Raises ValueError where `config.path` is given and cannot be used.
    """
    if config.path is not None:
        file = Path(config.path)
        if not file.is_file():
            raise ValueError(f"lpips.path: there is no file {file}; correct it, or set it to null to search")
        return Weights(_checked(config.backbone, _read(file), file), file.name, None)
    file, name = _cached(config.backbone), BACKBONES[config.backbone].file
    if not file.is_file() and not _download(MODELS_URL + name, file):
        return Weights(None, None, f"{name} is not in torch's hub cache and could not be downloaded")
    if not _sha256(file).startswith(_hash_in(name)):
        log.warning("%s is damaged: its sha256 does not begin as its name ends; delete it", file)
        return Weights(None, None, f"{name} in torch's hub cache is damaged")
    return Weights(_checked(config.backbone, _read(file), file), name, None)


def write_weights(folder: Path | str, backbone: str, weights: Weights) -> None:
    """Write what `Lpips.load` reads: lpips.json, and lpips.safetensors where there are weights.

    No path and no date enters, so that equal weights are equal bytes on every machine.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    content = save(weights.tensors) if weights.tensors is not None else None
    file = folder / "lpips.safetensors"
    file.unlink(missing_ok=True)
    if content is not None:
        file.write_bytes(content)
    record = {
        "backbone": backbone,
        "sha256": hashlib.sha256(content).hexdigest() if content is not None else None,
        "source": weights.source,
        "reason": weights.reason,
    }
    (folder / "lpips.json").write_text(json.dumps(record, indent=2, sort_keys=True) + "\n")


def lpips_problem(config: LpipsConfig, folder: Path | str | None = None) -> str | None:
    """Why stage `weights` would find nothing, and what to do; None where it would, or already did into `folder`.

    Reads no weights and downloads nothing: at most a few seconds for a machine without a network.
    """
    if folder is not None and _holds(Path(folder), config.backbone):
        return None
    if config.path is not None:
        return None if Path(config.path).is_file() else f"lpips.path: there is no file {config.path}"
    if _cached(config.backbone).is_file() or _reachable(MODELS_URL + BACKBONES[config.backbone].file):
        return None
    return f"no LPIPS weights; {where_to_put(config.backbone)}"


def where_to_put(backbone: str) -> str:
    """What a user does to supply the weights."""
    name = BACKBONES[backbone].file
    return f"put {MODELS_URL}{name} at {_cached(backbone)}, or set lpips.path to a copy of it"


def _holds(folder: Path, backbone: str) -> bool:
    record = folder / "lpips.json"
    if not record.is_file():
        return False
    found = json.loads(record.read_text())
    return found["backbone"] == backbone and found["sha256"] is not None


def _cached(backbone: str) -> Path:
    return Path(torch.hub.get_dir()) / "checkpoints" / BACKBONES[backbone].file


def _hash_in(name: str) -> str:
    return Path(name).stem.rsplit("-", 1)[1]


def _sha256(file: Path) -> str:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def _read(file: Path) -> dict[str, Tensor]:
    try:
        if file.suffix == ".npz":
            with np.load(file, allow_pickle=False) as arrays:
                return {name: torch.from_numpy(arrays[name]) for name in arrays.files}
        if file.suffix == ".safetensors":
            return load_file(file)
        return torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # each of three readers raises its own kinds
        raise ValueError(f"{file.name}: expected weights as .pth, .npz or .safetensors, got {error}") from error


def _checked(backbone: str, tensors: Mapping[str, Tensor], file: Path) -> dict[str, Tensor]:
    """Backbone and heads as LPIPS needs them, without the classifier; ValueError that names the file."""
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
    return wanted


def _heads_file(backbone: str) -> Path:
    """LPIPS v0.1's heads in the torchmetrics wheel, found without importing it (2 s)."""
    package = importlib.util.find_spec("torchmetrics")
    for root in (package and package.submodule_search_locations) or []:
        file = Path(root) / "functional" / "image" / "lpips_models" / f"{backbone}.pth"
        if file.is_file():
            return file
    raise ValueError("LPIPS's heads are not in the installed torchmetrics; install torchmetrics>=1.7")


def _reachable(url: str) -> bool:
    """Whether a server answers for `url`; in a thread, because a name look-up heeds no timeout."""
    answered: list[bool] = []

    def ask() -> None:
        try:
            with urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=REACH_TIMEOUT_S):
                answered.append(True)
        except OSError:
            pass

    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    asking.join(REACH_TIMEOUT_S)
    return bool(answered)


def _download(url: str, file: Path) -> bool:
    """Fetch `url` into torch's hub cache, checking its sha256; False, with a line in the log, where that fails."""
    if not _reachable(url):
        return False
    file.parent.mkdir(parents=True, exist_ok=True)
    usual = socket.getdefaulttimeout()
    socket.setdefaulttimeout(STALL_TIMEOUT_S)
    try:
        torch.hub.download_url_to_file(url, str(file), hash_prefix=_hash_in(file.name))
    except (OSError, RuntimeError) as error:
        log.warning("download of %s failed: %s", url, error)
        return False
    finally:
        socket.setdefaulttimeout(usual)
    return True
