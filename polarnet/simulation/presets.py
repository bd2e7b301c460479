"""Ready-made sensors and motions for callers from Python.

`SENSORS["default"]` and `MOTIONS["default"]` repeat the values of params.yaml.
"""

from dataclasses import replace

from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.motion import SynthesizeConfig

_DEFAULT = EmulatorConfig(
    model="exact",
    render_rate_hz=300.0,
    contrast_threshold_on=0.2,
    contrast_threshold_off=0.2,
    contrast_threshold_sigma=0.03,
    cutoff_hz=300.0,
    leak_rate_hz=0.01,
    leak_jitter=0.1,
    noise_rate_cov_decades=0.1,
    shot_noise_rate_hz=0.001,
    refractory_period_us=500.0,
    esim_log_eps=0.001,
    voltmeter_camera="dvs346",
    randomise=False,
    random_threshold_on=[0.08, 0.31],
    random_threshold_off=[0.14, 0.42],
    random_threshold_sigma=[0.02, 0.06],
    random_cutoff_hz=[30.0, 300.0],
    random_leak_rate_hz=[0.01, 0.1],
    random_shot_noise_rate_hz=[0.001, 5.0],
)

SENSORS = {
    "default": _DEFAULT,
    "clean": replace(
        _DEFAULT,
        contrast_threshold_sigma=0.02,
        cutoff_hz=0.0,
        leak_rate_hz=0.0,
        leak_jitter=0.0,
        noise_rate_cov_decades=0.0,
        shot_noise_rate_hz=0.0,
        refractory_period_us=0.0,
    ),
    "noisy": replace(
        _DEFAULT,
        contrast_threshold_sigma=0.05,
        cutoff_hz=30.0,
        leak_rate_hz=0.1,
        shot_noise_rate_hz=5.0,
        refractory_period_us=0.0,
    ),
}
"""v2e's command-line defaults and its options `clean` and `noisy`; derive others with `dataclasses.replace`."""

MOTIONS = {
    "default": SynthesizeConfig(
        sequences_per_picture=1,
        duration_s=1.0,
        frame_rate_hz=30.0,
        sensor_height=120,
        sensor_width=180,
        speed_min_px_s=40.0,
        speed_max_px_s=160.0,
        acceleration_max_px_s2=800.0,
        rotation_max_deg=0.0,
        zoom_max=1.0,
    )
}
"""One second of a 120 x 180 px sensor that drifts at up to 160 px/s."""
