"""Records what a stage runs and reads: functions of polarnet, names that they take from its modules, and keys.

Recording starts and ends with the stage's own `main(config)`: what starts a stage is not recorded. Compiled functions
count as run where a recorded function names them.
"""

import ast
import dataclasses
import functools
import inspect
import json
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

ENTRY = ("polarnet/config/tree.py", "polarnet/config/origins.py", "polarnet/terminal/")
"""What starts a stage, and what only says or draws: neither decides an output."""
ROOT = Path(__file__).resolve().parents[2]


def record_to(file: Path) -> None:
    """Record the stage that this process starts next into a JSON file: `files` and `keys`."""
    from numba.core.dispatcher import Dispatcher

    from polarnet.config import tree

    codes: set[CodeType] = set()
    keys: set[str] = set()
    paths: dict[int, str] = {}
    kept: list[Any] = []  # objects in `paths`, so that no other object gets the id of one

    def call(frame: FrameType, event: str, argument: Any) -> None:
        codes.add(frame.f_code)

    def typed(*arguments: Any) -> Any:
        config = original_typed(*arguments)
        _name_sections(config, "", paths, kept)
        return config

    def compile_unrecorded(dispatcher: Any, signature: Any) -> Any:
        sys.settrace(None)  # numba's compiler makes millions of calls
        try:
            return compile_kernel(dispatcher, signature)
        finally:
            sys.settrace(call)

    def recorded(work: Callable[[], Any], name: str) -> Any:
        _record_reads(keys, paths, kept)
        threading.settrace(call)
        Dispatcher.compile = compile_unrecorded
        sys.settrace(call)
        try:
            return original(work, name)
        finally:
            sys.settrace(None)
            threading.settrace(None)  # type: ignore[arg-type]
            files = sorted(_files_of(codes))
            file.write_text(json.dumps({"files": files, "keys": sorted(keys)}))

    compile_kernel = Dispatcher.compile
    original, original_typed = tree.or_refuse, tree.typed
    tree.or_refuse, tree.typed = recorded, typed


def _name_sections(value: Any, path: str, paths: dict[int, str], kept: list[Any]) -> None:
    """Note the dotted path of every section of a configuration."""
    if dataclasses.is_dataclass(value):
        paths[id(value)] = path
        kept.append(value)
    fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)} if id(value) in paths else value
    if isinstance(fields, dict):
        for name, field in fields.items():
            _name_sections(field, f"{path}.{name}".strip("."), paths, kept)


def _record_reads(keys: set[str], paths: dict[int, str], kept: list[Any]) -> None:
    """Let the sections note which of their values are read; a changed copy of a section has the section's path."""
    changed: dict[int, set[str]] = {}

    def read(self: Any, name: str) -> Any:
        value = object.__getattribute__(self, name)
        path = paths.get(id(self))
        if path is not None and name in type(self).__dataclass_fields__ and name not in changed.get(id(self), ()):
            values = value.values() if isinstance(value, dict) else [value]
            if not any(map(dataclasses.is_dataclass, values)):
                keys.add(f"{path}.{name}".strip("."))
        return value

    for kind in {type(one) for one in kept}:
        kind.__getattribute__ = read
    make = dataclasses.replace

    @functools.wraps(make)
    def replace(section: Any, **changes: Any) -> Any:
        before = set(keys)
        copy = make(section, **changes)
        if id(section) in paths:
            keys.intersection_update(before)  # what the copy is read for counts, not the copying
            paths[id(copy)] = paths[id(section)]
            changed[id(copy)] = set(changes) | changed.get(id(section), set())
            kept.append(copy)
        return copy

    dataclasses.replace = replace
    for module in list(sys.modules.values()):
        if module.__name__.startswith("polarnet") and getattr(module, "replace", None) is make:
            module.replace = replace  # type: ignore[attr-defined]


def _files_of(codes: set[CodeType]) -> set[str]:
    """Files of polarnet and stages with a function that ran, or with a name that such a function uses."""
    by_file = {
        module.__file__: module for module in list(sys.modules.values()) if getattr(module, "__file__", None)
    }  # a stage's own script is __main__ only where Python started it
    files: set[str] = set()
    waiting, seen = list(codes), set(codes)
    while waiting:
        code = waiting.pop()
        path = Path(code.co_filename)
        if not path.is_relative_to(ROOT) or path.relative_to(ROOT).parts[0] not in ("polarnet", "stages"):
            continue
        file = path.relative_to(ROOT).as_posix()
        files.add(file)
        if file.startswith(ENTRY) or path.suffix != ".py":  # a template of a page imports nothing
            continue
        module = by_file.get(code.co_filename)
        sources = _sources(code.co_filename)
        for name in code.co_names:
            if source := sources.get(name):
                files.add(source)
            value = getattr(module, name, None)
            compiled = getattr(value, "py_func", None)  # of numba, whose calls Python does not see
            if inspect.isfunction(compiled) and compiled.__code__ not in seen:
                seen.add(compiled.__code__)
                waiting.append(compiled.__code__)
    return files


@functools.cache
def _sources(file: str) -> dict[str, str]:
    """File of polarnet that each imported name of a module comes from; a module's own import names its file."""
    names = {}
    for node in _imports(ast.parse(Path(file).read_text(encoding="utf-8"))):
        for alias in node.names:
            inner = f"{node.module}.{alias.name}"
            module = inner if inner in sys.modules and isinstance(sys.modules[inner], ModuleType) else node.module
            source = getattr(sys.modules.get(str(module)), "__file__", None)
            if source and Path(source).is_relative_to(ROOT):
                names[alias.asname or alias.name] = Path(source).relative_to(ROOT).as_posix()
    return names


def _imports(tree: ast.Module) -> Iterator[ast.ImportFrom]:
    """Imports from polarnet that run."""
    blocks = [node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)]
    unused = {id(inner) for block in blocks for inner in ast.walk(block)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("polarnet") and id(node) not in unused:
            yield node
