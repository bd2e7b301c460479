"""Pictures of recordings and of their calibration: start times, thresholds."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from polarnet.captures.alignment import Alignment
from polarnet.captures.dot import EVENT_CAPTURES, INTENSITY_CAPTURES, RecordingsConfig
from polarnet.captures.targets import Calibrated
from polarnet.events.representations import event_tensor, polarity_sums
from polarnet.events.stream import Events, slice_time
from polarnet.recordings.inspection import Inspection
from polarnet.reports.figures import show_picture, tile_grid
from polarnet.reports.maps import (
    dolp_image,
    encode_png,
    event_full_scale,
    event_image,
    intensity_image,
    png,
    write_figure,
)
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.frames import Frames

COLOURS = ("#d6336c", "#e08a1e", "#3d8fd9", "#4aa37c")
SEQUENCE_COLUMNS = 5
SPAN_MS = 60.0  # on each side of the start


def recording_picture(inspection: Inspection) -> bytes:
    """A PNG of the busiest events without hot pixels, ON red and OFF blue."""
    signed = polarity_sums(inspection.busiest).masked_fill(torch.from_numpy(inspection.hot), 0.0)
    return encode_png(event_image(signed, event_full_scale(signed)))


def draw_calibration(target: Calibrated, config: RecordingsConfig, path: Path) -> None:
    """Write a picture of one target: the landmark in events and in pictures, agreement against lag, thresholds."""
    figure = Figure(figsize=(10, 6.4), layout="constrained")
    events, pictures, lags, levels = figure.subplots(2, 2).reshape(-1).tolist()
    _draw_landmark(events, pictures, target, config)
    lags.set(xlabel="lag of pictures against events, ms from the landmark's", ylabel="agreement", title="not refined")
    levels.set(ylabel="contrast threshold, log intensity")
    if target.alignment is not None:
        _draw_alignment(lags, levels, target.alignment)
    figure.suptitle(
        f"{target.name}: {target.duration_us * 1e-6:.2f} s, hot pixels {', '.join(map(str, target.hot.values()))}"
    )
    path.write_bytes(png(figure))


def draw_sequence(events: Sequence[Events], frames: Frames, path: Path) -> None:
    """Write the paper's Fig. 8 of a calibrated target as PATH.png and PATH.pdf; a column is a time.

    Intensities are scaled to the brightest pixel of the sequence.
    """
    chosen = np.linspace(1, len(frames.t_us) - 1, min(SEQUENCE_COLUMNS, len(frames.t_us) - 1)).round().astype(int)
    figure, grid = tile_grid(9, len(chosen), frames.dolp.shape[1:], bar_row=8)
    white = float(frames.intensity.max()) or 1.0
    for column, k in zip(grid.T, chosen.tolist(), strict=True):
        start, stop = (int(t) for t in frames.t_us[k - 1 : k + 1])
        tensors = torch.stack([event_tensor(slice_time(channel, start, stop), stop - start) for channel in events])
        full_scale = event_full_scale(tensors)
        pictures = [event_image(tensor, full_scale) for tensor in tensors]
        pictures += [intensity_image(plane / white) for plane in frames.intensity[k]]
        for axes, picture in zip(column, [*pictures, dolp_image(frames.dolp[k])], strict=True):
            show_picture(axes, picture)
        column[0].set_title(f"{stop / 1000:.0f} ms", fontsize=8)
    names = [f"{kind} {angle}°" for kind in ("events", "intensity") for angle in POLARIZER_ANGLES_DEG]
    for axes, name in zip(grid[:, 0], [*names, "DoLP"], strict=True):
        axes.set_ylabel(name, fontsize=7)
    write_figure(figure, path)


def _draw_landmark(events: Axes, pictures: Axes, target: Calibrated, config: RecordingsConfig) -> None:
    for capture, colour in zip(EVENT_CAPTURES, COLOURS, strict=True):
        t_ms = (target.region_events_us[capture] - target.start_us[capture]) / 1000
        events.step(t_ms, np.arange(1, len(t_ms) + 1), where="post", color=colour, label=capture)
    for capture, colour in zip(INTENSITY_CAPTURES, COLOURS, strict=True):
        t_us, region = target.region_pictures[capture]
        pictures.plot((t_us - target.start_us[capture]) / 1000, region, ".-", color=colour, label=capture)
    for axes, limit, name in (
        (events, config.negative_events, "negative events in the region"),
        (pictures, config.dark_level, "mean in the region, of 255"),
    ):
        axes.axhline(limit, color="0.6", linewidth=0.8)
        axes.set(xlim=(-SPAN_MS, SPAN_MS), xlabel="ms from the start", ylabel=name)
        axes.legend(fontsize=8)


def _draw_alignment(lags: Axes, levels: Axes, alignment: Alignment) -> None:
    for lag, colour in zip(alignment.lags, COLOURS, strict=True):
        lags.plot(lag.searched_us / 1000, lag.agreements, color=colour)
        lags.axvline(lag.lag_us / 1000, color=colour, linewidth=0.8)
    lags.set_title(f"I0 - I45 + I90 - I135: {100 * alignment.residual:.2f} % of their mean")
    place = np.arange(len(EVENT_CAPTURES))
    for offset, name, colour in ((-0.2, "on", COLOURS[0]), (0.2, "off", COLOURS[2])):
        values = [getattr(lag.thresholds, name) for lag in alignment.lags]
        levels.bar(place + offset, values, 0.38, label=name.upper(), color=colour)
    levels.set_xticks(place, EVENT_CAPTURES)
    levels.legend(fontsize=8)
