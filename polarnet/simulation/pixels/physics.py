"""Parameters and formulas that the pixel models share: contrast thresholds, photoreceptor, leak and shot noise of v2e.

Formulas and constants are those of v2e (Hu, Liu, Delbruck, CVPRW 2021).
"""

import math
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from polarnet.runtime.compilation import borrowing, inlined
from polarnet.runtime.sections import one_of, section
from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.light import FULL_SCALE, MIN_DARK_DN
from polarnet.simulation.pixels.randomness import mixed, normal, uniform

MIN_KNEE_DN = 2.72  # about e, where the linear part and the logarithm have one slope
NO_KNEE_DN = -1.0
MAX_RATE_HZ = 1e5  # a pixel's refractory period allows no more
THRESHOLD_FLOOR = 0.01  # natural-log intensity: v2e clips drawn thresholds here
DARK_OFFSET = 20.0  # DN: bandwidth and shot noise follow (DN + 20) / 275
SATURATION = 275.0
SHOT_NOISE_SLOPE = 0.75  # shot noise falls by this fraction from dark to bright
DARK_SHOT_NOISE = 1 - SHOT_NOISE_SLOPE * DARK_OFFSET / SATURATION  # fraction of the nominal rate at 0 DN


@section
class PixelConfig:
    """Parameters of the pixel models, v2e's first. Contrast thresholds are steps of natural-log intensity."""

    knee_dn: Annotated[float, Field(ge=MIN_KNEE_DN, le=FULL_SCALE)]
    """Light in DN below which the response is linear, and logarithmic above; without effect if `dark_dn` is set."""
    dark_dn: Annotated[float, Field(ge=0, le=FULL_SCALE)] | None
    """Dark current of the photodiode in DN: the response is ln(light + dark_dn), without a knee; null: v2e's."""
    contrast_threshold_on: Annotated[float, Field(ge=0.01, le=10)]
    contrast_threshold_off: Annotated[float, Field(ge=0.01, le=10)]
    contrast_threshold_sigma_on: NonNegativeFloat
    """Standard deviation of the ON threshold between pixels, drawn for each channel."""
    contrast_threshold_sigma_off: NonNegativeFloat
    contrast_threshold_mismatch_on: Annotated[float, Field(ge=0, le=1)] | None
    """Standard deviation of the ON threshold between pixels as a share of it, in place of the sigma; null: the sigma.

    Thresholds are log-normal then, so that none comes near 0: a normal one with a mismatch of 55 % often would.
    """
    contrast_threshold_mismatch_off: Annotated[float, Field(ge=0, le=1)] | None
    contrast_threshold_correlation: Annotated[float, Field(ge=-1, le=1)]
    """Correlation of a pixel's ON and OFF thresholds."""
    cutoff_hz: NonNegativeFloat
    """Bandwidth of the photoreceptor at full brightness, less in the dark; 0: infinite."""
    photoreceptor_noise: Annotated[float, Field(ge=0, le=1)]
    """Standard deviation of the noise at the photoreceptor's output, natural-log intensity, in any light.

    It passes the low-pass of `cutoff_hz` at full brightness, as in v2e, so that ON and OFF events alternate.
    """
    leak_rate_hz: Annotated[float, Field(ge=0, le=MAX_RATE_HZ)]
    """ON events per second of a pixel that sees no change."""
    leak_jitter: Annotated[float, Field(ge=0, le=1)]
    """Relative standard deviation of the leak: in each frame for `v2e`, in each interval of events for `exact`."""
    noise_rate_cov_decades: Annotated[float, Field(ge=0, le=1)]
    """Standard deviation between pixels of the decimal logarithm of the leak rate."""
    shot_noise_rate_hz: Annotated[float, Field(ge=0, le=MAX_RATE_HZ)]
    """Noise events per second of a pixel in the dark, ON and OFF together; a quarter of it at full brightness."""
    refractory_period_us: NonNegativeFloat
    refractory: Annotated[str, one_of(("keep", "reset"))]
    """Fate of a change of light within the refractory period: kept and reported later, or forgotten by a pixel that is
    held in reset, whose reference is then the light at the end of the period."""
    esim_log_eps: PositiveFloat
    """Constant that ESIM adds to the intensity in [0, 1] before the logarithm."""

    def __post_init__(self):
        if self.photoreceptor_noise and not self.cutoff_hz:
            raise ValueError(
                f"photoreceptor_noise: expected 0 without a photoreceptor bandwidth that filters it, got "
                f"{self.photoreceptor_noise}; set cutoff_hz"
            )


class Physics(NamedTuple):
    """`PixelConfig` for compiled kernels."""

    knee_dn: float  # NO_KNEE_DN: the response has none
    knee_slope: float  # of the response below the knee, per DN
    dark_dn: float
    threshold_on: float
    threshold_off: float
    threshold_sigma_on: float
    threshold_sigma_off: float
    threshold_mismatch_on: float  # share of the threshold; 0: the deviation is `threshold_sigma_on`
    threshold_mismatch_off: float
    threshold_correlation: float
    cutoff_hz: float
    photoreceptor_noise: float
    leak_rate_hz: float
    leak_jitter: float
    noise_rate_cov_decades: float
    shot_noise_rate_hz: float
    refractory_s: float
    refractory_period_us: float
    esim_log_eps: float
    holds: bool  # whether the pixel is held in reset for the refractory period


def physics_of(config: PixelConfig) -> Physics:
    """The parameters of `config`, with the refractory period in seconds."""
    values = {name.removeprefix("contrast_"): value for name, value in vars(config).items()}
    for name in ("threshold_mismatch_on", "threshold_mismatch_off"):
        if values[name] is not None:
            values[name.replace("mismatch", "sigma")] = 0.0
        values[name] = values[name] or 0.0
    values["knee_slope"] = math.log(config.knee_dn) / config.knee_dn
    values["dark_dn"] = 0.0
    if config.dark_dn is not None:
        values["dark_dn"], values["knee_dn"] = max(config.dark_dn, MIN_DARK_DN), NO_KNEE_DN
    values["refractory_s"] = config.refractory_period_us * 1e-6
    values["holds"] = config.refractory == "reset"
    return Physics(*(values[name] for name in Physics._fields))


def mismatch(physics: Physics, pixels: int, key: np.uint64, channel: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ON and OFF thresholds of a channel's pixels, and their leak rates relative to the nominal rate, float32.

    Thresholds are at least `THRESHOLD_FLOOR`, and normally distributed, or log-normally with a relative mismatch. Leak
    rates are log-normal.
    """
    share, on = physics.threshold_correlation, np.zeros(pixels, np.float32)
    off, varies_off = on, physics.threshold_sigma_off or physics.threshold_mismatch_off
    if physics.threshold_sigma_on or physics.threshold_mismatch_on or (varies_off and share):
        on = randomness.normal_map(key, randomness.THRESHOLD_ON, channel, pixels)
    if varies_off:
        off = randomness.normal_map(key, randomness.THRESHOLD_OFF, channel, pixels)
    if share:
        off = np.float32(share) * on + np.float32(math.sqrt(1 - share * share)) * off
    exponents = np.zeros(pixels, np.float32)
    if cov_decades := physics.noise_rate_cov_decades:
        exponents = np.float32(cov_decades) * randomness.normal_map(key, randomness.NOISE_RATE, channel, pixels)
    return (
        _threshold_map(physics.threshold_on, physics.threshold_sigma_on, physics.threshold_mismatch_on, on),
        _threshold_map(physics.threshold_off, physics.threshold_sigma_off, physics.threshold_mismatch_off, off),
        (10 ** exponents.astype(np.float64)).astype(np.float32),  # powers in float32 depend on the processor
    )


def _threshold_map(nominal: float, sigma: float, mismatch: float, deviations: np.ndarray) -> np.ndarray:
    if mismatch:
        variance = math.log1p(mismatch * mismatch)  # of the logarithm; the mean of the thresholds is `nominal`
        exponents = math.sqrt(variance) * deviations.astype(np.float64) - variance / 2
        thresholds = (nominal * np.exp(exponents)).astype(np.float32)
    elif sigma == 0:
        return np.full(len(deviations), nominal, np.float32)
    else:
        thresholds = np.float32(nominal) + np.float32(sigma) * deviations
    return np.maximum(thresholds, np.float32(THRESHOLD_FLOOR))


@inlined
def shot_noise_fraction(dn):
    """Shot-noise rate at `dn` relative to the nominal rate: 0.95 in the dark, 0.25 at 255 DN."""
    return 1 - SHOT_NOISE_SLOPE * (np.float64(dn) + DARK_OFFSET) / SATURATION


@borrowing
def wander(noise, key, first_pixel, physics, dt_s, rise):
    """Move the photoreceptor's noise on by `dt_s`, and add its change to `rise`.

    White noise behind a first-order low-pass (an Ornstein-Uhlenbeck process): its deviation and its spectrum do not
    depend on the frame rate. Its numbers are Gaussian far into the tails, because only those cross thresholds.
    """
    a = 2 * math.pi * physics.cutoff_hz * dt_s
    lost, fresh = -math.expm1(-a), physics.photoreceptor_noise * math.sqrt(-math.expm1(-2 * a))
    for j in range(noise.size):
        change = np.float32(fresh * normal(uniform(mixed(key, first_pixel + j))) - lost * noise[j])
        noise[j] += change
        rise[j] += change
