"""Sections of params.yaml as classes: pydantic checks the names, types and ranges of their values."""

import dataclasses
import functools
import types
import typing
from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeVar

from pydantic import AfterValidator, ConfigDict, ValidationError
from pydantic.dataclasses import dataclass
from pydantic_core import ErrorDetails, PydanticCustomError

from polarnet.terminal.suggestions import did_you_mean

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False, coerce_numbers_to_str=True)
EXPECTED = {
    "greater_than": "> {gt:g}",
    "greater_than_equal": ">= {ge:g}",
    "less_than_equal": "<= {le:g}",
    "too_short": "at least {min_length} values",
    "too_long": "at most {max_length} values",
    "choice": "one of {choices}",
}
"""Expected values by pydantic's type of error; other types have a message of pydantic's own."""
MAX_NUMBER = 1e10
"""Larger values than this are mistakes in any section; keys with a meaningful limit have their own."""

Section = TypeVar("Section")


@typing.dataclass_transform(frozen_default=True)
def section(config_class: type[Section]) -> type[Section]:
    """Make a class a frozen dataclass that checks and converts its fields, and those of the sections inside.

    Making one raises ValueError with a line for every field that is unknown, missing, of a wrong type or out of range.
    A `__post_init__` may check fields together; its ValueError starts with the name of a field.
    """
    checked: Any = dataclass(config_class, frozen=True, config=STRICT)
    validate = checked.__init__

    @functools.wraps(validate)
    def init(self: Any, *args: Any, **values: Any) -> None:
        if refusal := _absurd_number(values):
            raise ValueError(refusal)
        try:
            validate(self, *args, **values)
        except ValidationError as error:  # pydantic has no hook that words a whole error anew
            raise ValueError("\n".join(_in_words(checked, one) for one in error.errors())) from None

    checked.__init__ = init
    return checked


def section_of(name: str, fields: Mapping[str, Any]) -> type:
    """A section with these types by field."""
    return section(dataclasses.make_dataclass(name, fields.items(), frozen=True))


def _absurd_number(value: Any, key: str = "") -> str | None:
    """Message about the first number in a nested value that is NaN or beyond `MAX_NUMBER`; None if there is none."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, inner in items:
        inside = f"{key}[{name}]" if isinstance(value, list) else f"{key}.{name}".removeprefix(".")
        if refusal := _absurd_number(inner, inside):
            return refusal
    if isinstance(value, int | float) and not abs(value) <= MAX_NUMBER:  # NaN compares as False
        return f"{key}: expected a number from {-MAX_NUMBER:g} to {MAX_NUMBER:g}, got {value!r}"
    return None


def one_of(choices: Collection[str]) -> AfterValidator:
    """Annotation of a string that is one of `choices`."""

    def check(value: str) -> str:
        if value not in choices:
            raise PydanticCustomError("choice", "", {"choices": ", ".join(choices)})
        return value

    return AfterValidator(check)


def unknown_key(config_class: Any, path: Sequence[str], others: Collection[str] = ()) -> str | None:
    """The reason why a path of keys leads to no field of a section, with the keys to choose from; None if it does.

    `others` are keys that have a meaning beside the fields of `config_class`.
    """
    for depth, name in enumerate(path):
        if typing.get_origin(config_class) is dict:
            _, config_class = typing.get_args(config_class)
            continue
        fields = dataclasses.fields(config_class) if dataclasses.is_dataclass(config_class) else ()
        names = sorted([*(field.name for field in fields), *(() if depth else others)])
        if name not in names:
            inside = ".".join(path[:depth]) or "the configuration"
            keys = f"{inside} has {', '.join(names)}" if names else f"{inside} is a value, not a section"
            return f"{'.'.join(path)} is not a setting; {keys}{did_you_mean(name, names)}"
        hint = typing.get_type_hints(config_class)[name]
        kinds = [kind for kind in typing.get_args(hint) if kind is not type(None)]
        config_class = kinds[0] if isinstance(hint, types.UnionType) and len(kinds) == 1 else hint
    return None


def _in_words(config_class: Any, error: ErrorDetails) -> str:
    """The key of an invalid value, what was expected and what came."""
    kind, context = error["type"], error.get("ctx", {})
    by_position: dict[Any, Any] = {i: field.name for i, field in enumerate(dataclasses.fields(config_class))}
    location = [*(by_position.get(part, part) for part in error["loc"][:1]), *error["loc"][1:]]
    path = [f"[{part}]" if isinstance(part, int) else part for part in location]
    key = ".".join(path).replace(".[", "[").removesuffix("[key]")  # pydantic's mark of an invalid key of a mapping
    if kind == "unexpected_keyword_argument":
        return unknown_key(config_class, path) or key
    if kind == "value_error":  # of a __post_init__, whose message starts with a field
        return f"{key}.{context['error']}".removeprefix(".")
    if kind in ("missing", "missing_argument"):
        return f"{key}: expected a value, got none; add the key"
    pydantics, _, _ = error["msg"].removeprefix("Input should be ").partition(", ")
    near = did_you_mean(str(error["input"]), context["choices"].split(", ")) if kind == "choice" else ""
    return f"{key}: expected {EXPECTED.get(kind, pydantics).format(**context)}, got {error['input']!r}{near}"
