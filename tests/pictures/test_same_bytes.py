"""Generated pictures and the polarization of photographs are the same bytes on every processor."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import torch
from skimage import data

from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.simulation.scene import polarization_from_rgb

OLDER_PROCESSOR = {
    "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,FMA3",
    "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX",
    "ATEN_CPU_CAPABILITY": "default",
    "ONEDNN_MAX_CPU_ISA": "SSE41",
    "NUMBA_CPU_NAME": "generic",
    "NUMBA_CPU_FEATURES": "",
}
"""Settings that keep each library from the newer instructions of this processor."""
REFERENCE = "9869284915ce1dd18a56fc4ec597740599d363e501ed495aeb257b6b2cc06773"


def hash_of_values() -> str:
    """SHA-256 of a generated picture with 8 bits, and of S0, DoLP and AoLP of a photograph."""
    picture = np.round(255 * dead_leaves(np.random.default_rng(1), 120, 180)).astype(np.uint8)
    photograph = torch.from_numpy(data.coffee()).permute(2, 0, 1).float() / 255
    return hashlib.sha256(picture.tobytes() + polarization_from_rgb(photograph).numpy().tobytes()).hexdigest()


def test_the_bytes_are_those_of_the_reference():
    assert hash_of_values() == REFERENCE


def test_the_bytes_are_the_same_on_an_older_processor(tmp_path):
    script = "import test_same_bytes; print(test_same_bytes.hash_of_values())"
    paths = os.pathsep.join([os.path.dirname(__file__), *sys.path])
    settings = {**os.environ, **OLDER_PROCESSOR, "PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", script], env=settings, stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout.strip() == REFERENCE
