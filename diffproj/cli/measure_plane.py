"""The plane that is measured on: by its equation, or by its height above the board's face, and the same in words.

Where the camera was found from landmarks, heights count from z = 0 towards z. Maps count theirs from the sea, so that
z = 0 may lie far below the ground: where no plane is given, that is told.
"""

import argparse

import torch

from diffproj._core.shown import plain
from diffproj._core.warn import warn_caller
from diffproj.calibration.results.calibration import Calibration
from diffproj.cli.scene import Scene
from diffproj.cli.units import Length, in_unit
from diffproj.geometry.plane import Plane
from diffproj.measurement.default_plane import far_from_landmarks

FLAT = 1e-9
"""Parts of the board's size by which its corners may lie off a plane z = const, and still be flat."""


def plane_of(scene: Scene, options: argparse.Namespace) -> Plane:
    """The plane that the options say; the face, or z = 0 of landmarks, where they say none.

    Raises:
        ValueError: as `plane_at_height`.

    Warns:
        UserWarning: none is said, and z = 0 is far from all landmarks.
    """
    if options.plane is None:
        far = far_from_landmarks(scene.calibration, scene.view) if options.height is None else None
        if far is not None:
            said = far.in_words(scene.square.unit)
            warn_caller(
                f"{said}; give its height, such as --height {far.nearest:.10g}, or --height 0 if z = 0 is meant"
            )
        return plane_at_height(scene, options.height or Length(0.0))
    return Plane(torch.tensor(options.plane[:3], dtype=torch.float64, device="cpu"), options.plane[3])


def plane_at_height(scene: Scene, height: Length) -> Plane:
    """The plane at a height above the face that the camera sees; negative below.

    Raises:
        ValueError: the board does not lie in a plane z = const, or its unit is not known and the height has one.
    """
    face, value = _face(scene), in_unit(height, scene.square.unit)
    if value is None:
        raise ValueError(
            f"--height: want it in {scene.unit_in_words}, got {height}; leave its unit out, or give --square with its "
            "unit"
        )
    if face is None:
        raise ValueError(
            f"--height: want a board in a plane z = const, got another one in {scene.camera_file}; give --plane"
        )
    z, towards_camera = face
    return Plane.z(z + towards_camera * value)


def height_above_face(scene: Scene, plane: Plane) -> float | None:
    """How far a plane lies above the board's face, negative below; `None` where it is not parallel to the face."""
    face, (a, b, c) = _face(scene), plane.normal.tolist()
    if face is None or max(abs(a), abs(b)) > FLAT * abs(c):
        return None
    z, towards_camera = face
    return (float(plane.offset) / c - z) * towards_camera + 0.0  # no negative zero


def described(plane: Plane, height: float | None, unit: str | None) -> str:
    """The plane for people: `z = -12, 12 mm above the board's face`."""
    text = equation([*plane.normal.tolist(), float(plane.offset)])
    if height is None:
        return text
    if height == 0:
        return f"{text}, the board's face"
    size = f"{abs(height):.6g}" + (f" {unit}" if unit else "")
    return f"{text}, {size} {'above' if height > 0 else 'below'} the board's face"


def equation(plane: list[float]) -> str:
    """The plane's equation for people: `z = 0`, `0.6 x + 0.8 z = 5`."""
    *normal, offset = plane
    terms = [(factor, name) for factor, name in zip(normal, "xyz", strict=True) if factor]
    text = " ".join(
        f"{'-' if factor < 0 else '+'} {'' if abs(factor) == 1 else f'{abs(factor):g} '}{name}"
        for factor, name in terms
    )
    text = text.removeprefix("+ ") if text.startswith("+") else text.replace("- ", "-", 1)
    return f"{text} = {plain(offset)}"


def _face(scene: Scene) -> tuple[float, float] | None:
    """The z of the board's face, and 1 or -1 for the side of it that the camera is on: it sees no board from behind."""
    calibration: Calibration = scene.calibration
    if scene.has_landmarks:
        return 0.0, 1.0
    heights = calibration.points[:, 2]
    size = float((calibration.points.amax(0) - calibration.points.amin(0)).max())
    if float(heights.max() - heights.min()) > FLAT * size:
        return None
    z = float(heights.mean())
    camera = scene.camera
    centre = -(camera.R.mT @ camera.t.unsqueeze(-1)).squeeze(-1)
    return z, float(torch.sign(centre[2] - z))
