"""The picture of a recording that `polarnet inspect` writes."""

import numpy as np
import torch

from polarnet.recordings.formats.celex5_bin import WHITE
from polarnet.recordings.inspection import Inspection
from polarnet.reports.maps import encode_png, event_full_scale, event_image, intensity_image


def recording_picture(inspection: Inspection) -> bytes:
    """A PNG of the busiest events without hot pixels, ON red and OFF blue; without events, the first full picture."""
    if inspection.on + inspection.off == 0 and inspection.first_picture is not None:
        return encode_png(intensity_image(torch.from_numpy(inspection.first_picture / np.float32(WHITE))))
    signed = torch.from_numpy(np.where(inspection.hot, 0, inspection.busiest)).float()
    return encode_png(event_image(signed, event_full_scale(signed)))
