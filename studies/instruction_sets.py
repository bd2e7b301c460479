"""Restriction of numpy, torch, oneDNN, OpenCV, numba and the C library to older instructions of an x86-64 processor.

A setting names the highest level that some of these libraries may use: SSE, AVX2 (with FMA) or AVX-512.
`checked_levels` asks each library, in a process under the setting, which instructions it uses.
"""

import ctypes
import functools
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VARIABLES: Mapping[str, Mapping[str, Mapping[str, str]]] = {
    "numpy": {
        "AVX2": {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"},
        "SSE": {"NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"},
    },
    "torch": {"AVX2": {"ATEN_CPU_CAPABILITY": "avx2"}, "SSE": {"ATEN_CPU_CAPABILITY": "default"}},
    "oneDNN": {"AVX2": {"ONEDNN_MAX_CPU_ISA": "AVX2"}, "SSE": {"ONEDNN_MAX_CPU_ISA": "SSE41"}},
    "OpenCV": {
        "AVX2": {"OPENCV_CPU_DISABLE": "AVX512-SKX"},
        "SSE": {"OPENCV_CPU_DISABLE": "AVX512-SKX,AVX2,FP16,AVX"},
    },
    "numba": {
        "AVX2": {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ""},
        "SSE": {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
    },
    "C library": {
        "AVX2": {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL"},
        "SSE": {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX2,-FMA,-AVX"},
    },
}
"""Environment variables that keep a library from instructions above a level."""
SETTINGS: Mapping[str, Mapping[str, str]] = {
    "everything without AVX-512": dict.fromkeys(VARIABLES, "AVX2"),
    "everything without AVX and FMA": dict.fromkeys(VARIABLES, "SSE"),
    "numpy and OpenCV": {"numpy": "SSE", "OpenCV": "SSE"},
    "torch": {"torch": "SSE"},
    "numba and the C library": {"numba": "SSE", "C library": "SSE"},
}
"""Highest level of the libraries that a setting restricts."""
LEVELS = ("SSE", "AVX2", "AVX-512")


class _Leaf(ctypes.Structure):
    """Answer of the C library on a group of features: those of the processor, and those that it uses."""

    _fields_ = (("cpuid", ctypes.c_uint32 * 4), ("active", ctypes.c_uint32 * 4))


def _c_library_uses() -> list[bool]:
    """Whether glibc uses FMA and AVX2, and whether it uses AVX-512F."""
    leaf = ctypes.CDLL(None).__x86_get_cpuid_feature_leaf
    leaf.restype, leaf.argtypes = ctypes.POINTER(_Leaf), [ctypes.c_uint]
    fma = leaf(0).contents.active[2] >> 12 & 1
    avx2, avx512 = (leaf(1).contents.active[1] >> bit & 1 for bit in (5, 16))
    return [bool(fma or avx2), bool(avx512)]


def print_levels() -> None:
    """Print the level that each library says it uses in this process; oneDNN prints its own."""
    import cv2  # here, because the tables of the docs need only the names above
    import torch
    from numba.core.registry import cpu_target
    from numpy._core._multiarray_umath import __cpu_features__ as features

    torch.conv2d(torch.zeros(4, 32, 32, 32), torch.zeros(32, 32, 3, 3))
    capability, opencv = torch.backends.cpu.get_cpu_capability(), cv2.getCPUFeaturesLine().replace("*", "").split()
    _, name, listed = cpu_target.target_context.codegen().magic_tuple()
    uses = {
        "numpy": [features["X86_V3"], any(features[one] for one in ("X86_V4", "AVX512_ICL", "AVX512_SPR"))],
        "torch": [capability != "DEFAULT", capability == "AVX512"],
        "OpenCV": ["AVX2" in opencv, "AVX512-SKX" in opencv],  # the line marks disabled ones: AVX2?
        "numba": [name == "haswell" or "+avx2" in listed.split(","), "+avx512f" in listed.split(",")],
        "C library": _c_library_uses(),
    }
    print(json.dumps({library: LEVELS[2 if above[1] else int(above[0])] for library, above in uses.items()}))


def environment(setting: Mapping[str, str]) -> dict[str, str]:
    """Variables of a process under a setting."""
    variables = {key: value for one, level in setting.items() for key, value in VARIABLES[one][level].items()}
    return {**os.environ, **variables, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}


def levels(setting: Mapping[str, str], then: str = "") -> dict[str, str]:
    """The level that each library says it uses in a process under a setting, which afterwards runs the code `then`."""
    script = f"from studies.instruction_sets import print_levels; print_levels(); {then}"
    command, variables = [sys.executable, "-c", script], {**environment(setting), "ONEDNN_VERBOSE": "1"}
    printed = subprocess.run(command, env=variables, stdout=subprocess.PIPE, text=True, check=True).stdout
    (isa,) = re.findall(r"cpu,isa:Intel (\S+)", printed)
    (found,) = (json.loads(line) for line in printed.splitlines() if line.startswith("{"))
    found["oneDNN"] = "SSE" if isa == "SSE4.1" else isa
    return {library: found[library] if found[library] in LEVELS else "AVX-512" for library in VARIABLES}


@functools.cache
def default_levels() -> dict[str, str]:
    """`levels` without a setting."""
    return levels({})


def checked_levels(setting: Mapping[str, str], then: str = "") -> dict[str, str]:
    """`levels` under a setting; RuntimeError if the setting does not restrict the libraries as it says."""
    default, used = default_levels(), levels(setting, then)
    expected = {one: min(level, setting.get(one, level), key=LEVELS.index) for one, level in default.items()}
    if used != expected:
        raise RuntimeError(f"expected the levels {expected} under the setting {dict(setting)}, got {used}")
    return used
