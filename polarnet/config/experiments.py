"""Presets of conf/ and overrides of a command line, checked before Hydra reads them or written into params.yaml."""

import functools
import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.representer import RoundTripRepresenter

from polarnet.runtime.files import replaced
from polarnet.runtime.sections import unknown_key
from polarnet.terminal.installation import shipped_settings
from polarnet.terminal.suggestions import did_you_mean

MAPPINGS = ("randomise",)
"""Keys whose value is a whole mapping; a preset replaces it."""

GROUPS = ("experiment", "sensor", "polarizers")
"""Folders of conf/ whose presets can be written into params.yaml."""
MAX_DEPTH = 20
MAX_VALUES = 10_000  # of params.yaml; it has some hundred


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
    if groups := [group for group, of_group in names.items() if name in of_group]:
        return groups[0]
    listed = "; ".join(f"{group}: {', '.join(of_group)}" for group, of_group in names.items())
    near = did_you_mean(name, [preset for of_group in names.values() for preset in of_group])
    raise ValueError(f"no preset {name!r}; there are {listed}{near}")


def write_preset(root: Path, name: str) -> list[str]:
    """Write the preset `name` into params.yaml, keeping its comments.

    A preset holds only what differs. Keys that other presets of the group set go back to their values in the committed
    params.yaml (in a project without git: in the one that came with polarnet); all other keys keep their values. An
    experiment takes back sensors and polarizers, too. Returns the changes as "key: old -> new".
    """
    yaml = YAML()
    yaml.preserve_quotes = True
    yaml.width = 120
    yaml.default_flow_style = None  # lists as [1, 2], as everywhere in params.yaml
    yaml.Representer = WithNulls
    path, group = root / "params.yaml", group_of(root, name)
    params, base = yaml.load(path), _original_values(root)
    undone = GROUPS if group == "experiment" else (group,)
    others = (preset_values(root, one, other) for one in undone for other in preset_names(root, one))
    values = {key: base.get(key) for other in others for key in other} | preset_values(root, group, name)
    changed = []
    for key, value in values.items():
        *sections, last = key.split(".")
        node = functools.reduce(lambda node, section: node[section], sections, params)
        if last not in node:
            raise ValueError(f"{group} {name!r} sets {key}, which params.yaml does not have")
        if node[last] != value:
            changed.append(f"{key}: {node[last]} -> {value}")
            node[last] = value
    with replaced(path) as temporary:
        yaml.dump(params, temporary)
    return changed


def changed_values(root: Path) -> list[str]:
    """Values of params.yaml that differ from the committed ones, as overrides KEY=VALUE.

    In a project without git: from those that came with polarnet.
    """
    values, base = _flat(YAML(typ="safe").load(root / "params.yaml")), _original_values(root)
    changed = {key: value for key, value in values.items() if key not in base or base[key] != value}
    # JSON without quotes is what Hydra reads
    return [f"{key}={json.dumps(value, ensure_ascii=False)}".replace('"', "") for key, value in changed.items()]


def _original_values(root: Path) -> dict[str, Any]:
    """Values by dotted key of the committed params.yaml, else of the one that came with polarnet."""
    committed = subprocess.run(["git", "show", "HEAD:./params.yaml"], cwd=root, capture_output=True, text=True)
    original = shipped_settings() / "params.yaml" if committed.returncode else committed.stdout
    return _flat(YAML(typ="safe").load(original))


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict) and key not in MAPPINGS:
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def check_overrides(settings: type, root: Path, overrides: list[str], presets: Path | None = None) -> None:
    """ValueError, with those there are, for an override of an unknown key or for an unknown choice of a group."""
    _check_params(settings, root / "params.yaml")
    groups = {path.name for path in (root / "conf").iterdir() if path.is_dir()}
    for override in overrides:
        key, _, value = override.partition("=")
        key = key.lstrip("+~").split("@")[0]
        if key in groups:
            _check_choices([root, presets] if presets else [root], key, value)
        elif not key.startswith(("hydra.", "hydra/")) and (refusal := unknown_key(settings, key.split("."), groups)):
            raise ValueError(refusal)


def _check_params(settings: type, file: Path) -> None:
    """ValueError if a params.yaml holds more than values: it may come from a stranger, and Hydra reads it whole.

    A key `hydra` could make Hydra write into any file, an interpolation could print a secret, a comment `@package`
    could move the file elsewhere, and a few aliases of aliases make billions of values.
    """
    try:
        text, yaml = file.read_text(encoding="utf-8"), YAML(typ="safe", pure=True)
        root = yaml.compose(text)
        nodes = [] if root is None else [(0, root)]
        for depth, node in nodes:  # grows while it is read, every alias written out
            items = node.value if isinstance(node.value, list) else []
            nodes += [(depth + 1, part) for item in items for part in (item if isinstance(item, tuple) else (item,))]
            if len(nodes) > MAX_VALUES or depth > MAX_DEPTH:
                raise ValueError(f"expected at most {MAX_VALUES} values, {MAX_DEPTH} deep, its aliases make more")
        content = None if root is None else yaml.constructor.construct_document(root)
        if not isinstance(content, dict):
            raise ValueError("expected sections")
    except (ValueError, YAMLError, RecursionError) as error:
        raise ValueError(f"{file} is not a file of values: {' '.join(str(error).split())}") from None
    for beyond in ("${", "@package"):
        if beyond in f"{text}{content}":  # in the content, too, because YAML has escapes for any letter
            raise ValueError(f"{file}: expected plain values without Hydra's {beyond!r}; remove it")
    for key in content:
        if refusal := unknown_key(settings, [str(key)]):
            raise ValueError(f"{file}: {refusal}")


def _check_choices(roots: Sequence[Path], group: str, value: str) -> None:
    """Raise ValueError if a name for `group`, alone or in a list, is that of no file.

    Other Hydra syntax, such as glob(...), is left to Hydra to check.
    """
    known = sorted({name for root in roots for name in preset_names(root, group)})
    for name in (word.strip("[]'\" ") for word in value.split(",") if "(" not in value):
        if name not in ("null", *known):
            near = did_you_mean(name, known)
            raise ValueError(f"{group}: there is no {name!r}; conf/{group} has {', '.join(known)}{near}")
