"""Bytes of pictures, scenes, frames and events under other instruction sets and numbers of workers.

python -m studies.same_bytes [--write]

The stages ingest, synthesize and emulate make a set of smoke size, once with the default settings, once under each of
`SETTINGS`, and once with each of `WORKERS`. The files must be equal. `levels` proves that a setting takes effect: it
asks each library, in a process with these settings, which instructions it will use. --write puts the number of
settings with equal files into docs/results/reliability.json.
"""

import ctypes
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import torch
from numba.core.registry import cpu_target

from polarnet.runtime.files import sha256
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
STAGES = ("ingest", "synthesize", "emulate")
ARTEFACTS = ("images", "scenes.zarr", "frames.zarr", "events.zarr")
WORKERS = (2, 5)
SMALL = ("experiment=smoke", "storage.sequences_per_part=2")  # ten parts, so that five workers have work
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
"""Environment variables that keep a library from instructions above a level; AVX2 includes FMA, SSE does not."""
SETTINGS: Mapping[str, Mapping[str, str]] = {
    "everything without AVX-512": dict.fromkeys(VARIABLES, "AVX2"),
    "everything without AVX and FMA": dict.fromkeys(VARIABLES, "SSE"),
    "numpy and OpenCV": {"numpy": "SSE", "OpenCV": "SSE"},
    "torch": {"torch": "SSE"},
    "numba and the C library": {"numba": "SSE", "C library": "SSE"},
}
"""Highest level of the libraries that a setting restricts."""
ORDER = ("SSE", "AVX2", "AVX-512")


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
    print(json.dumps({library: ORDER[2 if above[1] else int(above[0])] for library, above in uses.items()}))


def environment(setting: Mapping[str, str], numba_cache: str) -> dict[str, str]:
    """Variables of a process under a setting; its compiled code goes into a folder of its own."""
    variables = {key: value for one, level in setting.items() for key, value in VARIABLES[one][level].items()}
    return {
        **os.environ,
        **variables,
        "NUMBA_CACHE_DIR": numba_cache,
        "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path]),
    }


def levels(setting: Mapping[str, str], numba_cache: str) -> dict[str, str]:
    """The level that each library says it uses in a process under a setting."""
    command = [sys.executable, "-c", "from studies.same_bytes import print_levels; print_levels()"]
    variables = {**environment(setting, numba_cache), "ONEDNN_VERBOSE": "1"}
    printed = subprocess.run(command, env=variables, stdout=subprocess.PIPE, text=True, check=True).stdout
    (isa,) = re.findall(r"cpu,isa:Intel (\S+)", printed)
    found = {**json.loads(printed.splitlines()[-1]), "oneDNN": "SSE" if isa == "SSE4.1" else isa}
    return {library: found[library] if found[library] in ORDER else "AVX-512" for library in VARIABLES}


def checked_levels(setting: Mapping[str, str], numba_cache: str) -> dict[str, str]:
    """`levels` under a setting; RuntimeError if the setting does not restrict a library as it says."""
    default, found = levels({}, numba_cache), levels(setting, numba_cache)
    expected = {one: min(level, setting.get(one, level), key=ORDER.index) for one, level in default.items()}
    if found != expected:
        raise RuntimeError(f"the setting {dict(setting)} has no effect: expected {expected}, got {found}")
    return found


def hashes(setting: Mapping[str, str], workers: int, scratch: Path) -> dict[str, str]:
    """SHA-256 of the names and bytes of all files of each artefact, made under a setting."""
    data, variables = scratch / "data", environment(setting, str(scratch / "numba"))
    for stage in STAGES:
        words = [*SMALL, f"paths.data={data}", f"runtime.workers={workers}", f"hydra.run.dir={scratch / stage}"]
        subprocess.run([sys.executable, "-m", f"stages.{stage}", *words], cwd=ROOT, env=variables, check=True)
    return {name: _hash(data / name) for name in ARTEFACTS}


def _hash(folder: Path) -> str:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return sha256(*(part for path in files for part in (path.relative_to(folder).as_posix().encode(), path)))


def compared() -> dict[str, dict[str, Any]]:
    """Rows of the table: workers, levels, and whether each artefact equals that of the default settings."""
    runs = {name: (setting, 1) for name, setting in SETTINGS.items()}
    runs |= {f"{workers} workers": ({}, workers) for workers in WORKERS}
    rows: dict[str, dict[str, Any]] = {}
    reference = None
    for name, (setting, workers) in {"default": ({}, 1), **runs}.items():
        with tempfile.TemporaryDirectory() as scratch:
            used = checked_levels(setting, scratch)
            found = hashes(setting, workers, Path(scratch))
        reference = reference or found
        same = {artefact: found[artefact] == reference[artefact] for artefact in ARTEFACTS}
        rows[name] = {"workers": workers, "levels": used, "same": same}
        print(name, json.dumps(rows[name]), flush=True)
    return rows


def main() -> None:
    """The command line."""
    arguments = arguments_of(command_line(__doc__, "docs/results/reliability.json"))
    record = machine_record(ROOT)
    rows = compared()
    equal = sum(all(rows[name]["same"].values()) for name in SETTINGS)
    print(f"{equal} of {len(SETTINGS)} settings give the same files")
    if arguments.write:
        headlines = {"isa_settings_equal": equal}
        print(write_section(ROOT, "reliability", "same_bytes", rows, record, headlines))


if __name__ == "__main__":
    main()
