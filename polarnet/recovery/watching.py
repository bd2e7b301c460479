"""Watch a recovery: scores against a known truth."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from polarnet.metrics.scores import frame_scores
from polarnet.recovery.stream import Frame
from polarnet.stokes import Prediction
from polarnet.storage.true_frames import TrueFrames

MAX_GAP = 0.01  # between the end of a window and its true frame, as a fraction of the window


@dataclass
class TruthScores:
    """Scores of the frames that have a true frame at the end of their window; the others are counted."""

    truth: TrueFrames
    scores: dict[str, list[float]] = field(default_factory=dict)
    """Score of each frame by metric, as in the benchmark: mse, psnr, ssim, corr and, with an angle, aolp_deg."""
    unmatched: int = 0
    """Number of frames without a true frame."""

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the frames, scored."""
        for frame in frames:
            self.add(frame)
            yield frame

    def add(self, frame: Frame) -> None:
        """Score a frame."""
        if not self.truth.has(frame.window.stop_us, MAX_GAP * frame.window.length_us):
            self.unmatched += 1
            return
        true = self.truth.at(frame.window.stop_us)
        aolp = frame.prediction.aolp
        prediction = Prediction(frame.prediction.dolp[None], None if aolp is None else aolp[None])
        valid = None if true.valid is None else true.valid[None]
        scores = frame_scores(prediction, true.dolp[None], true.aolp[None], valid)
        for name, values in scores.items():
            self.scores.setdefault(name, []).append(float(values))

    def sentence(self, skipped: int) -> str:
        """Means after the first `skipped` scored frames, in words; ValueError if none is left."""
        means = {name: math.fsum(values[skipped:]) / len(values[skipped:]) for name, values in self.scores.items()
                 if values[skipped:]}  # fmt: skip
        if not means:
            raise ValueError(
                f"--truth: expected more than {skipped} frames with a true frame at the end of their window, got "
                f"{len(self.scores.get('mse', []))} of {len(self.scores.get('mse', [])) + self.unmatched}; leave out "
                f"--window and --rate, or record for longer"
            )
        words = ", ".join(f"{LABELS[name].format(value)}" for name, value in means.items())
        count = len(self.scores["mse"]) - skipped
        rest = f", {self.unmatched} frames without a true frame" if self.unmatched else ""
        return f"{words} ({count} frames after the first {skipped}{rest})"


LABELS = {
    "mse": "MSE {:.4f}",
    "psnr": "PSNR {:.2f} dB",
    "ssim": "SSIM {:.3f}",
    "corr": "correlation {:.3f}",
    "aolp_deg": "AoLP error {:.1f} degrees",
}
