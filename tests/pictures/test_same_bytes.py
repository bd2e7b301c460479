"""Generated pictures and the polarization of photographs are the same bytes on every processor."""

import hashlib
import os
import platform
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from skimage import data

from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.simulation.scene import polarization_from_rgb

REFERENCE = "9869284915ce1dd18a56fc4ec597740599d363e501ed495aeb257b6b2cc06773"
OLD_PROCESSOR = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "ATEN_CPU_CAPABILITY": "default",
    "ONEDNN_MAX_CPU_ISA": "SSE41",
    "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,FP16,AVX",
    "NUMBA_CPU_NAME": "generic",
    "NUMBA_CPU_FEATURES": "",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX2,-FMA,-AVX",
}
"""Variables that keep numpy, torch, oneDNN, OpenCV, numba and the C library from AVX and FMA."""


def newer_instructions() -> list[str]:
    """Libraries that say in this process that they use AVX2, FMA or AVX-512."""
    from numpy._core._multiarray_umath import __cpu_features__ as features

    opencv = cv2.getCPUFeaturesLine().replace("*", "").split()  # the line marks disabled ones: AVX2?
    uses = {
        "numpy": any(features[one] for one in ("X86_V3", "X86_V4", "AVX512_ICL", "AVX512_SPR")),
        "torch": torch.backends.cpu.get_cpu_capability() != "DEFAULT",
        "OpenCV": "AVX2" in opencv,
    }
    return [library for library, newer in uses.items() if newer]


def hash_of_values() -> str:
    """SHA-256 of a generated picture with 8 bits, and of S0, DoLP and AoLP of a photograph."""
    picture = np.round(255 * dead_leaves(np.random.default_rng(1), 120, 180)).astype(np.uint8)
    photograph = torch.from_numpy(data.coffee()).permute(2, 0, 1).float() / 255
    return hashlib.sha256(picture.tobytes() + polarization_from_rgb(photograph).numpy().tobytes()).hexdigest()


def test_the_bytes_are_those_of_the_reference():
    assert hash_of_values() == REFERENCE


@pytest.mark.thorough
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the settings are those of x86-64")
def test_the_bytes_are_the_same_on_a_processor_without_avx_and_fma(tmp_path):
    script = "from test_same_bytes import *; print(newer_instructions(), hash_of_values())"
    paths = os.pathsep.join([os.path.dirname(__file__), *sys.path])
    variables = {**os.environ, **OLD_PROCESSOR, "PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", script], env=variables, stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout.split() == ["[]", REFERENCE]
