"""Figures as PNG files without a date or software name: same figure, same bytes."""

import io

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

DOTS_PER_INCH = 160


def png(figure: Figure) -> bytes:
    """Encode a figure as PNG bytes that depend only on its content."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    compression = {"compress_level": 9}
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None}, pil_kwargs=compression)
    return buffer.getvalue()
