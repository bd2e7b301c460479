"""SSIM, LPIPS, correlation and the calibration of expected errors."""
