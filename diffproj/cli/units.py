"""The side of a square with its unit, such as 25mm: the unit of everything that is measured."""

import argparse
import math
import re
from typing import NamedTuple

METRES = {"um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "ft": 0.3048}
"""The units that are known, in metres."""

IN_WORDS = {"in": "inches", "ft": "feet"}
"""Units whose signs read badly in headings."""

SMALLEST = 1e-20
"""Sides of squares below it, and above one over it, are mistakes."""

SAME = 1e-6
"""Relative difference below which two sides are the same one, written in different units."""


class Square(NamedTuple):
    """The side of a board's square.

    Attributes:
        side: in its unit.
        unit: one of `METRES`, or `None` where it was not given.
    """

    side: float
    unit: str | None = None

    def __str__(self) -> str:
        """`25 mm`, or `25` without a unit."""
        return f"{self.side:.6g}" + (f" {self.unit}" if self.unit else "")


def square_side(text: str) -> Square:
    """Read the side of a square, such as `25mm`, `2.5cm`, `1in` or `25`."""
    match = re.fullmatch(r"([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*([^\d\s]*)", text.strip().replace("μ", "µ"))
    try:
        side = float(match[1]) if match else math.nan
    except ValueError:
        side = math.nan
    if not (match and SMALLEST <= side <= 1 / SMALLEST):
        raise argparse.ArgumentTypeError(
            f"want the side of a square as a positive number, with its unit or without, such as 25mm, got {text!r}"
        )
    unit = match[2].lower()
    if unit and unit not in METRES:
        raise argparse.ArgumentTypeError(f"want one of the units {', '.join(METRES)}, such as 25mm, got {text!r}")
    return Square(side, unit or None)


def heading(unit: str | None) -> str | None:
    """A unit as it stands in headings: `mm`, `inches`."""
    return None if unit is None else IN_WORDS.get(unit, unit)


def agreed(square: Square, calibrated: Square, file: object) -> tuple[Square, str | None]:
    """The side with its unit, and a warning where it is not that of the calibration.

    Where no unit is given and the number is the calibration's, so is the unit.

    Args:
        square: that of the board in the photograph.
        calibrated: that of the board that the camera was calibrated with.
        file: the camera file, for the warning.
    """
    given = f"--square: {square} here, and {calibrated} in {file}"
    if not {square.unit, calibrated.unit} <= set(METRES):
        if math.isclose(square.side, calibrated.side, rel_tol=SAME):
            unit = square.unit or calibrated.unit
            if calibrated.unit in (None, unit):
                return Square(square.side, unit), None
        return square, f"{given}: right only where it is another board, measured in the unit that you have in mind"
    now, then = METRES[square.unit or ""], METRES[calibrated.unit or ""]
    ratio = square.side * now / (calibrated.side * then)
    if not math.isclose(ratio, 1, rel_tol=SAME):
        return square, f"{given}: right only where it is another board"
    if square.unit != calibrated.unit:
        return square, f"{given}: the same side, but results are in {square.unit}"
    return square, None
