"""Write recordings of a PDAVIS as E2P publishes them: HDF5 of events, frames, and maps of polarization."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64, UInt8

from polarnet.events.mosaic import places_of
from polarnet.events.stream import Events
from polarnet.networks.e2p.network import MOSAIC
from polarnet.recordings.writers import h5py_module

WHITE = 255


def write_e2p(
    path: Path,
    events: Events,
    t_us: Int64[np.ndarray, " n"],
    frames: UInt8[np.ndarray, "n h w"] | None,
    maps: tuple[Float[np.ndarray, "n h2 w2"], Float[np.ndarray, "n h2 w2"], Float[np.ndarray, "n h2 w2"]] | None,
) -> None:
    """Write the events of the whole mosaic, frames of the same size at `t_us`, and maps of S0 (1: white), DoLP, AoLP.

    Maps are stored in 255 steps, rounded to the nearest; AoLP from -90 degrees on.
    """
    table = np.stack([events.t.numpy(), events.x.numpy(), events.y.numpy(), events.p.numpy() > 0], axis=1)
    with h5py_module().File(path, "w") as file:
        file["events"] = table.astype(np.uint32)
        file["frame_ts"] = t_us.astype(np.uint32)
        file["frame_idx"] = np.searchsorted(events.t.numpy(), t_us).astype(np.uint64)
        if frames is not None:
            file["frame"] = frames
        if maps is not None:
            s0, dolp, aolp = maps
            code = np.remainder(aolp / np.pi + 0.5, 1.0)
            for name, values in (("intensity", s0), ("dolp", dolp), ("aolp", code)):
                file[name] = np.rint(WHITE * values).astype(np.uint8)
        file.attrs["sensor_resolution"] = events.width, events.height


def mosaicked(planes: np.ndarray) -> np.ndarray:
    """One mosaic 90 45 / 135 0 of twice the size, from n x 4 x h x w planes at 0, 45, 90 and 135 degrees."""
    n, _, height, width = planes.shape
    mosaic = np.empty((n, 2 * height, 2 * width), planes.dtype)
    for plane, (row, column) in zip(planes.swapaxes(0, 1), places_of(MOSAIC), strict=True):
        mosaic[:, row::2, column::2] = plane
    return mosaic
