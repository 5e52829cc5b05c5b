"""Lengths with their units, such as 25mm: the unit of the board's squares is that of everything that is measured."""

import argparse
import math
import re
from collections.abc import Sequence
from typing import NamedTuple

METRES = {"um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "ft": 0.3048}
"""The units that are known, in metres."""

IN_WORDS = {"in": "inches", "ft": "feet"}
"""Units whose signs read badly in headings."""

SMALLEST = 1e-20
"""Sides of squares below it, and above one over it, are mistakes."""

SAME = 1e-6
"""Relative difference below which two sides are the same one, written in different units."""


class Length(NamedTuple):
    """A length in its unit, such as the side of a board's square.

    Attributes:
        value: in its unit.
        unit: one of `METRES`, or `None` where it was not given.
    """

    value: float
    unit: str | None = None

    def __str__(self) -> str:
        """`25 mm`, or `25` without a unit."""
        return f"{self.value:.6g}" + (f" {self.unit}" if self.unit else "")


def square_side(text: str) -> Length:
    """Read the side of a square, such as `25mm`, `2.5cm`, `1in` or `25`."""
    found = _length(text)
    if found is None or not SMALLEST <= found.value <= 1 / SMALLEST:
        raise argparse.ArgumentTypeError(
            f"want the side of a square as a positive number, with its unit or without, such as 25mm, got {text!r}"
        )
    return found


def length(text: str) -> Length:
    """Read a length of the board, such as `18mm`, `18` or `0.3`."""
    found = _length(text)
    if found is None or not SMALLEST <= found.value <= 1 / SMALLEST:
        raise argparse.ArgumentTypeError(
            f"want a positive number, with its unit or without, such as 18mm, got {text!r}"
        )
    return found


def height(text: str) -> Length:
    """Read a height, such as `12`, `-3` or `1.2cm`."""
    found = place(text)
    if found is None:
        raise argparse.ArgumentTypeError(
            f"want a height as a number, with its unit or in that of the board, such as 12mm, got {text!r}"
        )
    return found


def place(text: str) -> Length | None:
    """Read a coordinate, such as `-50mm` or `0.3`; `None` where it is none."""
    found = _length(text)
    return None if found is None or abs(found.value) > 1 / SMALLEST else found


def is_extent(numbers: Sequence[float]) -> bool:
    """Whether x0, y0, x1, y1 are those of a rectangle."""
    x0, y0, x1, y1 = numbers
    return x1 > x0 and y1 > y0


def in_unit(length: Length, unit: str | None) -> float | None:
    """A length in another unit; in that unit already where it has none. `None` where they cannot be compared."""
    if length.unit in (None, unit):
        return length.value
    if length.unit not in METRES or unit not in METRES:
        return None
    return length.value * METRES[length.unit] / METRES[unit]


def _length(text: str) -> Length | None:
    match = re.fullmatch(r"([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*([^\d\s]*)", text.strip().replace("μ", "µ"))
    try:
        value = float(match[1]) if match else math.nan
    except ValueError:
        return None
    if match is None or not math.isfinite(value):
        return None
    unit = match[2].lower()
    if unit and unit not in METRES:
        known = ", ".join(METRES)
        raise argparse.ArgumentTypeError(f"want one of the units {known}, such as 25mm, got {text.strip()!r}")
    return Length(value, unit or None)


def heading(unit: str | None) -> str | None:
    """A unit as it stands in headings: `mm`, `inches`."""
    return None if unit is None else IN_WORDS.get(unit, unit)


def agreed(square: Length, calibrated: Length, file: object, option: str = "--square") -> tuple[Length, str | None]:
    """The side with its unit, and a warning where it is not that of the calibration.

    Where no unit is given and the number is the calibration's, so is the unit.

    Args:
        square: that of the board in the photograph.
        calibrated: that of the board that the camera was calibrated with.
        file: the camera file, for the warning.
        option: which option gave the side, for the warning.
    """
    given = f"{option}: {square} here, and {calibrated} in {file}"
    if not {square.unit, calibrated.unit} <= set(METRES):
        if math.isclose(square.value, calibrated.value, rel_tol=SAME):
            unit = square.unit or calibrated.unit
            if calibrated.unit in (None, unit):
                return Length(square.value, unit), None
        return square, f"{given}: right only where it is another board, measured in the unit that you have in mind"
    if not math.isclose(in_unit(calibrated, square.unit) or math.nan, square.value, rel_tol=SAME):
        return square, f"{given}: right only where it is another board"
    if square.unit != calibrated.unit:
        return square, f"{given}: the same side, but results are in {square.unit}"
    return square, None
