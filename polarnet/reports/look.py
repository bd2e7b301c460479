"""Pictures to look at from Python: events, frames and predictions. A notebook shows them, and `save` writes them."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from polarnet.events.representations import polarity_sums
from polarnet.events.stream import Events
from polarnet.reports.maps import angle_image, dolp_image, intensity_image, polarization_hsv
from polarnet.reports.preview import Sheet, foot_of
from polarnet.stokes import POLARIZER_ANGLES_DEG, Prediction


def plot_events(events: Sequence[Events]) -> Image.Image:
    """ON (red) minus OFF (blue) events of each pixel, behind each of the four polarizers.

    >>> from polarnet.events import Events
    >>> from polarnet.reports import plot_events
    >>> plot_events([Events.empty(20, 30)] * 4).mode
    'RGB'
    """
    sheet = Sheet(events[0].height, events[0].width)
    maps = sheet.events(torch.stack([polarity_sums(channel) for channel in events]))
    captioned = {f"events, {angle}°": one for angle, one in zip(POLARIZER_ANGLES_DEG, maps, strict=True)}
    times = torch.cat([channel.t for channel in events])
    span = (int(times.min()), int(times.max())) if len(times) else (0, 0)
    return Image.fromarray(sheet.picture([captioned], foot_of(span, len(times))))


def plot_frame(s0: Float[Tensor, "h w"], dolp: Float[Tensor, "h w"], aolp: Float[Tensor, "h w"]) -> Image.Image:
    """S0 (in [0, 1]), DoLP, AoLP (radians) and their polarization as hue, saturation and value.

    >>> import torch
    >>> from polarnet.reports import plot_frame
    >>> plot_frame(torch.rand(20, 30), torch.rand(20, 30), torch.rand(20, 30)).mode
    'RGB'
    """
    captioned = {
        "S0": intensity_image(s0),
        "DoLP": dolp_image(dolp),
        "AoLP (hue), DoLP (saturation)": angle_image(dolp, aolp),
        "polarization and S0": polarization_hsv(s0, dolp, aolp),
    }
    return Image.fromarray(Sheet(*dolp.shape).picture([captioned], ""))


def plot_prediction(prediction: Prediction, dolp: Float[Tensor, "h w"] | None = None) -> Image.Image:
    """DoLP, AoLP and the expected error of one predicted frame, with the true `dolp` and the error if it is given.

    >>> import torch
    >>> from polarnet.reports import plot_prediction
    >>> from polarnet.stokes import Prediction
    >>> plot_prediction(Prediction(torch.rand(20, 30)), torch.rand(20, 30)).mode
    'RGB'
    """
    captioned = {"DoLP": dolp_image(prediction.dolp)}
    if prediction.aolp is not None:
        captioned["AoLP (hue), DoLP (saturation)"] = angle_image(prediction.dolp, prediction.aolp)
    if prediction.log_variance is not None:
        captioned["expected error"] = dolp_image(torch.exp(prediction.log_variance / 2))
    if dolp is not None:
        captioned |= {"true DoLP": dolp_image(dolp), "error": dolp_image((prediction.dolp - dolp).abs())}
    return Image.fromarray(Sheet(*prediction.dolp.shape).picture([captioned], ""))
