"""Generated pictures and the polarization of photographs are the same bytes on every processor."""

import hashlib
import os
import platform
import subprocess
import sys

import numpy as np
import pytest
import torch
from skimage import data

from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.simulation.scene import polarization_from_rgb
from studies import same_bytes

REFERENCE = "9869284915ce1dd18a56fc4ec597740599d363e501ed495aeb257b6b2cc06773"


def hash_of_values() -> str:
    """SHA-256 of a generated picture with 8 bits, and of S0, DoLP and AoLP of a photograph."""
    picture = np.round(255 * dead_leaves(np.random.default_rng(1), 120, 180)).astype(np.uint8)
    photograph = torch.from_numpy(data.coffee()).permute(2, 0, 1).float() / 255
    return hashlib.sha256(picture.tobytes() + polarization_from_rgb(photograph).numpy().tobytes()).hexdigest()


def test_the_bytes_are_those_of_the_reference():
    assert hash_of_values() == REFERENCE


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the settings are of x86-64")
def test_the_bytes_are_the_same_on_a_processor_without_avx_and_fma(tmp_path):
    setting = same_bytes.SETTINGS["everything without AVX and FMA"]
    assert set(same_bytes.checked_levels(setting, str(tmp_path)).values()) == {"SSE"}
    script = "import test_same_bytes; print(test_same_bytes.hash_of_values())"
    variables = same_bytes.environment(setting, str(tmp_path))
    variables["PYTHONPATH"] += os.pathsep + os.path.dirname(__file__)
    done = subprocess.run([sys.executable, "-c", script], env=variables, stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout.strip() == REFERENCE


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the settings are of x86-64")
def test_a_setting_without_effect_is_noticed(tmp_path, monkeypatch):
    old_names = {"NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX"}  # of numpy before 2.4
    monkeypatch.setitem(same_bytes.VARIABLES["numpy"], "SSE", old_names)
    with pytest.raises(RuntimeError, match="'numpy': 'SSE'.+has no effect"):
        same_bytes.checked_levels({"numpy": "SSE"}, str(tmp_path))
