"""Overrides of a command line, checked before Hydra reads them, so that a message lists keys and choices."""

import fnmatch
import functools
import math
import re
from collections.abc import Sequence
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.nodes import Node

from polarnet.config.experiments import preset_names
from polarnet.runtime.sections import unknown_key

MAX_VALUES = 10_000  # of params.yaml; it has some hundred
CHOICES = re.compile(r"(?:glob\()?([^()=]*)\)?")


def check_overrides(settings: type, root: Path, overrides: list[str], presets: Path | None = None) -> None:
    """Raise ValueError for an override of a key that `settings` lacks, or of a group that has no such choice.

    The groups are `experiment`, `sensor`, `polarizers` and `ablation`. Hydra refuses both as well, but this message
    lists the available keys and choices.
    """
    file = root / "params.yaml"
    if (values := _values_of(file.read_text(encoding="utf-8"))) > MAX_VALUES:
        raise ValueError(f"{file}: expected at most {MAX_VALUES} values, its aliases make {values:g}")
    groups = {path.name for path in (root / "conf").iterdir() if path.is_dir()}
    for override in overrides:
        key, _, value = override.partition("=")
        key = key.lstrip("+~").split("@")[0]
        if key in groups:
            _check_choices([root, presets] if presets else [root], key, value)
        elif not key.startswith(("hydra.", "hydra/")) and (refusal := unknown_key(settings, key.split("."))):
            raise ValueError(refusal)


@functools.lru_cache(maxsize=4)
def _values_of(text: str) -> int | float:
    """Number of values in a YAML text, with every alias written out: a few lines can make billions."""
    sizes: dict[int, int | float] = {}

    def size(node: Node) -> int | float:
        if id(node) not in sizes:
            sizes[id(node)] = math.inf  # for an alias of a node inside itself
            items = node.value if isinstance(node.value, list) else []
            parts = (part for item in items for part in (item if isinstance(item, tuple) else (item,)))
            sizes[id(node)] = 1 + sum(map(size, parts))
        return sizes[id(node)]

    root = YAML(typ="safe", pure=True).compose(text)
    return 0 if root is None else size(root)


def _check_choices(roots: Sequence[Path], group: str, value: str) -> None:
    """Raise ValueError if a name or pattern for `group`, alone, in a list or in glob(...), matches no file.

    Other Hydra syntax, such as choice(...), is left to Hydra to check.
    """
    known = sorted({name for root in roots for name in preset_names(root, group)})
    plain = CHOICES.fullmatch(value)
    for name in (word.strip("[]'\" ") for word in (plain[1].split(",") if plain else [])):
        if not fnmatch.filter(["null", *known], name):
            raise ValueError(f"{group}: there is no {name!r}; conf/{group} has {', '.join(known)}")
