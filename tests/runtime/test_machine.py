"""Seeds, devices and threads; importing polarnet leaves process and files as they were."""

import dataclasses
import json
import os
import platform
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from polarnet.runtime import machine as runtime
from polarnet.runtime.machine import RuntimeConfig, device_of, generator_for, keep_freed_memory, precision_on, seed_for

RUNTIME = RuntimeConfig(device="cpu", threads=1, workers=1, devices=1)


def test_a_seed_depends_on_its_three_parts_alone_and_is_pinned_for_ever():
    assert seed_for(1, "coffee", "motion") == seed_for(1, "coffee", "motion")
    assert len({seed_for(1, "coffee", "motion"), seed_for(2, "coffee", "motion"), seed_for(1, "cat", "motion"),
                seed_for(1, "coffee", "events")}) == 4  # fmt: skip
    assert seed_for(1, "1a", "b") != seed_for(11, "a", "b")
    assert generator_for(1, "coffee", "motion").integers(0, 1000, 4).tolist() == [260, 379, 998, 973]
    assert seed_for(0, "", "") == 14014920894283999531


def test_a_missing_gpu_is_refused_with_the_way_out():
    with pytest.raises(ValueError, match="use device=cpu"):
        device_of(dataclasses.replace(RUNTIME, device="cuda:99"))


@pytest.mark.parametrize(("units", "precision"), [([], "fp32"), (["AMX"], "bf16")])
def test_automatic_precision_is_bf16_only_where_the_device_has_units_for_it(monkeypatch, units, precision):
    monkeypatch.setattr(runtime, "bf16_units", lambda device: units)
    cpu = torch.device("cpu")
    assert [precision_on(cpu, asked) for asked in ("auto", "fp32", "bf16")] == [precision, "fp32", "bf16"]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators are left as they are")
def test_a_large_array_takes_the_memory_of_the_one_before():
    keep_freed_memory()
    bytes_each = 2**26
    np.ones(bytes_each, np.uint8)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(bytes_each, np.uint8)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before < bytes_each / resource.getpagesize() / 4


def test_a_task_on_one_thread_leaves_the_threads_of_its_process_as_they_were():
    torch.set_num_threads(2)
    assert runtime.on_one_thread(lambda item: (item, torch.get_num_threads()), "coffee") == ("coffee", 1)
    assert torch.get_num_threads() == 2


IMPORT_EVERYTHING = """
import importlib, json, os, pkgutil, sys
import torch, numba, cv2, zarr, hydra, matplotlib.figure, OpenImageIO, scipy.optimize  # they may set what they like
torch.set_num_threads(2)  # until it is set, the number follows the load of the machine
REMOVED = []
sys.addaudithook(lambda event, arguments: event in ("os.remove", "os.rename", "os.rmdir") and REMOVED.append(arguments))

def modes():
    return [
        torch.get_num_threads(), torch.is_deterministic_algorithms_warn_only_enabled(), torch.get_default_dtype(),
        torch.get_deterministic_debug_mode(), torch.is_grad_enabled(), torch.backends.cudnn.benchmark,
        torch.get_float32_matmul_precision(), torch.utils.deterministic.fill_uninitialized_memory,
        (torch.full((1,), 1e-40) * 1).item(), numba.get_num_threads(), cv2.getNumThreads(), torch.initial_seed(),
        sorted(hydra.core.config_store.ConfigStore.instance().repo),
    ]

before, was = dict(os.environ), str(modes())
import polarnet
modules = [module.name for module in pkgutil.walk_packages(polarnet.__path__, "polarnet.")]
for name in modules:
    if not name.endswith(("_tasks", "__main__")):  # the tasks of other processes, and a program
        importlib.import_module(name)
own = [str(paths[0]) for paths in REMOVED if ".pyc" not in str(paths[0])]
changed = sorted({*before.items()} ^ {*os.environ.items()})
state = {"modules": len(modules), "environment": changed, "removed": own, "before": was, "after": str(modes())}
print(json.dumps(state))
"""


@pytest.mark.thorough
def test_importing_every_module_changes_no_variable_no_file_and_no_mode():
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("OMP", "GOMP"))}
    command = [sys.executable, "-c", IMPORT_EVERYTHING]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    state = json.loads(done.stdout)
    assert state["modules"] > 100
    assert (state["environment"], state["removed"], state["after"]) == ([], [], state["before"])


@pytest.mark.parametrize("package", ["stages", "studies", "polarnet.cli"])
def test_a_program_decides_how_threads_wait_before_torch_is_there(package, project_root):
    call = "; polarnet.cli.main(['preset', 'none'])" if package == "polarnet.cli" else ""
    script = f"import os, sys, {package}{call}; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("OMP", "GOMP"))}
    environment["PYTHONPATH"] = str(Path.cwd())
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=project_root, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "passive False"
    environment["OMP_WAIT_POLICY"] = "active"  # that of the user stays
    done = subprocess.run(command, cwd=project_root, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "active False"
