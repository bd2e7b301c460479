"""Origins: the values that each artefact was made with, kept beside it and compared by every stage that reads it.

dvc.yaml is the one list of what a stage reads (`params`, `deps`) and makes (`outs`), for DVC and for stages that a
person runs by hand. After a stage, each folder that it made holds `origin.json`: the values of its `params`, and those
of its inputs. Before a stage, the origins of its inputs are compared with its own configuration.
"""

import dataclasses
import functools
import json
import operator
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, NamedTuple

from ruamel.yaml import YAML

from polarnet.runtime.files import replaced, sha256

if TYPE_CHECKING:
    from polarnet.config.tree import Config

ORIGIN = "origin.json"
UNCOMPARED = ("rows",)
"""Keys that decide whether an artefact is made at all, not what it holds."""
TEMPLATE = re.compile(r"\$\{([^}]+)\}")
MAX_HASHED = 2**16  # bytes; larger files of a store or training have checksums in smaller ones
ABSENT = "nothing"

Origin = dict[str, Any]
"""Value by key of params.yaml, where a key may name a section."""


class Stage(NamedTuple):
    """A stage of dvc.yaml, with the values of the configuration in place of its templates."""

    name: str
    command: list[str]
    params: list[str]
    deps: list[str]
    outs: list[str]

    @property
    def script(self) -> str:
        """Name of the module in `stages`."""
        return self.command[2].removeprefix("stages.")

    @property
    def overrides(self) -> list[str]:
        """Overrides of its command, such as row=cf."""
        return self.command[3:]


def pipeline(root: Path, params: Mapping[str, Any]) -> dict[str, Stage]:
    """Stages of the dvc.yaml in `root` by name, in the order of the file, which is the order of execution.

    A stage with `foreach` becomes one stage, NAME@ITEM, for each item of a list or key of a mapping in `params`.
    """
    stages = {}
    for name, content in YAML(typ="safe").load(root / "dvc.yaml")["stages"].items():
        for item, values in _items(content, params):
            full = name if item is None else f"{name}@{item}"
            one = _filled(content.get("do", content), {**params, **values})
            outs = [*one.get("outs", ()), *(next(iter(out)) for out in one.get("metrics", ()))]
            stages[full] = Stage(full, shlex.split(one["cmd"]), one.get("params", []), one.get("deps", []), outs)
    return stages


def _items(content: Mapping[str, Any], params: Mapping[str, Any]) -> Iterator[tuple[str | None, dict[str, Any]]]:
    if "foreach" not in content:
        yield None, {}
        return
    items = _filled(content["foreach"], params)
    for item in items:
        yield item, {"key": item, "item": items[item] if isinstance(items, dict) else item}


def _filled(content: Any, values: Mapping[str, Any]) -> Any:
    """Replace the templates in all texts of `content`, as DVC does."""
    if isinstance(content, dict):
        return {key: _filled(value, values) for key, value in content.items()}
    if isinstance(content, list):
        return [_filled(value, values) for value in content]
    if not isinstance(content, str):
        return content
    if whole := TEMPLATE.fullmatch(content):
        return functools.reduce(operator.getitem, whole[1].split("."), values)
    return TEMPLATE.sub(lambda m: str(functools.reduce(operator.getitem, m[1].split("."), values)), content)


class Run:
    """The stages that one script runs with a configuration, their inputs and their origins."""

    def __init__(self, root: Path, config: "Config", script: str):
        self.config, self.values = config, dataclasses.asdict(config)
        self.pipeline = pipeline(root, self.values)
        chosen = {f"{key}={self.values[key]}" for key in ("row", "baseline") if self.values[key] is not None}
        of_script = [stage for stage in self.pipeline.values() if stage.script == script]
        exact = [stage for stage in of_script if set(stage.overrides) == chosen]
        self.stages = exact or ([] if chosen else of_script)  # without `row`, a script runs all rows

    def check_inputs(self) -> None:
        """ValueError for the first value that an input was not made with, with the command that makes it anew."""
        for dep in dict.fromkeys(dep for stage in self.stages for dep in stage.deps):
            origin = self.origin_of(dep)
            if origin and (change := self.change_since(origin)):
                key, was, now = change
                maker = self.maker_of(dep)
                raise ValueError(
                    f"{key}: {self.config.place(dep)} was made with {was}, this run has {now}; make it again with this "
                    f"value (`dvc repro {maker.name}` after an edit of params.yaml, or `{shlex.join(maker.command)} "
                    f"{key}={now}`), or run with {key}={was}"
                )

    def write_origins(self) -> None:
        """Write the origin of each folder that the stages made."""
        for stage in self.stages:
            origin: Origin = {}
            for dep in stage.deps:
                origin |= self.origin_of(dep) or {}
            for key in (key for key in stage.params if key not in UNCOMPARED):
                origin[key] = functools.reduce(operator.getitem, key.split("."), self.values)
            for folder in (path for path in map(self.config.place, stage.outs) if path.is_dir()):
                with replaced(folder / ORIGIN) as temporary:
                    temporary.write_text(json.dumps(origin, indent=1, sort_keys=True) + "\n", encoding="utf-8")

    def origin_of(self, artefact: str) -> Origin | None:
        """Values that an artefact was made with; None if it keeps no origin, as files of a user do."""
        path = self.config.place(artefact)
        file = (path if path.is_dir() else path.parent) / ORIGIN
        if not artefact.startswith("data/") or not file.is_file():
            return None
        return json.loads(file.read_text(encoding="utf-8"))

    def change_since(self, origin: Origin) -> tuple[str, Any, Any] | None:
        """Key, old and new value of the first value that differs from an origin; None if all are equal."""
        now = json.loads(json.dumps(self.values))
        for key, was in origin.items():
            value: Any = now
            for part in key.split("."):
                value = value.get(part, ABSENT) if isinstance(value, dict) else ABSENT
            if change := first_difference(was, value, key):
                return change
        return None

    def is_made(self, artefact: str) -> bool:
        """Whether a stage makes an artefact."""
        return any(PurePath(artefact).is_relative_to(out) for stage in self.pipeline.values() for out in stage.outs)

    def is_stale(self, stage: Stage) -> bool:
        """Whether an output of a stage is missing or was made with other values."""
        origins = [self.origin_of(out) for out in stage.outs]
        return any(origin is None or self.change_since(origin) is not None for origin in origins)

    def maker_of(self, artefact: str) -> Stage:
        """The stage that makes an artefact of the pipeline."""
        path = PurePath(artefact)
        return next(s for s in self.pipeline.values() if any(path.is_relative_to(out) for out in s.outs))


def first_difference(was: Any, now: Any, key: str) -> tuple[str, Any, Any] | None:
    """Key below `key`, old and new value of the first difference of two values of JSON; None if they are equal."""
    if isinstance(was, dict) and isinstance(now, dict):
        for name in {**was, **now}:
            if change := first_difference(was.get(name, ABSENT), now.get(name, ABSENT), f"{key}.{name}".strip(".")):
                return change
        return None
    return None if was == now else (key, was, now)


def digest(paths: Iterable[Path]) -> str:
    """Hash of folders or files by the names and sizes of all files and the content of small ones.

    The small files of an artefact (headers, SHA256SUMS, origins) hold the checksums of its large ones.
    """
    parts = []
    for path in paths:
        for file in sorted(one for one in (path, *path.rglob("*")) if one.is_file()):
            parts.append(f"{file.relative_to(path)}\0{(size := file.stat().st_size)}\0".encode())
            parts += [file.read_bytes()] if size <= MAX_HASHED else []
    return sha256(*parts)
