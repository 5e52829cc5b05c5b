"""`Landmarks`: points that were surveyed, and that photographs show: on a ground, on a façade, or anywhere in space."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, called, first_of, listing, tensor_of
from diffproj._core.copying import Copied
from diffproj._core.numerics import check_tensor, in_float64
from diffproj._core.shown import Shown

FINEST = 1e-5
"""Part of the landmarks' extent that their coordinates must resolve: of 100 m a millimetre."""
DEGREES_SPREAD, DEGREES_PART = 0.05, 1e-3
"""Spread of coordinates, on both axes, below which they may be degrees (0.05 degrees are some kilometres), and relative
to their size: metres of a place this far from their origin spread further."""
POLE_PART, WHOLE = 0.1, 1e-6
"""How far off one line marks on a pole may be, as a part of how far it leans; and their x and y off whole thousandths,
beside rounding."""


class Landmarks(Copied, Shown):
    """Surveyed points, wherever a board is taken: `locate`, `calibrate`, `refine`, `cross_validate` and residuals.

    They may lie on the ground z = 0, on any other plane, or anywhere in space, and as far from the origin as UTM, State
    Plane or earth-centred coordinates are; distances and a right-handed frame are what they must have. Four of them
    that do not lie on a line tell where a known camera stands; six and more that do not lie on a plane tell a focal
    length too; fewer, and be it one, are evidence beside other for `adjust`, as `Seen`. In `Views` each has a pixel, in
    the landmarks' order, or is not visible.

    Where they come with a sigma, `locate` and one view count that along with the pixels' noise. Several views in
    `calibrate` and `refine` see a landmark off in the same way: its place is found along with the camera then, from
    where it was surveyed, as surely as that is (`Calibration.points`, `points_deviation`).

    Attributes:
        points: in the world `(N, 3)`, in the caller's unit, such as metres.
        names: N of them, in the same order.
        covariances: of the points `(N, 3, 3)` in squared world units; `None` where they count as exact.

    Example:
        >>> ground = Landmarks([[0.0, 0.0], [1.8, 0.0], [1.8, 4.6], [0.0, 4.6]], names=["a", "b", "c", "d"])
        >>> ground
        Landmarks(4 points on z = 0, extent 1.8 x 4.6 x 0)
        >>> ground.points[2].tolist()
        [1.8, 4.6, 0.0]
        >>> Landmarks(ground.points, sigma=[0.01, 0.01, 0.02, 0.02]).covariances.shape
        torch.Size([4, 3, 3])
    """

    __slots__ = ("covariances", "names", "points")

    points: Float[Tensor, "n 3"]
    names: tuple[str, ...]
    covariances: Float[Tensor, "n 3 3"] | None

    def __init__(
        self,
        points: Float[Tensor, "n d"] | Array,
        names: Sequence[str] | None = None,
        sigma: float | Float[Tensor, "..."] | Array | None = None,
    ) -> None:
        """Copy the points and check them.

        Args:
            points: `(N, 3)`, or `(N, 2)` for points on z = 0: lists, an array or a tensor, whose gradient is kept.
            names: of the N points, all different; `"1"`, `"2"`, ... if left out.
            sigma: how far off they may be: the standard deviation of each coordinate, a number or `(N,)`, that of x, y
                and z `(N, 3)`, or a covariance for each point `(N, 3, 3)`, in world units. Exact if left out.

        Raises:
            TypeError: points are no numbers, or names no strings.
            ValueError: shapes do not fit, no point or some not finite, float32 where it does not hold them, latitude
                and longitude, or a sigma that is negative or no covariance.
        """
        given = tensor_of("points", points)
        if given.ndim != 2 or given.shape[-1] not in (2, 3):
            raise ValueError(f"points: want shape (N, 3), or (N, 2) for points on z = 0, got {tuple(given.shape)}")
        given = check_tensor("points", given, "N", given.shape[-1])
        if given.shape[-1] == 2:
            given = torch.nn.functional.pad(given, (0, 1))
        _check_values(given.detach())
        self.points, self.names = given.clone(), _checked_names(names, len(given))
        self.covariances = None if sigma is None else _covariances(sigma, in_float64(given))

    def __len__(self) -> int:
        """The number of points, N."""
        return len(self.points)

    def _facts(self) -> list[str]:
        points = self.points.detach()
        extent = " x ".join(f"{side:.4g}" for side in (points.amax(0) - points.amin(0)).tolist())
        where = " on z = 0" if bool((points[:, 2] == 0).all()) else ""
        spread = ""
        if self.covariances is not None:
            spread = f"known to {float(self.covariances.diagonal(dim1=-2, dim2=-1).amax().sqrt()):.2g} at worst"
        return [f"{len(points)} points{where}", f"extent {extent}", spread]

    def _columns(self) -> dict[str, list[Any]]:
        x, y, z = self.points.detach().unbind(-1)
        return {"name": list(self.names), "x": x.tolist(), "y": y.tolist(), "z": z.tolist()}


def _check_values(points: Tensor) -> None:
    if points.is_meta:
        raise ValueError("points: want values, got a tensor on the device meta")
    if len(points) == 0:
        raise ValueError("points: want at least 1, got none")
    lost = ~points.isfinite().all(-1)
    if bool(lost.any()):
        raise ValueError(f"points: want finite coordinates, got {first_of(points, lost)}")
    spread = points.amax(0) - points.amin(0)
    extent, size = float(spread.amax()), float(points.abs().amax())
    if torch.finfo(points.dtype).eps * size > FINEST * extent > 0:
        name = str(points.dtype).removeprefix("torch.")
        raise ValueError(
            f"points: want float64 so far from the origin, got {name}, which holds {size:.3g} only to "
            f"{torch.finfo(points.dtype).eps * size / 2:.1g}: read them as float64, or subtract an origin first"
        )
    refuse_degrees("points", points)


def refuse_degrees(name: str, points: Tensor) -> None:
    """Refuse points `(N, 3)` that look like latitude and longitude, in either order, and a height.

    Raises:
        ValueError: they do.
    """
    along = points[:, :2].to(torch.float64)
    middle, spread = along.abs().mean(0), points.amax(0) - points.amin(0)
    turned, line = along % 360, along.abs() - 180
    beside = (line.abs() < DEGREES_SPREAD).all(0) & (line != 0).any(0)  # the date line; lengths may be 180 themselves
    across = torch.where(beside, turned.amax(0) - turned.amin(0), spread[:2].to(torch.float64))
    angles = bool((middle <= middle.new_tensor([180.0, 180.0])).all()) and bool((middle <= 90).any())
    small = (across < DEGREES_SPREAD).all() & (across < DEGREES_PART * middle.amax()).all()
    upright = bool(spread[2] > spread[:2].amax()) and (len(points) < 4 or _is_pole(points))
    apart = float(spread[:2].amax()) > 0  # not several places up one mast
    if angles and bool(small) and not upright and apart and float(middle.amax()) > 1 and float(middle.amin()) > 0:
        raise ValueError(
            f"{name}: want metres or another unit of length, got what looks like latitude and longitude in degrees "
            f"({along[0, 0]:.5f}, {along[0, 1]:.5f}): dp.metres_from_degrees converts them, latitude first; if they "
            "are lengths, subtract an origin"
        )


def _is_pole(points: Tensor) -> bool:
    """Whether points `(N, 3)`, higher than wide, are marks on a pole or a staff, be it one that leans.

    They are where they lie on one line, or where x and y are whole millimetres: in degrees that would be 100 m.
    """
    rounding = torch.finfo(points.dtype).eps * float(points[:, :2].abs().amax())
    points = points.to(torch.float64)
    along = points[:, :2]
    off = points - points.mean(0)
    slope = (off[:, 2:] * off).sum(0) / off[:, 2].square().sum()
    aside = (off - off[:, 2:] * slope).abs().amax()
    on_line = aside < POLE_PART * (along.amax(0) - along.amin(0)).amax()
    return bool(on_line) or bool(((along - along.round(decimals=3)).abs() < WHOLE + rounding).all())


def _checked_names(names: Sequence[str] | None, count: int) -> tuple[str, ...]:
    if names is None:
        return tuple(str(number + 1) for number in range(count))
    found = tuple(listing("names", names, "a name for each point"))
    if not all(isinstance(name, str) for name in found):
        raise TypeError(f"names: want strings, got {called(next(n for n in found if not isinstance(n, str)))}")
    if len(found) != count:
        raise ValueError(f"names: want one for each of the {count} points, got {len(found)}")
    if len(set(found)) < count:
        raise ValueError(f"names: want all different, got {next(n for n in found if found.count(n) > 1)!r} twice")
    return found


def _covariances(sigma: Any, points: Tensor) -> Tensor:
    """The covariance of each point `(N, 3, 3)` from deviations or covariances."""
    given, count = tensor_of("sigma", sigma), len(points)
    if given.is_complex() or given.is_meta or given.dtype == torch.bool:
        raise TypeError(f"sigma: want real numbers, got {given.dtype} on {given.device}")
    given = given.to(points)
    shape = tuple(given.shape)
    if shape == (count, 3, 3):
        size = given.detach().abs().amax((-2, -1), keepdim=True)
        even = ((given - given.mT).abs() <= 1e-9 * size).all(-1).all(-1)  # not where some are not finite
        values = torch.linalg.eigvalsh(torch.where(even[:, None, None], given.detach(), 0.0))
        wrong = ~even | (values < -1e-9 * size.squeeze(-1)).any(-1)
        if bool(wrong.any()):
            raise ValueError(
                f"sigma: want symmetric covariances without negative eigenvalues, got {first_of(given, wrong)}"
            )
        return (given + given.mT) / 2
    if shape not in ((), (count,), (count, 3)):
        raise ValueError(f"sigma: want a number, or shape ({count},), ({count}, 3) or ({count}, 3, 3), got {shape}")
    wrong = ~((given >= 0) & (given < math.inf))
    if bool(wrong.any()):
        raise ValueError(f"sigma: want finite standard deviations of at least 0, got {first_of(given, wrong)}")
    each = given.unsqueeze(-1) if shape == (count,) else given
    return torch.diag_embed(each.square().expand(count, 3)).clone()
