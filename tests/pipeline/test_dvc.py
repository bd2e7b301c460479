"""dvc.yaml: a stage depends on the code that makes its outputs, and on no other."""

from pathlib import Path

import grimp
import pytest
from ruamel.yaml import YAML

from polarnet.config.experiments import stage_names
from polarnet.training.baselines import USERS

# What starts a stage and checks its values decides no output; listing it would re-run everything at each new setting.
PLUMBING = {"polarnet", "polarnet.config.tree", "polarnet.runtime.cluster"}


@pytest.fixture(scope="module")
def imports() -> grimp.ImportGraph:
    return grimp.build_graph("polarnet", "stages", cache_dir=None)


def modules_behind(stage: str, imports: grimp.ImportGraph) -> set[str]:
    found: set[str] = set()
    waiting = [f"stages.{stage}"]
    while waiting:
        module = waiting.pop()
        if module not in found | PLUMBING:
            found.add(module)
            if module == "polarnet.methods":  # assembles its modules by name
                waiting += imports.find_children(module)
            waiting += imports.find_modules_directly_imported_by(module)
    return found


def test_every_module_that_a_stage_imports_is_among_its_dependencies_and_nothing_else(project_root, imports):
    stages = YAML(typ="safe").load(project_root / "dvc.yaml")["stages"]
    for stage in stage_names(project_root):
        needed = modules_behind(stage, imports)
        code = [
            dep
            for dep in stages[stage]["deps"]
            if dep.startswith(("polarnet/", "stages/")) and not dep.endswith(".jinja")
        ]
        listed = {module for dep in code for module in _modules(project_root, dep)}
        assert needed <= listed, f"{stage}: dvc.yaml lacks {sorted(needed - listed)}"
        assert listed <= needed | _packages(listed), f"{stage}: {listed - needed}"


def test_a_change_of_network_loss_metric_or_figure_never_reruns_the_simulation(project_root, imports):
    for stage in ("ingest", "synthesize", "emulate"):
        behind = modules_behind(stage, imports)
        for package in ("networks", "training", "similarity", "lpips", "evaluation", "reports", "methods"):
            assert not any(module.startswith(f"polarnet.{package}") for module in behind), (stage, package)


def test_another_row_of_the_benchmark_trains_a_baseline_only_if_it_uses_one(project_root):
    stages = YAML(typ="safe").load(project_root / "dvc.yaml")["stages"]
    assert "benchmark.methods" in stages["baselines"]["params"]
    for baseline in USERS:
        training = stages[f"train_{baseline}"]
        assert f"data/baselines/{baseline}.json" in training["deps"]
        assert f"data/baselines/{baseline}.json" in stages["baselines"]["outs"]
        assert not any(param.startswith(("benchmark", "methods")) for param in training["params"])
        assert {f"methods.{row}.weights" for row in USERS[baseline]} <= {*stages["baselines"]["params"]}
        assert not [dep for dep in training["deps"] if dep.startswith("data/baselines") and baseline not in dep]


def _modules(root: Path, dependency: str) -> set[str]:
    path = root / dependency
    files = path.rglob("*.py") if path.is_dir() else [path]
    names = {".".join(file.relative_to(root).with_suffix("").parts) for file in files}
    assert names, f"{dependency} is not there"
    return {name.removesuffix(".__init__") for name in names}


def _packages(modules: set[str]) -> set[str]:
    """The folders themselves, whose __init__ is a docstring."""
    return {module for module in modules if any(other.startswith(f"{module}.") for other in modules)}
