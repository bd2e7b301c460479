"""Importing polarnet leaves the process and the files as they were; only its programs set anything."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

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


def test_importing_every_module_changes_no_variable_no_file_and_no_mode():
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("OMP", "GOMP"))}
    command = [sys.executable, "-c", IMPORT_EVERYTHING]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    state = json.loads(done.stdout)
    assert state["modules"] > 100
    assert (state["environment"], state["removed"], state["after"]) == ([], [], state["before"])


def test_importing_polarnet_loads_no_package(project_root):
    script = "import sys, polarnet; print(sorted({n.split('.')[0] for n in sys.modules} & {'torch', 'numpy', 'hydra'}))"
    done = subprocess.run([sys.executable, "-c", script], cwd=project_root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


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
