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
from studies.faults import OLD_PROCESSOR, older_processor

REFERENCE = "9869284915ce1dd18a56fc4ec597740599d363e501ed495aeb257b6b2cc06773"


def hash_of_values() -> str:
    """SHA-256 of a generated picture with 8 bits, and of S0, DoLP and AoLP of a photograph."""
    picture = np.round(255 * dead_leaves(np.random.default_rng(1), 120, 180)).astype(np.uint8)
    photograph = torch.from_numpy(data.coffee()).permute(2, 0, 1).float() / 255
    return hashlib.sha256(picture.tobytes() + polarization_from_rgb(photograph).numpy().tobytes()).hexdigest()


def test_the_bytes_are_those_of_the_reference():
    assert hash_of_values() == REFERENCE


@pytest.fixture
def x86_64():
    if platform.machine() != "x86_64":
        pytest.skip("the settings are those of x86-64")


@pytest.mark.thorough
def test_the_bytes_are_the_same_on_a_processor_without_avx_and_fma(tmp_path, x86_64):
    script = "import test_same_bytes; print(test_same_bytes.hash_of_values())"
    variables = older_processor() | {"NUMBA_CACHE_DIR": str(tmp_path)}
    variables["PYTHONPATH"] += os.pathsep + os.path.dirname(__file__)
    done = subprocess.run([sys.executable, "-c", script], env=variables, stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout.strip() == REFERENCE


@pytest.mark.thorough
def test_a_setting_without_effect_is_noticed(monkeypatch, x86_64):
    monkeypatch.setitem(OLD_PROCESSOR, "NPY_DISABLE_CPU_FEATURES", "AVX2 FMA3 AVX512F")  # names of numpy before 2.4
    with pytest.raises(RuntimeError, match=r"expected no library with AVX or FMA.+'numpy'"):
        older_processor()
