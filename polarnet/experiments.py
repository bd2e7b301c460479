"""Named experiments: sets of overrides in conf/experiment, for Hydra as they are and for DVC through params.yaml."""

from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

BASE = "demo"  # names every value that any experiment changes, so that one experiment never leaks into the next


def stage_names(root: Path) -> list[str]:
    """The stages of dvc.yaml in the order they are written there, which is the order they run in."""
    return list(YAML(typ="safe").load(root / "dvc.yaml")["stages"])


def experiment_names(root: Path) -> list[str]:
    """The named experiments of the project at `root`."""
    return sorted(path.stem for path in (root / "conf" / "experiment").glob("*.yaml"))


def experiment_values(root: Path, name: str) -> dict[str, Any]:
    """The values of one experiment by dotted key; ValueError that lists the experiments there are."""
    path = root / "conf" / "experiment" / f"{name}.yaml"
    if not path.exists():
        raise ValueError(f"no experiment {name!r}; there are {', '.join(experiment_names(root))}")
    return _flat(YAML(typ="safe").load(path) or {})


def write_preset(root: Path, name: str) -> list[str]:
    """Write the base experiment's values and then those of `name` into params.yaml, keeping its comments.

    Returns the changes as "key: old -> new". Keys that no experiment names keep what the user gave them.
    """
    yaml = YAML()
    yaml.preserve_quotes = True
    yaml.width = 120
    yaml.representer.add_representer(type(None), lambda r, _: r.represent_scalar("tag:yaml.org,2002:null", "null"))
    path = root / "params.yaml"
    params = yaml.load(path)
    changed = []
    for key, value in {**experiment_values(root, BASE), **experiment_values(root, name)}.items():
        *sections, last = key.split(".")
        node = params
        for section in sections:
            node = node[section]
        if last not in node:
            raise ValueError(f"experiment {name!r} sets {key}, which params.yaml does not have")
        if node[last] != value:
            changed.append(f"{key}: {node[last]} -> {value}")
            node[last] = value
    temporary = path.with_suffix(".yaml.tmp")
    with temporary.open("w") as file:
        yaml.dump(params, file)
    temporary.replace(path)
    return changed


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
