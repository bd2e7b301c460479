from dataclasses import dataclass, field

import pytest

from polarnet.runtime.ranges import allowed, check_ranges


@dataclass(frozen=True)
class Filter:
    cutoff_hz: float = field(metadata=allowed(above=0, high=1000))
    shape: str = field(metadata=allowed(choices=["box", "gauss"]))
    taps: list[int] = field(metadata=allowed(low=1))
    delay_s: float | None = field(metadata=allowed(low=0))
    name: str = "any"

    def __post_init__(self):
        check_ranges(self)


def test_values_on_the_closed_bounds_pass_and_none_is_left_alone():
    assert Filter(1000.0, "box", [1, 9], None).taps == [1, 9]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, "box", [1], None), "cutoff_hz: expected > 0 and <= 1000, got 0.0"),
        ((float("nan"), "box", [1], None), "cutoff_hz"),
        ((1.0, "bux", [1], None), "shape: expected one of box, gauss, got 'bux'"),
        ((1.0, "box", [1, 0], None), r"taps: expected >= 1, got \[1, 0\]"),
        ((1.0, "box", [1], -1.0), "delay_s: expected >= 0"),
    ],
)
def test_the_first_bad_field_is_named_with_what_is_allowed(arguments, message):
    with pytest.raises(ValueError, match=message):
        Filter(*arguments)
