"""Named presets in conf/: overrides that Hydra reads directly and DVC reads through params.yaml."""

import functools
import operator
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq

from polarnet.runtime.files import replaced

MAPPINGS = ("randomise",)
"""Keys whose value is a whole mapping; a preset replaces it."""

BASE = {"experiment": "demo", "sensor": "default", "polarizers": "ideal"}
"""Base preset of each group (a folder of conf/).

It sets every value that another preset of the group changes, so no value of an earlier preset remains.
"""


def stage_names(root: Path) -> list[str]:
    """Names of the stages in dvc.yaml, in the order of the file, which is the order of execution.

    A stage with `foreach` gives one name, STAGE@ITEM, for each key or item of its section of params.yaml.
    """
    yaml = YAML(typ="safe")
    params = yaml.load(root / "params.yaml")
    names = []
    for stage, content in yaml.load(root / "dvc.yaml")["stages"].items():
        if "foreach" not in content:
            names.append(stage)
            continue
        keys = content["foreach"].removeprefix("${").removesuffix("}").split(".")
        names += [f"{stage}@{item}" for item in functools.reduce(operator.getitem, keys, params)]
    return names


def preset_names(root: Path, group: str) -> list[str]:
    """Names of the presets of a group (`experiment`, `sensor`, `polarizers`) in the project at `root`."""
    return sorted(path.stem for path in (root / "conf" / group).glob("*.yaml"))


def preset_values(root: Path, group: str, name: str) -> dict[str, Any]:
    """Values of one preset by dotted key, with those of the presets under its `defaults` (Hydra's defaults list)."""
    content = YAML(typ="safe").load(root / "conf" / group / f"{name}.yaml") or {}
    values: dict[str, Any] = {}
    for other in content.pop("defaults", ()):
        values |= {} if other == "_self_" else preset_values(root, group, other)
    return values | _flat(content)


def group_of(root: Path, name: str) -> str:
    """Group that contains a preset of this name; a ValueError lists the existing presets."""
    names = {group: preset_names(root, group) for group in BASE}
    for group, of_group in names.items():
        if name in of_group:
            return group
    listed = "; ".join(f"{group}: {', '.join(of_group)}" for group, of_group in names.items())
    raise ValueError(f"no preset {name!r}; there are {listed}")


def write_preset(root: Path, name: str) -> list[str]:
    """Write the base preset of the group and then the preset `name` into params.yaml, keeping its comments.

    Returns the changes as "key: old -> new". Keys outside the presets of the group keep their values, so a sensor can
    be written after an experiment.
    """
    yaml = YAML()
    yaml.preserve_quotes = True
    yaml.width = 120
    yaml.representer.add_representer(type(None), lambda r, _: r.represent_scalar("tag:yaml.org,2002:null", "null"))
    path, group = root / "params.yaml", group_of(root, name)
    params = yaml.load(path)
    changed = []
    for key, value in {**preset_values(root, group, BASE[group]), **preset_values(root, group, name)}.items():
        *sections, last = key.split(".")
        node = params
        for section in sections:
            node = node[section]
        if last not in node:
            raise ValueError(f"{group} {name!r} sets {key}, which params.yaml does not have")
        if node[last] != value:
            changed.append(f"{key}: {node[last]} -> {value}")
            node[last] = _in_style(value)
    with replaced(path) as temporary:
        yaml.dump(params, temporary)
    return changed


def _in_style(value: Any) -> Any:
    """Lists in flow style, such as [1, 2], as everywhere in params.yaml; also those in a mapping."""
    if isinstance(value, dict):
        return CommentedMap({key: _in_style(one) for key, one in value.items()})
    if not isinstance(value, list):
        return value
    line = CommentedSeq(value)
    line.fa.set_flow_style()
    return line


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict) and key not in MAPPINGS:
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
