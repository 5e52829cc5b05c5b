"""What is known of a camera before the landmarks are looked at, as `--prior` and `--fixed` say it."""

import argparse
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from diffproj.calibration.parametrisation import Parametrisation
from diffproj.calibration.pose_parameters import ANGLES, PLACE
from diffproj.calibration.result import Calibration
from diffproj.cli.inputs import LARGEST_NUMBER
from diffproj.geometry.camera import Camera
from diffproj.geometry.mounting import rotation_from_mounting

Calibrated = TypeVar("Calibrated", Camera, Calibration)

POSE = (*ANGLES, *PLACE)
"""Names of where a camera stands and looks."""

FOCAL = ("focal", "f_x", "f_y")
SPOKEN = {"z": "height", "f": "focal", "focal_length": "focal", "pitch": "tilt"}
"""Other names that people use."""


class Known(NamedTuple):
    """One number that is known, for certain where the deviation is 0."""

    name: str
    value: float
    deviation: float

    def __str__(self) -> str:
        """As the command line has it."""
        return f"{self.name}={self.value:g}" + f"+-{self.deviation:g}" * (self.deviation > 0)


def prior(text: str) -> Known:
    """Read what is known with a deviation, such as `height=12+-0.02`."""
    name, _, rest = text.partition("=")
    parts = re.split(r"\+/?-|±", rest)
    if len(parts) == 1 and name.strip() and (value := _number(rest)) is not None:
        said = f"{name.strip()}={value:g}"
        raise argparse.ArgumentTypeError(
            f"want a standard deviation behind the value, such as {said}+-0.1, got {text!r}; --fixed {said} holds it"
        )
    value, deviation = (_number(part) for part in parts) if len(parts) == 2 else (None, None)
    if value is None or deviation is None or not name.strip():
        raise argparse.ArgumentTypeError(f"want NAME=VALUE+-DEVIATION, such as height=12+-0.02, got {text!r}")
    if deviation <= 0:
        zero = f"; --fixed {name.strip()}={value:g} holds it" * (deviation == 0)
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


def check_together(priors: Sequence[Known], held: Sequence[Known], camera: Camera) -> None:
    """Check what was said, all of it together and with the camera.

    Raises:
        ValueError: a name that is unknown, or said twice.
    """
    names = Parametrisation.of(camera).names
    seen: dict[str, str] = {}
    for option, one in [*(("--prior", one) for one in priors), *(("--fixed", one) for one in held)]:
        if one.name not in (*POSE, "focal", *names):
            raise ValueError(f"{option}: want a name from {', '.join((*POSE, 'focal', *names))}, got {one.name!r}")
        if one.name in seen:
            where = "twice" if seen[one.name] == option else f"in {seen[one.name]} as well"
            raise ValueError(f"{option}: want each name once, got {one.name!r} {where}")
        seen[one.name] = option
    if "focal" in seen and ("f_x" in seen or "f_y" in seen):
        raise ValueError("--prior: want either 'focal' or 'f_x' and 'f_y', got both")


def one_focal_length(free: Sequence[str], priors: Sequence[Known]) -> bool:
    """Whether `f_x : f_y` is to keep the camera's ratio: of `focal`, and where a prior speaks of but one of the two."""
    known = {one.name for one in priors}
    alone = len(known & {*FOCAL[1:]}) == 1 and not {*FOCAL[1:]} & {*free}
    return "focal" in free or "focal" in known or alone


def posed(camera: Calibrated, known: Sequence[Known]) -> Calibrated:
    """The camera, or the calibration with its camera, at the pose of which so much is known."""
    if isinstance(camera, Calibration):
        return replace(camera, camera=posed(camera.camera, known))
    camera = camera.upright().to(torch.float64)
    said = {one.name: camera.K.new_tensor(one.value) for one in known}
    own = camera.mounting()
    values = dict(zip(POSE, (own.tilt, own.roll, own.heading, *own.position.unbind(-1), own.height), strict=True))
    values |= {name: value for name, value in said.items() if name in POSE}
    R = rotation_from_mounting(values["tilt"], values["roll"], values["heading"])
    center = torch.stack([values[name] for name in PLACE], dim=-1)
    return camera.at(R, -(R @ center))


def standing_near(camera: Camera, points: Tensor) -> Camera:
    """The camera somewhere over points `(N, 3)`, level: where nothing better is known."""
    points = points.detach().to(torch.float64)
    x, y, z = points.mean(0).tolist()
    high = max(abs(z), float((points - points.mean(0)).abs().amax()), 1.0)
    level = Camera.mounted(high, 0.0, position=[x, y], focal=1.0, size=(2, 2))
    return camera.upright().to(torch.float64).at(level.R, level.t)


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
