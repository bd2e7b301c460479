"""Video files of pictures, which browsers and players show: H.264 in MP4."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import UInt8

CODEC, PIXELS = "libx264", "yuv420p"  # the one pair that every browser plays
QUALITY = {"preset": "ultrafast", "crf": "18", "threads": "1"}  # a second thread would take the network's core
LAYOUT = {"movflags": "hybrid_fragmented", "flush_packets": "1"}  # plays after a kill, an ordinary MP4 once closed
SECONDS_PER_FRAGMENT = 2  # the most that a kill loses


class VideoWriter:
    """Writes pictures of one size into an MP4; as a context manager it closes the file.

    Odd sides are made even by repeating the last row or column. After a kill, the file plays up to its last complete
    fragment. ValueError if a picture has another size than the first.

    >>> from pathlib import Path
    >>> import numpy as np
    >>> from polarnet.reports import VideoWriter
    >>> with VideoWriter(Path("grey.mp4"), rate_hz=30.0) as video:
    ...     for level in range(0, 250, 10):
    ...         video.add(np.full((32, 48, 3), level, np.uint8))
    """

    def __init__(self, path: Path, rate_hz: float):
        """`rate_hz` pictures a second; the file is created with the first picture."""
        self.path, self.rate = path, Fraction(rate_hz).limit_denominator(100_000)
        self._file: av.container.OutputContainer | None = None
        self._stream: Any = None

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(self, *problem: object) -> None:
        self.close()

    def add(self, picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """Add a picture in RGB."""
        even = with_even_sides(picture)
        if self._file is None:
            self._open(even.shape[0], even.shape[1])
        assert self._file is not None
        if even.shape[:2] != (self._stream.height, self._stream.width):
            expected = f"{self._stream.height} x {self._stream.width}"
            raise ValueError(f"{self.path}: expected pictures of {expected} px, got {even.shape[0]} x {even.shape[1]}")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
        self._file.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write the pictures that the encoder still holds, and the file's index."""
        if self._file is not None:
            self._file.mux(self._stream.encode())
            self._file.close()
            self._file = None

    def _open(self, height: int, width: int) -> None:
        self._file = av.open(str(self.path), "w", format="mp4", options=LAYOUT)
        self._stream = self._file.add_stream(CODEC, rate=self.rate, options=QUALITY)
        self._stream.height, self._stream.width, self._stream.pix_fmt = height, width, PIXELS
        self._stream.codec_context.gop_size = max(1, round(SECONDS_PER_FRAGMENT * self.rate))


def with_even_sides(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The picture with its last row and column repeated where a side is odd, because codecs want even sides."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
