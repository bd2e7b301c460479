import dataclasses
from typing import Annotated

import pytest
from pydantic import Field, NonNegativeInt, PositiveFloat

from polarnet.runtime.sections import one_of, section


@section
class Lens:
    focal_mm: PositiveFloat
    coating: Annotated[str, one_of(("none", "single"))]


@section
class Camera:
    rate_hz: PositiveFloat | None
    sides: Annotated[list[Annotated[int, Field(ge=2, le=9)]], Field(min_length=2, max_length=2)]
    leak: NonNegativeInt
    lenses: dict[str, Lens]

    def __post_init__(self):
        if self.leak > self.sides[0]:
            raise ValueError(f"leak: expected at most the first side {self.sides[0]}, got {self.leak}")


VALUES = {"rate_hz": None, "sides": [2, 9], "leak": 0, "lenses": {"wide": {"focal_mm": 4, "coating": "none"}}}


def test_values_at_their_limits_pass_and_become_the_declared_types():
    camera = Camera(**VALUES)
    assert camera.lenses == {"wide": Lens(4.0, "none")}
    assert type(camera.lenses["wide"].focal_mm) is float


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rate_hz": 0.0}, "rate_hz: expected > 0, got 0.0"),
        ({"rate_hz": float("nan")}, "rate_hz: expected a number from -1e+10 to 1e+10, got nan"),
        ({"sides": [2, 10]}, "sides[1]: expected <= 9, got 10"),
        ({"sides": [2, 1e30]}, "sides[1]: expected a number from -1e+10 to 1e+10, got 1e+30"),
        ({"sides": [2]}, "sides: expected at least 2 values, got [2]"),
        ({"leak": "many"}, "leak: expected a valid integer, got 'many'"),
        ({"leak": 3}, "leak: expected at most the first side 2, got 3"),
        ({"gain": 1}, "gain is not a setting; the configuration has leak, lenses, rate_hz, sides"),
        ({"lenses": {"wide": {"coating": "none"}}}, "lenses.wide.focal_mm: expected a value, got none; add the key"),
        (
            {"lenses": {"wide": {"focal_mm": 0, "coating": "double", "tint": 1}}},
            "lenses.wide.focal_mm: expected > 0, got 0\n"
            "lenses.wide.coating: expected one of none, single, got 'double'\n"
            "lenses.wide.tint is not a setting; lenses.wide has coating, focal_mm",
        ),
    ],
)
def test_every_invalid_value_is_refused_with_its_path_what_is_expected_and_what_came(changes, message):
    for _ in range(2):  # pydantic builds a class at its first use
        with pytest.raises(ValueError) as refusal:
            Camera(**VALUES | changes)
        assert str(refusal.value) == message


def test_a_section_cannot_be_changed_and_a_replaced_value_is_checked_too():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Lens(4.0, "none").focal_mm = 5.0
    with pytest.raises(ValueError, match=r"^focal_mm: expected > 0, got -1$"):
        dataclasses.replace(Lens(4.0, "none"), focal_mm=-1)
