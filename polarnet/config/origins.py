"""Origins: what each artefact was made with and from, kept beside it and compared by every stage that reads it.

dvc.yaml is the one list of what a stage reads (`params`, `deps`) and makes (`outs`), for DVC and for stages that a
person runs by hand. After a stage, each folder that it made holds `origin.json`: its name, a digest of its files, the
values of its `params` and those of its inputs, and digests of these. Before a stage, the origins of its inputs are
compared with their files, with each other and with the configuration.
"""

import dataclasses
import functools
import json
import shlex
from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, NamedTuple

from omegaconf import OmegaConf
from ruamel.yaml import YAML

from polarnet.runtime.files import ORIGIN, REMAKE, files_of, replaced, sha256

if TYPE_CHECKING:
    from polarnet.config.tree import Config

UNCOMPARED = ("rows",)
"""Keys that decide whether an artefact is made at all, not what it holds."""
MAX_HASHED = 2**16  # bytes; larger files of a store or training have checksums in smaller ones
ABSENT = "nothing"


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
    values: Any = OmegaConf.create(dict(params))
    stages: dict[str, Stage] = {}

    def filled(content: Any, key: str = "", item: Any = None) -> Any:
        """The content with values in place of DVC's templates, which are OmegaConf's interpolations."""
        values.key, values.item, values.content = key, item, content
        return OmegaConf.to_container(values.content, resolve=True)

    for name, content in YAML(typ="safe").load(root / "dvc.yaml")["stages"].items():
        one, items = content.get("do", content), filled(content["foreach"]) if "foreach" in content else {"": None}
        made = [*one.get("outs", ()), *one.get("metrics", ())]
        one = one | {"outs": [out if isinstance(out, str) else next(iter(out)) for out in made]}
        for key in items:
            full = f"{name}@{key}".removesuffix("@")
            stage = filled(one, key, items[key] if isinstance(items, dict) else key)
            command, keys, deps = shlex.split(stage["cmd"]), stage.get("params", []), stage.get("deps", [])
            stages[full] = Stage(full, command, keys, deps, stage["outs"])
    return stages


class Run:
    """The stages that one script runs with a configuration, their inputs and their origins."""

    def __init__(self, root: Path, config: "Config", script: str):
        self.config, self.values = config, dataclasses.asdict(config)
        self.pipeline = pipeline(root, self.values)
        chosen = {f"{key}={self.values[key]}" for key in ("row", "baseline") if self.values[key] is not None}
        of_script = [stage for stage in self.pipeline.values() if stage.script == script]
        exact = [stage for stage in of_script if set(stage.overrides) == chosen]
        self.stages = exact or ([] if chosen else of_script)  # without `row`, a script runs all rows
        self._content_of = functools.cache(lambda artefact: digest(config.place(artefact)))
        """Digest of an artefact's folder at the first call: what the stages of this run read."""

    def check_inputs(self) -> None:
        """ValueError for the first artefact that is not what its name says, or was made from others than those here."""
        for artefact in dict.fromkeys(made for stage in self.stages for made in self.made_inputs(stage)):
            if problem := self.problem_of(artefact):
                raise ValueError(problem)

    def write_origins(self) -> None:
        """Write the origin of each folder that the stages made, with a checksum of its own."""
        for stage in self.stages:
            values: dict[str, Any] = {}
            inputs = {artefact: self._content_of(artefact) for artefact in self.made_inputs(stage)}
            for artefact in inputs:
                if origin := read_origin(self.config.place(artefact)):
                    values |= origin.values
            values |= {key: _value_at(self.values, key) for key in stage.params if key not in UNCOMPARED}
            for out, folder in ((out, self.config.place(out)) for out in stage.outs):
                if folder.is_dir():
                    content = Origin(out, digest(folder), inputs, values)._asdict()
                    record = {**content, "sha256": _checksum(content)}
                    with replaced(folder / ORIGIN) as temporary:
                        temporary.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n", encoding="utf-8")

    def made_inputs(self, stage: Stage) -> list[str]:
        """The artefacts of other stages that a stage reads: its `deps`, or what they hold or are part of."""
        outs = [out for other in self.pipeline.values() for out in other.outs if self.config.place(out).is_dir()]
        related = [
            out
            for dep in map(PurePath, stage.deps)
            for out in outs
            if dep.is_relative_to(out) or PurePath(out).is_relative_to(dep)
        ]
        return list(dict.fromkeys(related))

    def problem_of(self, artefact: str) -> str | None:
        """Why an artefact cannot be used with this configuration; None if it can, or keeps no origin as a user's own.

        ValueError for a damaged origin.
        """
        place, maker = self.config.place(artefact), self.maker_of(artefact)
        origin = read_origin(place)
        if origin is None or maker is None:
            return None
        command = shlex.join(maker.command)
        values = {key: _value_at(self.values, key) for key in origin.values}
        if change := first_difference(origin.values, json.loads(json.dumps(values))):
            key, was, now = change
            return (
                f"{key}: {place} was made with {was}, this run has {now}; make it again with this value (`dvc repro "
                f"{maker.name}` after an edit of params.yaml, or `{command} {key}={now}`), or run with {key}={was}"
            )
        again = f"make it again (`dvc repro {maker.name}`, or `{command}`)"
        if origin.artefact != artefact:
            return f"{place}: expected {artefact}, got a copy of {origin.artefact}; {again}"
        if origin.content != self._content_of(artefact):
            return f"{place}: its files are not those that `{command}` wrote; {again}"
        for source, was in origin.inputs.items():
            if self.config.place(source).is_dir() and self._content_of(source) != was:
                return f"{place} was made from another {self.config.place(source)} than the one there now; {again}"
        return None

    def is_stale(self, stage: Stage) -> bool:
        """Whether an output of a stage is missing, has no origin, or cannot be used with this configuration."""
        return any(read_origin(self.config.place(out)) is None or self.problem_of(out) for out in stage.outs)

    def maker_of(self, artefact: str) -> Stage | None:
        """The stage that makes an artefact; None if none does."""
        path = PurePath(artefact)
        makers = (one for one in self.pipeline.values() if any(path.is_relative_to(out) for out in one.outs))
        return next(makers, None)


class Origin(NamedTuple):
    """How an artefact was made."""

    artefact: str
    """Its name in dvc.yaml."""
    content: str
    """`digest` of its folder."""
    inputs: dict[str, str]
    """`digest` of each artefact that it was made from, by name."""
    values: dict[str, Any]
    """The values that it and its inputs were made with, by key of params.yaml; a key may name a section."""


def read_origin(folder: Path) -> Origin | None:
    """The origin in a folder; None if there is none, ValueError if it is not as it was written."""
    file = folder / ORIGIN
    if not file.is_file():
        return None
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        written = content.pop("sha256")
        if _checksum(content) == written:
            return Origin(**content)
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError):
        pass
    raise ValueError(f"{file} is not as it was written; {REMAKE}")


def origin_problems(folder: Path) -> list[str]:
    """Why the files of a folder are not those of its origin; empty if they are, or if it keeps none."""
    try:
        origin = read_origin(folder)
    except ValueError as error:
        return [str(error)]
    if origin is None or origin.content == digest(folder):
        return []
    return [f"{folder}: its files are not those that {folder / ORIGIN} describes; {REMAKE}"]


def _checksum(content: Mapping[str, Any]) -> str:
    return sha256(json.dumps(content, sort_keys=True).encode())


def _value_at(values: Any, key: str) -> Any:
    """The value at a dotted key of nested mappings; `ABSENT` if there is none."""
    for part in key.split("."):
        values = values.get(part, ABSENT) if isinstance(values, dict) else ABSENT
    return values


def first_difference(was: Any, now: Any, key: str = "") -> tuple[str, Any, Any] | None:
    """Key below `key`, old and new value of the first difference of two values of JSON; None if they are equal."""
    if isinstance(was, dict) and isinstance(now, dict):
        for name in {**was, **now}:
            if change := first_difference(was.get(name, ABSENT), now.get(name, ABSENT), f"{key}.{name}".strip(".")):
                return change
        return None
    return None if was == now else (key, was, now)


def digest(path: Path) -> str:
    """Hash of a folder or file by the names and sizes of all files and the content of small ones, without origins.

    The small files of an artefact (headers, SHA256SUMS) hold the checksums of its large ones.
    """
    parts = []
    for file in files_of(path):
        parts.append(f"{file.relative_to(path)}\0{(size := file.stat().st_size)}\0".encode())
        parts += [file.read_bytes()] if size <= MAX_HASHED else []
    return sha256(*parts)
