"""`polarnet demo` simulates a built-in photograph and recovers its DoLP with the shipped weights."""

import numpy as np
import zarr
from test_simulate import SMALL

from polarnet.cli import main


def test_demo_recovers_a_photograph_better_than_its_mean(tmp_path, capsys):
    size = ["synthesize.sensor_height=60", "synthesize.sensor_width=90", "synthesize.duration_s=0.4"]
    rest = [word for word in SMALL if not word.startswith(("synthesize.", "ingest."))]
    assert main(["demo", "--out", str(tmp_path / "demo"), *size, *rest]) == 0
    assert f"open {tmp_path / 'demo' / 'recovered' / 'index.html'}" in capsys.readouterr().out
    assert (tmp_path / "demo" / "recovered" / "recovered.mp4").stat().st_size > 10_000
    truth = np.asarray(zarr.open_group(tmp_path / "demo" / "simulated" / "truth.zarr", mode="r")["dolp"]) / 65535
    dolp = np.asarray(zarr.open_group(tmp_path / "demo" / "recovered" / "recovered.zarr", mode="r")["dolp"]) / 65535
    error = np.square(dolp[5:] - truth[6:]).mean(axis=(1, 2))
    assert len(dolp) == len(truth) - 1
    assert error.mean() < truth[6:].var(axis=(1, 2)).mean()


def test_demo_passes_a_refusal_on(tmp_path, capsys):
    assert main(["demo", "--out", str(tmp_path / "demo"), "emulate.model=wrong"]) == 1
    assert "emulate.model" in capsys.readouterr().err
    assert not (tmp_path / "demo" / "recovered").exists()
