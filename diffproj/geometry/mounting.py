"""How a camera is mounted: height, tilt, roll and heading over level ground, and the way from there to a pose and back.

The world is that of a map: x east or to the right, y north or ahead, z up, the ground z = 0. With tilt t, roll r and
heading h the camera's axes point in it along

    ahead      f = (cos t sin h, cos t cos h, -sin t)
    right      x = cos r a - sin r b            a = (cos h, -sin h, 0), to the right on the level
    down       y = cos r b + sin r a            b = f x a, straight down in the picture where there is no roll

and are the rows of R.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, called, meeting
from diffproj._core.numerics import broadcast_batches, check_same_kind, check_tensor, dot, has_values
from diffproj._core.warn import warn_caller
from diffproj.geometry.camera_parts import CameraParts
from diffproj.geometry.description import without_pose
from diffproj.geometry.grid import checked_size
from diffproj.geometry.intrinsics import intrinsic_matrix
from diffproj.lens.protocol import Lens

C = TypeVar("C", bound="Mounted")
LARGEST_SIDE = 10**6
"""Of an image in px, and more than any camera has."""

Number = Float[Tensor, "*#batch"] | Array | float
"""One for all cameras, or one each `(*B,)`."""


class Mounting(NamedTuple):
    """How cameras are mounted, batch shape `*B`: heights in world units, angles in degrees, as `Camera.mounted` says.

    Attributes:
        height: of the centre of projection over z = 0 `(*B,)`.
        tilt: of the optical axis below the horizon `(*B,)`, from -90 to 90.
        roll: by which the horizon sinks to the right in the picture `(*B,)`, from -180 to 180; 0 where the camera looks
            straight down or up.
        heading: clockwise from y `(*B,)`, from 0 to 360: where the camera looks, and the top of the picture points to
            where it looks straight down.
        position: x and y of the centre of projection `(*B, 2)`.
    """

    height: Float[Tensor, "*batch"]
    tilt: Float[Tensor, "*batch"]
    roll: Float[Tensor, "*batch"]
    heading: Float[Tensor, "*batch"]
    position: Float[Tensor, "*batch 2"]


class Mounted(CameraParts):
    """Cameras on masts, roofs and drones: the part of `Camera` that is about their mounting."""

    __slots__ = ()

    @classmethod
    def mounted(
        cls: type[C],
        height: Number,
        tilt_deg: Number,
        roll_deg: Number = 0.0,
        heading_deg: Number = 0.0,
        *,
        size: tuple[int, int],
        focal: Number | tuple[Number, Number] | None = None,
        fov_deg: Number | None = None,
        focal_mm: Number | None = None,
        sensor_mm: Number | tuple[Number, Number] | None = None,
        principal_point: Float[Tensor, "*#batch 2"] | Array | None = None,
        position: Float[Tensor, "*#batch 2"] | Array | None = None,
        distortion: Lens | None = None,
    ) -> C:
        """A camera over level ground, as one measures it with a tape, a level and a compass.

        The world's x points east or to the right, y north or ahead, z up; the ground is z = 0. With no heading the
        camera looks along y. Gradients flow to every number. The guide draws it, under conventions.

        Args:
            height: of the centre of projection over the ground, in world units.
            tilt_deg: how far the optical axis points below the horizon, from -90 to 90; 90 is straight down.
            roll_deg: by how much the horizon sinks to the right in the picture: the camera is turned to the left about
                its axis. (Tools that count the turn of the camera to the right have the other sign.)
            heading_deg: where the camera looks, clockwise from y. Where it looks straight down, the top of the picture
                points there.
            size: image size `(width, height)` in px.
            focal: focal length in px; a tuple `(f_x, f_y)` where they differ.
            fov_deg: in the place of it, the horizontal field of view from the left edge of the image to the right one,
                lens aside.
            focal_mm: in the place of it, the focal length in mm, along with
            sensor_mm: the width of the sensor in mm; `(width, height)` where its pixels are not square.
            principal_point: `(*B, 2)` in px; the middle of the image, `((width - 1) / 2, (height - 1) / 2)`, if left
                out.
            position: x and y of the centre of projection `(*B, 2)`; above the origin if left out.
            distortion: the lens.

        Raises:
            TypeError: not numbers, or tensors of mixed dtypes.
            ValueError: a number that cannot be, none or several of the focal lengths, or shapes that do not broadcast.

        Example:
            >>> import diffproj as dp
            >>> camera = dp.Camera.mounted(2.18, 14.0, focal=800.0, size=(641, 481))
            >>> ground, valid = dp.back_project([[300.0, 300.0]], camera, dp.Plane.z(0.0))
            >>> print("{:.4f} to the right, {:.4f} ahead".format(*ground[0, :2].tolist()))
            -0.1732 to the right, 6.5959 ahead
            >>> round(camera.mounting().tilt.item(), 6)
            14.0
        """
        sides = checked_size(size)
        if sides is None:
            raise TypeError("size: want (width, height) of the image in px, got None")
        if max(sides) > LARGEST_SIDE:
            raise ValueError(f"size: want (width, height) of at most {LARGEST_SIDE:,} px, got {size}")
        kind = meeting(
            *(
                one
                for one in (height, tilt_deg, roll_deg, heading_deg, *_parts(focal), fov_deg, focal_mm)
                if isinstance(one, Tensor)
            ),
            *(one for one in (principal_point, position) if isinstance(one, Tensor)),
            distortion,
        )
        kind = torch.empty(0, dtype=torch.float64, device="cpu") if kind is None else kind
        height = _number("height", height, kind, "a height above the ground, more than 0", lambda x: x > 0)
        tilt = _number("tilt_deg", tilt_deg, kind, "degrees below the horizon, from -90 to 90", lambda x: x.abs() <= 90)
        roll, heading = (
            _number(name, angle, kind, "degrees", lambda x: x.isfinite())
            for name, angle in (("roll_deg", roll_deg), ("heading_deg", heading_deg))
        )
        f_x, f_y = focal_lengths(sides, kind, focal, fov_deg, focal_mm, sensor_mm)
        middle = [(side - 1) / 2 for side in sides] if principal_point is None else principal_point
        center = check_tensor("principal_point", middle, 2, like=kind)
        place = check_tensor("position", (0.0, 0.0) if position is None else position, 2, like=kind)
        for name, part in (("principal_point", center), ("position", place)):
            if has_values(part) and not bool(part.isfinite().all()):
                raise ValueError(f"{name}: want finite numbers, got {part.tolist()}")
        parts = {"height": height, "tilt_deg": tilt, "roll_deg": roll, "heading_deg": heading, "focal": f_x}
        check_same_kind(**parts, principal_point=center, position=place)
        shapes = {name: part.shape for name, part in parts.items()}
        shapes |= {"focal_y": f_y.shape, "principal_point": center.shape[:-1], "position": place.shape[:-1]}
        batch = broadcast_batches(**shapes)
        focals = torch.stack(torch.broadcast_tensors(f_x, f_y), dim=-1)
        K = intrinsic_matrix(focals.expand(*batch, 2), center.expand(*batch, 2))
        R = rotation_from_mounting(tilt, roll, heading).expand(*batch, 3, 3)
        C = torch.cat([place.expand(*batch, 2), height.expand(batch).unsqueeze(-1)], dim=-1)
        return cls(K, R, -dot(R, C.unsqueeze(-2)), distortion, sides)  # type: ignore[call-arg]

    def mounting(self) -> Mounting:
        """Height, tilt, roll, heading and position of the camera: what `mounted` took.

        Where it looks straight down or up, heading and roll turn it about the same axis: the roll is 0 then, and the
        heading that of the picture's top. Where it leans beyond the vertical, by 1 degree say, the tilt is 89
        and roll and heading are half a turn further. A turned image counts as taken by a turned camera (`upright`).

        Raises:
            TypeError: the image is turned, behind a lens of another package.
            ValueError: no lens describes the turned image: see `upright`.

        Example:
            >>> import diffproj as dp
            >>> drone = dp.Camera.mounted(60.0, 90.0, heading_deg=30.0, fov_deg=84.0, size=(4000, 3000))
            >>> found = drone.mounting()
            >>> print(f"{found.height:.1f} m up, tilt {found.tilt:.1f}, heading {found.heading:.1f} degrees")
            60.0 m up, tilt 90.0, heading 30.0 degrees
        """
        own: Any = self
        if own.t.numel() and has_values(own.R, own.t) and without_pose(own.R, own.t):
            warn_caller(
                "mounting: the camera has no pose, and counts as looking straight up from the origin; the camera of a "
                "calibration has none, its cameras have one for each view"
            )
        return mounting_of(own)


def mounting_of(camera: Any) -> Mounting:
    """That of a camera that may have no pose yet, without a warning, as where one is sought from there."""
    camera = camera.upright()
    tilt, roll, heading = mounting_from_rotation(camera.R)
    x, y, height = camera.center.unbind(-1)
    return Mounting(height, tilt, roll, heading, torch.stack([x, y], dim=-1))


def rotation_from_mounting(
    tilt: Float[Tensor, "*#batch"], roll: Float[Tensor, "*#batch"], heading: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*out 3 3"]:
    """The rotation world to camera from angles in degrees."""
    tilt, roll, heading = torch.broadcast_tensors(tilt, roll, heading)
    (sin_t, cos_t), (sin_r, cos_r), (sin_h, cos_h) = (
        (angle.deg2rad().sin(), angle.deg2rad().cos()) for angle in (tilt, roll, heading)
    )
    level = torch.stack([cos_h, -sin_h, torch.zeros_like(sin_h)], dim=-1)
    ahead = torch.stack([cos_t * sin_h, cos_t * cos_h, -sin_t], dim=-1)
    below = torch.stack([-sin_t * sin_h, -sin_t * cos_h, -cos_t], dim=-1)
    sin_r, cos_r = sin_r.unsqueeze(-1), cos_r.unsqueeze(-1)
    return torch.stack([cos_r * level - sin_r * below, cos_r * below + sin_r * level, ahead], dim=-2)


def mounting_from_rotation(
    R: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Tilt, roll and heading in degrees of a rotation world to camera; the heading is in [0, 360)."""
    (right_x, right_y, right_z), down_z, ahead = R[..., 0, :].unbind(-1), R[..., 1, 2], R[..., 2, :]
    across = ahead[..., 0].square() + ahead[..., 1].square()
    vertical = across <= (16 * torch.finfo(R.dtype).eps) ** 2
    # atan2(0, 0) and the root of 0 have no derivative: their arguments are replaced there.
    level = torch.where(vertical, 1.0, across).sqrt()
    tilt = torch.atan2(-ahead[..., 2], torch.where(vertical, 0.0, level))
    roll = torch.atan2(torch.where(vertical, 0.0, right_z), torch.where(vertical, 1.0, -down_z))
    heading = torch.atan2(
        torch.where(vertical, -right_y, ahead[..., 0]), torch.where(vertical, right_x, ahead[..., 1])
    ).rad2deg()
    return tilt.rad2deg(), roll.rad2deg(), torch.where(heading < 0, heading + 360, heading)


def focal_lengths(
    size: tuple[int, int],
    kind: Any,
    focal: Any,
    fov_deg: Any,
    focal_mm: Any,
    sensor_mm: Any,
) -> tuple[Tensor, Tensor]:
    """`f_x` and `f_y` in px, from the one way in which they were said."""
    said = [
        name for name, value in (("focal", focal), ("fov_deg", fov_deg), ("focal_mm", focal_mm)) if value is not None
    ]
    if len(said) != 1:
        got = " and ".join(said) or "none"
        raise ValueError(f"focal: want one of focal (px), fov_deg, or focal_mm with sensor_mm, got {got}")
    if (focal_mm is None) != (sensor_mm is None):
        got = "focal_mm" if sensor_mm is None else "sensor_mm"
        raise ValueError(f"focal_mm: want focal_mm and sensor_mm together, got {got} alone")
    width, height = size
    if focal is not None:
        want = "a focal length in px, more than 0"
        x, *y = (_number("focal", one, kind, want, _positive) for one in _parts(focal))
        return x, y[0] if y else x
    if fov_deg is not None:
        want = "degrees from edge to edge, between 0 and 180"
        angle = _number("fov_deg", fov_deg, kind, want, lambda x: (x > 1e-9) & (x < 180))
        f = width / 2 / (angle.deg2rad() / 2).tan()
        return f, f
    length = _number("focal_mm", focal_mm, kind, "a focal length in mm, more than 0", _positive)
    given = sensor_mm if isinstance(sensor_mm, tuple | list) and len(sensor_mm) == 2 else (sensor_mm,)
    sides = [_number("sensor_mm", side, kind, "the sensor's width in mm, more than 0", _positive) for side in given]
    f = length / sides[0] * width
    return f, length / sides[1] * height if len(sides) == 2 else f


def _positive(length: Tensor) -> Tensor:
    """Which lengths are such, and neither vanish nor overflow where they are squared."""
    return (length > 1e-30) & (length < 1e30)


def _parts(focal: Any) -> tuple[Any, ...]:
    """`(f_x, f_y)` of a tuple, else the one number."""
    if not isinstance(focal, tuple):
        return (focal,)
    if len(focal) != 2:
        raise ValueError(f"focal: want a number, or a tuple (f_x, f_y), got {len(focal)} of them")
    return focal


def _number(name: str, value: Any, kind: Any, want: str, sound: Callable[[Tensor], Tensor]) -> Tensor:
    if value is None or isinstance(value, bool | str):
        raise TypeError(f"{name}: want {want}, got {called(value)}")
    found = check_tensor(name, value, like=kind)
    if has_values(found) and not bool((sound(found) & found.isfinite()).all()):
        first = found[~(sound(found) & found.isfinite())][0].item()
        raise ValueError(f"{name}: want {want}, got {first:g}")
    return found
