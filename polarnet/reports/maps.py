"""Pictures of tensors (events, DoLP, polarization as hue, saturation and value), and picture files of them."""

import io
import math
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from torch import Tensor

DOLP_COLOURS = "viridis"  # perceptually uniform, and still monotonic in grey
EVENT_COLOURS = LinearSegmentedColormap.from_list(
    "events",
    ["#0b3c8c", "#3f83d6", "#ffffff", "#e8604c", "#9c0f1b"],
    N=257,  # odd, so that the middle is white
)
DOTS_PER_INCH = 160  # of figures
FULL_SCALE_QUANTILE = 0.99  # of the pixels with events, so that a few hot pixels do not bleach a picture


def event_full_scale(events: Float[Tensor, "*b h w"]) -> float:
    """The `FULL_SCALE_QUANTILE` of the magnitudes at pixels with events; 1 if there are none.

    Pass the four channels together, so that their pictures share one scale.
    """
    magnitude = events.abs()
    active = magnitude[magnitude > 0].numpy(force=True)
    return float(np.quantile(active, FULL_SCALE_QUANTILE)) if len(active) else 1.0


def event_image(events: Float[Tensor, "h w"], full_scale: float) -> UInt8[np.ndarray, "h w 3"]:
    """Colour event counts or an event tensor (paper Eq. 5): ON red, OFF blue, zero white; saturates at +-full_scale."""
    unit = (events.numpy(force=True) / full_scale).clip(-1, 1)
    return _coloured((unit + 1) / 2, EVENT_TABLE)


def dolp_image(dolp: Float[Tensor, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Colour DoLP from 0 (dark violet) to 1 (yellow); values outside are clamped."""
    return _coloured(dolp.numpy(force=True).clip(0, 1), DOLP_TABLE)


def intensity_image(intensity: Float[Tensor, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Show intensity from 0 (black) to 1 (white); values outside are clamped."""
    return np.repeat(_bytes(intensity.numpy(force=True).clip(0, 1))[..., None], 3, axis=-1)


def polarization_hsv(
    s0: Float[Tensor, "h w"], dolp: Float[Tensor, "h w"], aolp: Float[Tensor, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Hue is AoLP (radians, period pi: 0 red, 60 degrees green, 120 blue), saturation DoLP, value S0 (paper Fig. 4).

    This inverts the simulation's reading of photographs, so a simulated scene looks like its photograph.
    """
    hue_deg = 360 * (aolp / math.pi).remainder(1.0)
    hsv = np.stack([hue_deg.numpy(force=True), *(x.clamp(0, 1).numpy(force=True) for x in (dolp, s0))], axis=-1)
    return _bytes(cv2.cvtColor(hsv.astype(np.float32), cv2.COLOR_HSV2RGB))


def angle_image(dolp: Float[Tensor, "h w"], aolp: Float[Tensor, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """AoLP (radians) as hue and DoLP as saturation at full value, so that an angle without meaning is pale."""
    return polarization_hsv(torch.ones_like(dolp), dolp, aolp)


def png(figure: Figure) -> bytes:
    """Encode a figure as a PNG without a date or software name: the same figure gives the same bytes."""
    buffer = io.BytesIO()
    compression = {"compress_level": 9}
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None}, pil_kwargs=compression)
    return buffer.getvalue()


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PATH.png and as PATH.pdf, whose text and lines scale; the same figure gives the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_name(f"{path.name}.png").write_bytes(png(figure))
    unstamped = dict.fromkeys(("Creator", "Producer", "CreationDate"))
    figure.savefig(path.with_name(f"{path.name}.pdf"), dpi=DOTS_PER_INCH, metadata=unstamped)


def encode_png(picture: UInt8[np.ndarray, "h w channels"]) -> bytes:
    """Encode RGB or RGBA bytes as a PNG without metadata: the same picture gives the same bytes."""
    order = [2, 1, 0, 3][: picture.shape[-1]]  # OpenCV writes BGR
    done, data = cv2.imencode(".png", picture[..., order], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert done, f"OpenCV could not encode a picture of {picture.shape}"
    return data.tobytes()


def _bytes(unit: np.ndarray) -> np.ndarray:
    return np.rint(unit * 255).astype(np.uint8)


def table_of(colours: Colormap) -> UInt8[np.ndarray, "n 3"]:
    """The colours of a colour map as bytes."""
    return _bytes(colours(np.arange(colours.N))[:, :3])


def _coloured(unit: np.ndarray, table: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Colour numbers in [0, 1] as matplotlib does, without its copies and its checks for values outside or missing."""
    return table.take(np.minimum((unit * len(table)).astype(np.intp), len(table) - 1), axis=0)


DOLP_TABLE, EVENT_TABLE = table_of(matplotlib.colormaps[DOLP_COLOURS]), table_of(EVENT_COLOURS)
AOLP_TABLE = angle_image(torch.ones(1, 256), torch.arange(256)[None] * (math.pi / 256))[0]
"""The hues of `angle_image` at DoLP 1; a smaller DoLP blends them with white."""
