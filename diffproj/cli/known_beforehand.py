"""What is known of a camera before the landmarks are looked at, as `--prior` and `--fixed` say it."""

import argparse
import math
import re
from typing import NamedTuple

from diffproj.cli.inputs import LARGEST_NUMBER

PLACE = ("x", "y", "height")
POSE = ("tilt", "roll", "heading", *PLACE)
"""Names of where a camera stands and looks."""

FOCAL = ("focal", "f_x", "f_y")
SPOKEN = {"z": "height", "f": "focal", "focal_length": "focal", "pitch": "tilt"}
"""Other names that people use."""

PLUS_MINUS = r"\+/?-|±"

NARROWEST, WIDEST = 0.5, 110.0
"""Fields of view in degrees: wider lenses bend in ways that no guess holds."""


class Known(NamedTuple):
    """One number that is known, for certain where the deviation is 0."""

    name: str
    value: float
    deviation: float

    def __str__(self) -> str:
        """As the command line has it."""
        return f"{self.name}={self.value:.12g}" + f"+-{self.deviation:g}" * (self.deviation > 0)


class FieldOfView(NamedTuple):
    """A horizontal field of view in degrees.

    Attributes:
        degrees: from the left edge of the image to the right one; `None` where EXIF data are to tell it.
        deviation: `None` where nothing is said of how far that may be off.
    """

    degrees: float | None
    deviation: float | None

    def __str__(self) -> str:
        """As people write it."""
        degrees = "exif" if self.degrees is None else f"{self.degrees:g}"
        return degrees if self.deviation is None else f"{degrees} ± {self.deviation:g}"


def field_of_view(text: str) -> FieldOfView:
    """Read a field of view such as `70+-5`, `70`, or `exif`."""
    if text.strip().lower() == "exif":
        return FieldOfView(None, None)
    values = [_number(part) for part in re.split(PLUS_MINUS, text)]
    if len(values) > 2 or None in values:
        raise argparse.ArgumentTypeError(f"want degrees, such as 70+-5, or exif, got {text!r}")
    degrees, deviation = (*values, None)[:2]
    if degrees is None or not NARROWEST <= degrees <= WIDEST:
        raise argparse.ArgumentTypeError(
            f"want {NARROWEST:g} to {WIDEST:g} degrees from the left to the right edge of the image, got {text!r}; "
            "lenses that see more have to be calibrated"
        )
    if deviation is not None and deviation <= 0:
        raise argparse.ArgumentTypeError(f"want a standard deviation above 0, got {text!r}")
    return FieldOfView(degrees, deviation)


def prior(text: str) -> Known:
    """Read what is known with a deviation, such as `height=12+-0.02`."""
    name, _, rest = text.partition("=")
    parts = re.split(PLUS_MINUS, rest)
    if len(parts) == 1 and name.strip() and (value := _number(rest)) is not None:
        said = f"{name.strip()}={value:.12g}"
        raise argparse.ArgumentTypeError(
            f"want a standard deviation behind the value, such as {said}+-0.1, got {text!r}; --fixed {said} holds it"
        )
    value, deviation = (_number(part) for part in parts) if len(parts) == 2 else (None, None)
    if value is None or deviation is None or not name.strip():
        raise argparse.ArgumentTypeError(f"want NAME=VALUE+-DEVIATION, such as height=12+-0.02, got {text!r}")
    if deviation <= 0:
        zero = f"; --fixed {name.strip()}={value:.12g} holds it" * (deviation == 0)
        raise argparse.ArgumentTypeError(f"want a standard deviation above 0, got {text!r}{zero}")
    return _checked(name, value, deviation, text)


def fixed(text: str) -> Known:
    """Read what is known for certain, such as `roll=0`."""
    name, _, rest = text.partition("=")
    value = _number(rest)
    if value is None or not name.strip():
        raise argparse.ArgumentTypeError(f"want NAME=VALUE, such as roll=0, got {text!r}")
    known = _checked(name, value, 0.0, text)
    if known.name not in POSE:
        raise argparse.ArgumentTypeError(
            f"want a name from {', '.join(POSE)}, got {known.name!r}; of the camera, what is not free is held anyway"
        )
    return known


def _checked(name: str, value: float, deviation: float, text: str) -> Known:
    name = SPOKEN.get(name.strip().lower(), name.strip().lower())
    wrong = {
        "height": ("a height above z = 0, more than 0", value > 0),
        "tilt": ("degrees below the horizon, from -90 to 90", abs(value) <= 90),
        "roll": ("degrees from -180 to 180", abs(value) <= 180),
        "heading": ("degrees clockwise from y, from -360 to 360", abs(value) <= 360),
        **dict.fromkeys(FOCAL, ("a focal length in px, more than 0", value > 0)),
    }
    want, sound = wrong.get(name, ("", True))
    if not sound:
        raise argparse.ArgumentTypeError(f"want {want}, got {text!r}")
    return Known(name, value, deviation)


def _number(text: str) -> float | None:
    """A number, with a decimal point or a decimal comma."""
    try:
        value = float(text.strip().replace(",", "."))
    except ValueError:
        return None
    return value if math.isfinite(value) and abs(value) <= LARGEST_NUMBER else None
