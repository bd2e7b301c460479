"""Named presets in conf/: overrides that Hydra reads directly and DVC reads through params.yaml."""

import subprocess
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.representer import RoundTripRepresenter

from polarnet.runtime.files import replaced
from polarnet.terminal.installation import shipped_settings

MAPPINGS = ("randomise",)
"""Keys whose value is a whole mapping; a preset replaces it."""

GROUPS = ("experiment", "sensor", "polarizers")
"""Folders of conf/ whose presets can be written into params.yaml."""


class WithNulls(RoundTripRepresenter):
    """Writes null where ruamel leaves a blank."""


WithNulls.add_representer(type(None), lambda r, _: r.represent_scalar("tag:yaml.org,2002:null", "null"))


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
    names = {group: preset_names(root, group) for group in GROUPS}
    for group, of_group in names.items():
        if name in of_group:
            return group
    listed = "; ".join(f"{group}: {', '.join(of_group)}" for group, of_group in names.items())
    raise ValueError(f"no preset {name!r}; there are {listed}")


def write_preset(root: Path, name: str) -> list[str]:
    """Write the preset `name` into params.yaml, keeping its comments.

    A preset holds only what differs. Keys that other presets of the group set go back to their values in the committed
    params.yaml (in a project without git: in the one that came with polarnet); all other keys keep their values. An
    experiment takes back sensors and polarizers, too. Returns the changes as "key: old -> new".
    """
    yaml = YAML()
    yaml.preserve_quotes = True
    yaml.width = 120
    yaml.Representer = WithNulls
    path, group = root / "params.yaml", group_of(root, name)
    params = yaml.load(path)
    changed = []
    undone = GROUPS if group == "experiment" else (group,)
    others = (preset_values(root, one, other) for one in undone for other in preset_names(root, one))
    base = _original(root)
    values = {key: _value(base, key) for other in others for key in other} | preset_values(root, group, name)
    for key, value in values.items():
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


def _original(root: Path) -> Any:
    """params.yaml as last committed, or as it came with polarnet."""
    committed = subprocess.run(["git", "show", "HEAD:./params.yaml"], cwd=root, capture_output=True, text=True)
    if committed.returncode == 0:
        return YAML(typ="safe").load(committed.stdout)
    return YAML(typ="safe").load(shipped_settings() / "params.yaml")


def _value(params: Any, key: str) -> Any:
    """Value of a dotted key; None if there is none."""
    for part in key.split("."):
        params = params.get(part) if isinstance(params, dict) else None
    return params


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
