"""A camera of which something is known before the landmarks are looked at: what was said of it, checked and applied."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from diffproj.calibration.problem.parametrisation import Parametrisation
from diffproj.calibration.results.calibration import Calibration
from diffproj.cli.known_beforehand import FOCAL, PLACE, POSE, Known
from diffproj.geometry.camera import Camera
from diffproj.geometry.mounting import mounting_of, rotation_from_mounting

Calibrated = TypeVar("Calibrated", Camera, Calibration)


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
    """The camera, or the calibration with its camera, at the pose of which so much is known.

    Without a pose of its own it looks straight up, where roll and heading turn it alike: then it is level.
    """
    if isinstance(camera, Calibration):
        return replace(camera, camera=posed(camera.camera, known))
    camera = camera.upright().to(torch.float64)
    said = {one.name: camera.K.new_tensor(one.value) for one in known}
    own = mounting_of(camera)
    values = dict(zip(POSE, (own.tilt, own.roll, own.heading, *own.position.unbind(-1), own.height), strict=True))
    if torch.equal(camera.R, torch.eye(3).to(camera.R)):
        values["tilt"] = torch.zeros_like(own.tilt)
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
