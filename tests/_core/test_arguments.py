"""Checks of arguments: messages that name the argument and all that was given."""

import math

import pytest

from diffproj._core.arguments import numbers


@pytest.mark.parametrize(
    ("value", "error"), [([0, math.inf, 1], ValueError), ([0, "x", 1], TypeError), ((1, 2), ValueError)]
)
def test_one_wrong_number_of_several_is_told_with_what_was_wanted(value: object, error: type[Exception]) -> None:
    with pytest.raises(error, match="^extent: want three numbers, got"):
        numbers("extent", value, "three numbers", 3)


def test_several_numbers() -> None:
    assert numbers("extent", [0, 1.5, 2], "three numbers", 3) == (0.0, 1.5, 2.0)
