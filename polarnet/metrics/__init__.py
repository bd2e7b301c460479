"""Scores of frames against their truth: MSE, PSNR, SSIM, LPIPS, correlation, and the calibration of expected errors."""

from typing import TYPE_CHECKING

from polarnet.terminal.lazy import attach

if TYPE_CHECKING:
    from polarnet.metrics.similarity import frame_scores as frame_scores
    from polarnet.metrics.similarity import mse as mse
    from polarnet.metrics.similarity import psnr as psnr
    from polarnet.metrics.similarity import ssim as ssim

__getattr__, __dir__, __all__ = attach(__name__, __file__)
