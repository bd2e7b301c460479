"""What a method's answer depends on, as a hash: its own code, parameters and weights, and of no other method.

Nothing is declared: the functions that a method reaches are read. Inside `polarnet.methods` and `polarnet.benchmark`,
each function counts on its own; any other module of polarnet that is reached counts as a whole, with what it imports.
Comments, docstrings and layout do not count. Too much may be found, never too little, as long as methods reach each
other and their setup by name.
"""

import ast
import dataclasses
import functools
import hashlib
import importlib.util
import inspect
import textwrap
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

PACKAGE = "polarnet"
FUNCTION_BY_FUNCTION = (
    "polarnet.benchmark.",
    "polarnet.methods.",
)  # in these modules a method depends on the functions that it reaches


def method_digest(method: Callable[..., Any], context: Any) -> str:
    """A hash of `method`'s code and of the fields of `context` that it reaches; files by their content."""
    reached = _reach_of(method, context)
    parts = [*sorted(reached.code), *(f"{name}={value_digest(getattr(context, name))}" for name in reached.fields)]
    return digest(*parts, torch.__version__, np.__version__)


def code_digest(*functions: Callable[..., Any]) -> str:
    """A hash of the code that functions reach."""
    return digest(*sorted(set().union(*(reach(function, None).code for function in functions))))


def digest(*parts: str | bytes) -> str:
    """128 bits of a hash over the parts, each with its length."""
    hashed = hashlib.blake2b(digest_size=16)
    for part in parts:
        content = part.encode() if isinstance(part, str) else part
        hashed.update(len(content).to_bytes(8, "little") + content)
    return hashed.hexdigest()


def value_digest(value: Any) -> str:
    """A hash of a field: settings by value, tensors by content, paths by what lies there."""
    if isinstance(value, Path):
        return _file_digest(value)
    if isinstance(value, torch.Tensor):
        return digest(str(value.dtype), str(tuple(value.shape)), value.contiguous().cpu().numpy().tobytes())
    if dataclasses.is_dataclass(value):
        fields = [f"{f.name}={value_digest(getattr(value, f.name))}" for f in dataclasses.fields(value)]
        return digest(type(value).__name__, *fields)
    if isinstance(value, Mapping):
        return digest("mapping", *(f"{key}={value_digest(item)}" for key, item in value.items()))
    if isinstance(value, (list, tuple)):
        return digest("sequence", *map(value_digest, value))
    return digest(type(value).__name__, repr(value))


@dataclasses.dataclass
class Reach:
    """What was found so far."""

    code: set[str] = dataclasses.field(default_factory=set)
    """Normalised source of functions and modules, each with its name."""
    names: set[str] = dataclasses.field(default_factory=set)
    """Of attributes and variables that functions of methods use."""
    seen: set[int] = dataclasses.field(default_factory=set)
    modules: set[str] = dataclasses.field(default_factory=set)
    fields: list[str] = dataclasses.field(default_factory=list)
    """Of the context."""


@functools.lru_cache(maxsize=256)
def reach(function: Callable[..., Any], context: Any) -> Reach:
    """Everything of polarnet that `function` may run, and the fields of the dataclass `context` that it may read.

    `context` is the class; None where there is none.
    """
    reached = Reach()
    _visit(function, reached, context)
    if context is None:
        return reached
    fields = {f.name for f in dataclasses.fields(context)}
    asked: set[str] = set()
    while wanted := (reached.names & set(dir(context))) - fields - asked:  # methods and cached properties
        asked |= wanted
        for name in sorted(wanted):
            if not name.startswith("__"):
                _visit(inspect.getattr_static(context, name), reached, context)
    reached.fields = sorted(fields & reached.names)
    return reached


def _reach_of(method: Callable[..., Any], context: Any) -> Reach:
    kind: Any = type(context)
    return reach(method, kind)


def _visit(thing: Any, reached: Reach, context: type | None) -> None:
    if id(thing) in reached.seen or thing is context:
        return
    reached.seen.add(id(thing))
    if isinstance(thing, functools.partial):
        for part in (thing.func, *thing.args, *thing.keywords.values()):
            _visit(part, reached, context)
    elif isinstance(thing, (functools.cached_property, property)):
        _visit(thing.func if isinstance(thing, functools.cached_property) else thing.fget, reached, context)
    elif isinstance(thing, types.ModuleType):
        if _ours(thing.__name__):
            _visit_module(thing.__name__, reached)
    elif isinstance(thing, Mapping):
        for key, item in thing.items():
            reached.code.add(f"key {key!r}")
            _visit(item, reached, context)
    elif isinstance(thing, (list, tuple, set, frozenset)):
        for item in thing:
            _visit(item, reached, context)
    elif isinstance(thing, (str, int, float, bool, bytes, type(None))):
        reached.code.add(f"value {thing!r}")
    elif dataclasses.is_dataclass(thing) and not isinstance(thing, type):
        for field in dataclasses.fields(thing):
            _visit(getattr(thing, field.name), reached, context)
    elif callable(thing):
        _visit_callable(inspect.unwrap(getattr(thing, "py_func", thing)), reached, context)


def _visit_callable(thing: Any, reached: Reach, context: type | None) -> None:
    module = getattr(thing, "__module__", None) or ""
    if isinstance(thing, types.FunctionType) and (module.startswith(FUNCTION_BY_FUNCTION) or not _ours(module)):
        if _foreign(module):
            return
        reached.code.add(f"{module}.{thing.__qualname__} {_source(thing)}")
        cells = [cell.cell_contents for cell in thing.__closure__ or ()]
        for value in [*cells, *(thing.__defaults__ or ()), *(thing.__kwdefaults__ or {}).values()]:
            _visit(value, reached, context)
        for name in _names(thing.__code__):
            reached.names.add(name)
            if name.startswith(f"{PACKAGE}."):
                _visit_module(name, reached)
            elif name in thing.__globals__:
                _visit(thing.__globals__[name], reached, context)
    elif isinstance(thing, type) and module.startswith(FUNCTION_BY_FUNCTION):
        reached.code.add(f"{module}.{thing.__qualname__} {_source(thing)}")
        for part in vars(thing).values():
            if isinstance(part, (types.FunctionType, property, functools.cached_property)):
                _visit(part, reached, context)
    elif _ours(module):
        _visit_module(module, reached)


def _ours(module: str) -> bool:
    return module.startswith(f"{PACKAGE}.")


def _foreign(module: str) -> bool:
    """Whether a library defines it: its version counts, not its text. Tests and notebooks are read."""
    spec = importlib.util.find_spec(module.partition(".")[0]) if module and module != "__main__" else None
    return not _ours(module) and spec is not None and "site-packages" in str(spec.origin or "")


def _names(code: types.CodeType) -> Iterator[str]:
    """Globals, attributes and modules that a function and those inside it name."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names(constant)


def _source(thing: Any) -> str:
    try:
        source = textwrap.dedent(inspect.getsource(thing))
    except (OSError, TypeError):
        return repr(thing.__code__.co_code) if isinstance(thing, types.FunctionType) else repr(thing)
    return _normalised(source)


@functools.lru_cache(maxsize=1024)
def _normalised(source: str) -> str:
    """Source without comments, docstrings and layout; as it is where it does not parse by itself, as a lambda may."""
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return source
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            kept = [line for line in body if not (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant))]
            node.body = kept  # type: ignore[attr-defined]
    return ast.dump(tree)


def _visit_module(name: str, reached: Reach) -> None:
    """The whole module, then what it imports of polarnet; modules of methods are left to their functions."""
    if name in reached.modules or f"{name}.".startswith(FUNCTION_BY_FUNCTION):
        return
    reached.modules.add(name)
    try:
        spec = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        return
    if spec is None or not spec.origin:
        return
    source = Path(spec.origin).read_text(encoding="utf-8")
    reached.code.add(f"module {name} {_normalised(source)}")
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            imported = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            imported = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            continue
        for module in imported:
            if _ours(module) and _is_module(module):
                _visit_module(module, reached)


@functools.cache
def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # its parent is no package: a function or class
        return False


def _file_digest(path: Path) -> str:
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        return digest("folder", *(f"{file.relative_to(path)} {_file_digest(file)}" for file in files))
    if not path.exists():
        return digest("missing")
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
