"""Add two baselines to a fresh clone and count what that takes: python -m studies.new_baselines [--write]

The clone of the committed project runs its pipeline at smoke size. Then one commit adds a baseline with a file of
weights and a second commit one that the pipeline trains. For each, the study counts the files that the commit touches
in the package and its configuration, and lists the stages that `dvc repro` runs; a further `dvc repro` must run none.
--write puts the figures into docs/results/house.json.
"""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from ruamel.yaml import YAML

from polarnet.networks.e2v.firenet import FireNet
from studies.clones import commit, dvc, executed, reproduced
from studies.house import touched_files
from studies.measure import ROOT, arguments_of, command_line, machine_record, write_section

CALM_NETWORK = '''"""FireNet with half its contrast."""

from polarnet.networks.e2v.firenet import FireNet


class CalmFireNet(FireNet):
    """FireNet, its intensity drawn halfway towards 0.5."""

    label = "FireNet with half its contrast"

    def forward(self, voxels, state=None):
        intensity, state = super().forward(voxels, state)
        return 0.5 + (intensity - 0.5) / 2, state
'''
CALM_METHOD = '''"""FireNet with half its contrast and published weights."""

from polarnet.methods.intensity_network import intensity_methods
from polarnet.networks.calm_firenet import CalmFireNet

METHODS = intensity_methods(
    "calm_firenet", "FireNet, half contrast", "#777777", {"calm_firenet": CalmFireNet}, sharpened=True
)
'''
SMALL_NETWORK = '''"""FireNet with one recurrent layer."""

from torch.nn import functional as F

from polarnet.networks.e2v.firenet import FireNet


class SmallFireNet(FireNet):
    """FireNet without its second recurrent layer and second residual block."""

    label = "FireNet with one recurrent layer"

    def __init__(self, bins):
        super().__init__(bins)
        del self.G2, self.R2

    def forward(self, voxels, state=None):
        x = F.relu(self.head(voxels))
        after = self.G1(x, state[0] if state else None)
        return self.pred(self.R1(after))[:, 0].float(), [after]
'''
SMALL_METHOD = '''"""FireNet with one recurrent layer, trained by the pipeline."""

from polarnet.methods.intensity_network import intensity_methods
from polarnet.networks.small_firenet import SmallFireNet

METHODS = intensity_methods(
    "small_firenet", "FireNet, one recurrent layer", "#777777", {"small_firenet": SmallFireNet},
    trained_by="small_firenet",
)
'''
SMALL_TRAINING = '''"""Training task of FireNet with one recurrent layer: that of E2V with another network."""

import dataclasses

from polarnet.networks.small_firenet import SmallFireNet
from polarnet.training.e2v import E2vConfig, e2v_task
from polarnet.training.engine.task import Baseline, initialised


def task(config, lpips, seed):
    """The task of E2V with this network."""
    network = initialised(lambda: SmallFireNet(config.bins), seed)
    e2v = e2v_task(config, lpips, seed)
    description = e2v.description | {"network": "small_firenet"}
    return dataclasses.replace(e2v, network=network, unroll=network.unroll, description=description)


BASELINE = Baseline("small_firenet", E2vConfig, task, lpips=("lpips",))
'''


class Added(NamedTuple):
    """A baseline as a user would add it."""

    name: str
    files: Mapping[str, str]
    """Content of its modules, by path."""
    settings: Mapping[str, Any]
    """Value of `methods.NAME` in params.yaml."""
    needs: str
    trained: bool


PUBLISHED = Added(
    "calm_firenet",
    {"polarnet/networks/calm_firenet.py": CALM_NETWORK, "polarnet/methods/calm_firenet.py": CALM_METHOD},
    {"weights": "../calm_firenet.pth"},
    "polarnet/networks/calm_firenet.py",
    trained=False,
)
TRAINED = Added(
    "small_firenet",
    {
        "polarnet/networks/small_firenet.py": SMALL_NETWORK,
        "polarnet/methods/small_firenet.py": SMALL_METHOD,
        "polarnet/training/small_firenet.py": SMALL_TRAINING,
    },
    {"weights": None},
    "data/train/small_firenet",
    trained=True,
)


def add(clone: Path, added: Added) -> None:
    """Write the modules of a baseline and its keys in params.yaml."""
    for file, source in added.files.items():
        (clone / file).write_text(source)
    yaml, path, name = YAML(), clone / "params.yaml", added.name
    params = yaml.load(path)
    params["methods"][name] = dict(added.settings)
    module = f"polarnet/methods/{name}.py"
    params["rows"][name] = {"module": module, "needs": added.needs, "settings": f"methods.{name}"}
    if added.trained:
        params["baselines"][name] = dict(params["baselines"]["e2v"])
        params["baselines"]["trained"].append(name)
    yaml.dump(params, path)


def measured(clone: Path, added: Added) -> dict[str, Any]:
    """Files that the baseline touches, and the stages that `dvc repro` runs after it was added, and once more."""
    add(clone, added)
    ran = executed(dvc(clone, "repro"))
    commit(clone, f"baseline {added.name}")
    return {
        "baseline": added.name,
        "files": touched_files(clone, "HEAD"),
        "executed": ran,
        "executed_again": executed(dvc(clone, "repro")),
    }


def main() -> None:
    """Measure both, print and perhaps write."""
    options = arguments_of(command_line(__doc__, "docs/results/house.json"))
    record = machine_record(ROOT)
    with tempfile.TemporaryDirectory() as folder:
        clone = reproduced(Path(folder), [])
        torch.save({"state_dict": FireNet(bins=5).state_dict()}, Path(folder) / "calm_firenet.pth")
        figures = {"published": measured(clone, PUBLISHED), "trained": measured(clone, TRAINED)}
    print(json.dumps(figures, indent=2))
    if options.write:
        print(f"wrote {write_section(ROOT, 'house', 'baselines', figures, record)}")


if __name__ == "__main__":
    main()
