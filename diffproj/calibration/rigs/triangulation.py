"""Points from their pixels in several cameras of a rig, with the covariance of pixels and rig.

A point's position minimises `sum_c |project_c(X) - uv_c|^2 / sigma_c^2`. With `J_c` the derivative by the point and
`G_c` by camera c's parameters and place, at the minimum and to first order

    dX = -A^-1 sum J_c^T (G_c dtheta - d uv_c) / sigma_c^2          A = sum J_c^T J_c / sigma_c^2

so that points share the rig's errors, and each has those of its own pixels besides.

What the residuals of a point tell besides is whether its pixels are of one point. They are the part of the errors that
the point does not take up, `P e` with P the projection off the columns of J, and their chi-square has two degrees of
freedom a camera, less three: with two cameras that of the distance from each other's epipolar lines. Where chance does
not explain it nothing tells which pixel is wrong, and the covariance grows by chi-square over its degrees of freedom.

Where a camera's lens is extrapolated, the rig's part is larger than to first order: see `extrapolation.py`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.arguments import called, number, position
from diffproj._core.copying import Copied
from diffproj._core.numerics import check_tensor
from diffproj._core.shown import Shown
from diffproj._core.shown import number as shown
from diffproj._core.warn import warn_caller
from diffproj.calibration.results.mismatch import CameraDisagreementWarning
from diffproj.calibration.rigs.curved import curved
from diffproj.calibration.rigs.extrapolation import Rig, beyond_corners, stretch
from diffproj.geometry.cayley import cross_matrix
from diffproj.geometry.grid import warn_if_off_image
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.slopes import by_direction

CHANCE = 1e-4
"""How likely the residuals of any of the points may be by chance before their cameras disagree."""
MOST_NAMED = 5
"""Points that a warning names."""
STEPS = 12
"""Gauss-Newton steps from the point nearest to all rays; noise of pixels takes three or four."""


@dataclass(frozen=True, eq=False, repr=False)
class Triangulation(Shown, Copied):
    """Points in the rig's frame, and how sure each of them is.

    Attributes:
        points: `(N, 3)` in world units; 0 where not valid.
        valid: where at least two cameras see the point, in front of them, from different directions `(N,)`.
        covariance: of each point `(N, 3, 3)`, in squared world units, to first order: of its pixels and the rig; NaN if
            not valid, and infinite where an extrapolated lens may end before the pixel.
        residuals: projected minus seen pixels, by camera, `(N, 2)`; 0 where a camera does not see the point.
        disagrees: where the residuals are larger than noise and rig explain, as where a camera's pixel is that of
            another point `(N,)`. The covariance there is as much larger as it takes to explain them.
        extrapolated: seen by a camera outside of the region that its corners covered `(N,)`, where the lens model is
            extrapolated. The covariance holds what the calibration leaves open there, as long as lens and camera agree.
        nonlinear: where deviations mislead `(N,)`, for the rays are nearly parallel: the point may lie much further off
            than `deviations` say, up to infinity, while the direction to it is as sure as they say. Cameras further
            apart, or less noise, tell it.
    """

    points: Float[Tensor, "n 3"]
    valid: Bool[Tensor, " n"]
    covariance: Float[Tensor, "n 3 3"]
    residuals: dict[str, Float[Tensor, "n 2"]]
    disagrees: Bool[Tensor, " n"]
    extrapolated: Bool[Tensor, " n"]
    nonlinear: Bool[Tensor, " n"]
    _by_rig: Tensor  # derivative of the points by a root of the rig's covariance (N, 3, s)
    _of_pixels: Tensor  # covariance of the pixels' noise alone (N, 3, 3)

    @property
    def deviations(self) -> Float[Tensor, "n 3"]:
        """The standard deviation of each coordinate `(N, 3)`, in world units; NaN where not valid."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).sqrt()

    def between(self, i: int, j: int) -> Float[Tensor, "3 3"]:
        """The cross-covariance of two points, `(3, 3)`; they share the rig's errors.

        Raises:
            TypeError: a number of a point is no whole number.
            ValueError: there is no such point.
        """
        i, j = (position(name, value, len(self.points), "points") for name, value in (("i", i), ("j", j)))
        if i == j:
            return self.covariance[i]
        return self._by_rig[i] @ self._by_rig[j].mT

    def length(self, i: int, j: int) -> tuple[float, float]:
        """The distance between two points and its standard deviation, in world units; NaN where one is not valid.

        Raises:
            TypeError: a number of a point is no whole number.
            ValueError: there is no such point.
        """
        i, j = (position(name, value, len(self.points), "points") for name, value in (("i", i), ("j", j)))
        apart = self.points[j] - self.points[i]
        length = apart.norm()
        along = apart / length.clamp(min=torch.finfo(length.dtype).tiny)
        shift = along @ (self._by_rig[j] - self._by_rig[i])
        noise = self._of_pixels[i] + self._of_pixels[j]
        variance = torch.inf * length if bool(noise.isinf().any()) else shift @ shift + along @ noise @ along
        known = bool(self.valid[i] & self.valid[j])
        return float(length) if known else math.nan, float(variance.sqrt())

    def to_dict(self) -> dict[str, list[Any]]:
        """Points and deviations as columns of numbers, NaN where not valid: `pandas.DataFrame` takes it."""
        points = torch.where(self.valid.unsqueeze(-1), self.points, torch.nan)
        columns = {name: points[:, i].tolist() for i, name in enumerate("xyz")}
        columns |= {f"{name}_deviation": self.deviations[:, i].tolist() for i, name in enumerate("xyz")}
        flags = {"valid": self.valid, "disagrees": self.disagrees, "extrapolated": self.extrapolated}
        flags["nonlinear"] = self.nonlinear
        return columns | {name: flag.tolist() for name, flag in flags.items()}

    def _facts(self) -> list[str]:
        size = self.deviations[self.valid].square().sum(-1).sqrt()
        return [
            f"{len(self.points)} points",
            f"{int(self.valid.sum())} valid",
            f"deviation {shown(size, '.3g')}",
            f"{int(self.disagrees.sum())} doubtful" if bool(self.disagrees.any()) else "",
            f"{int(self.extrapolated.sum())} extrapolated" if bool(self.extrapolated.any()) else "",
            f"{int(self.nonlinear.sum())} nonlinear" if bool(self.nonlinear.any()) else "",
        ]

    def _columns(self) -> dict[str, list[Any]]:
        return self.to_dict()


def triangulated(rig: Rig, pixels_by_camera: Any, pixel_sigma: Any) -> Triangulation:
    """What `RigCalibration.triangulate` promises."""
    pixels, sigma = _checked(rig, pixels_by_camera, pixel_sigma)
    seen = {name: uv.isfinite().all(-1) for name, uv in pixels.items()}
    X, valid = _nearest(rig, pixels, seen)
    with torch.no_grad():
        for _ in range(STEPS):
            A, b, _ = _normal(rig, X, pixels, seen, sigma)
            step = torch.linalg.solve_ex(A, b.unsqueeze(-1))[0].squeeze(-1)
            good = step.isfinite().all(-1) & valid
            X = X - torch.where(good.unsqueeze(-1), step, 0.0)
    A, _, (J, residuals, projected) = _normal(rig, X, pixels, seen, sigma)
    count = torch.stack([seen[name] & projected[name] for name in pixels]).sum(0)
    lost = torch.stack([seen[name] & ~projected[name] for name in pixels]).any(0)
    scale = A.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    condition = torch.linalg.eigvalsh((A * scale.unsqueeze(-1) * scale.unsqueeze(-2)).nan_to_num(0.0))[:, 0]
    valid = valid & (count >= 2) & ~lost & (condition > 1e-12) & X.isfinite().all(-1)
    eye = torch.eye(3, dtype=X.dtype, device=X.device)
    inverse = torch.linalg.inv(torch.where(valid[:, None, None], A, eye))
    root = _root(rig)
    whole = {name: seen[name].to(X)[:, None, None] / sigma[name] for name in pixels}
    slopes = torch.cat([J[name] * whole[name] for name in pixels], dim=-2)  # (N, 2 c, 3), in deviations
    shifts = torch.cat([_by_parameters(rig, name, X) * whole[name] @ root[rig.columns[name]] for name in pixels], -2)
    off = torch.cat([residuals[name].unsqueeze(-1) * whole[name] for name in pixels], dim=-2)
    by_rig = -inverse @ slopes.mT @ shifts
    extrapolated = valid & beyond_corners(rig, pixels, seen)
    factor = stretch(rig, extrapolated, X, whole, slopes, inverse, root, by_rig)
    unknown = factor.isinf()
    factor = torch.where(unknown, 0.0, factor)[:, None, None]  # an unknown point's errors go with no other's
    by_rig, shifts = factor * by_rig, factor * shifts
    disagrees, scale = _disagreement(slopes, shifts, off, inverse, count, valid & ~unknown)
    if bool(disagrees.any()):
        warn_caller(_doubt(disagrees), CameraDisagreementWarning)
    by_rig = torch.where(valid[:, None, None], scale.sqrt()[:, None, None] * by_rig, torch.nan)
    inverse = torch.where(unknown[:, None, None], torch.diag_embed(torch.full_like(X, torch.inf)), inverse)
    inverse = torch.where(valid[:, None, None], scale[:, None, None] * inverse, torch.nan)
    covariance = inverse + by_rig @ by_rig.mT
    nonlinear = curved(rig.cameras, X, whole, slopes, covariance)
    points = torch.where(valid.unsqueeze(-1), X, 0.0)
    left = {name: torch.where(valid.unsqueeze(-1), residuals[name], 0.0) for name in pixels}
    return Triangulation(points, valid, covariance, left, disagrees, extrapolated, nonlinear, by_rig, inverse)


def _disagreement(
    J: Tensor, G: Tensor, off: Tensor, inverse: Tensor, count: Tensor, valid: Tensor
) -> tuple[Tensor, Tensor]:
    """Where residuals are none of chance `(N,)`, and the factor on variances that explains them; 1 elsewhere.

    Args:
        J: derivatives of all pixels by the point, in deviations `(N, 2 c, 3)`.
        G: by a root of the rig's covariance `(N, 2 c, s)`.
        off: the residuals `(N, 2 c, 1)`.
        inverse: of `J^T J` `(N, 3, 3)`.
        count: how many cameras see the point `(N,)`.
        valid: where there is a point `(N,)`.
    """
    apart = torch.eye(J.shape[-2], dtype=J.dtype, device=J.device) - J @ inverse @ J.mT
    left = apart @ G
    spread = torch.eye(J.shape[-2], dtype=J.dtype, device=J.device) + left @ left.mT  # 1 in what the point takes up
    squares = (off * torch.linalg.solve_ex(spread, off)[0]).sum((-2, -1))
    spare = (2.0 * count.to(J) - 3).clamp(min=1)
    chance = torch.special.gammaincc(spare / 2, squares.nan_to_num(0.0, 0.0) / 2)
    disagrees = valid & (chance < CHANCE / max(1, int(valid.sum())))
    return disagrees, torch.where(disagrees, squares / spare, 1.0)


def _doubt(disagrees: Tensor) -> str:
    which = disagrees.nonzero().flatten().tolist()
    listed = ", ".join(map(str, which[:MOST_NAMED])) + f" and {len(which) - MOST_NAMED} more" * (
        len(which) > MOST_NAMED
    )
    what = f"point {listed} is" if len(which) == 1 else f"points {listed} are"
    return (
        f"triangulate: {what} further from the cameras' rays than the deviations explain: are these pixels of one "
        "point, of one moment, and as exact as pixel_sigma says, and did the cameras stand still?"
    )


def _checked(rig: Rig, pixels_by_camera: Any, pixel_sigma: Any) -> tuple[dict[str, Tensor], dict[str, float]]:
    if not isinstance(pixels_by_camera, Mapping):
        raise TypeError(
            f"pixels_by_camera: want a mapping from names of cameras to pixels (N, 2), got {called(pixels_by_camera)}"
        )
    for name in pixels_by_camera:
        if name not in rig.cameras:
            raise ValueError(f"pixels_by_camera: want names of cameras, {', '.join(rig.cameras)}, got {called(name)}")
    if len(pixels_by_camera) < 2:
        raise ValueError(f"pixels_by_camera: want those of at least two cameras, got {len(pixels_by_camera)}")
    pixels = {}
    for name, value in pixels_by_camera.items():
        uv = check_tensor(f"pixels_by_camera[{name!r}]", value, "N", 2)
        if uv.ndim != 2 or uv.is_meta:
            raise ValueError(f"pixels_by_camera[{name!r}]: want shape (N, 2) with values, got {tuple(uv.shape)}")
        pixels[name] = uv.detach().to(rig.cameras[name].t)
        warn_if_off_image(f"triangulate: {name}", pixels[name], None, rig.cameras[name].size)
    counts = {name: len(uv) for name, uv in pixels.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"pixels_by_camera: want the same points in each, NaN where one is not seen, got {counts}")
    sigma = {}
    for name in pixels:
        given = pixel_sigma.get(name) if isinstance(pixel_sigma, Mapping) else pixel_sigma
        if given is None:
            known = rig.calibrations[name].pixel_sigma
            if known is None or not bool(known > 0):
                raise ValueError(f"pixel_sigma: want a standard deviation in px, for that of {name!r} is not known")
            given = float(known)
        sigma[name] = number("pixel_sigma", given, "a positive number of px, or one by camera", above=0, most=1e100)
    return pixels, sigma


def _nearest(rig: Rig, pixels: dict[str, Tensor], seen: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """The points nearest to all their rays `(N, 3)`, and where at least two rays say so."""
    like = next(iter(pixels.values()))
    A, b = like.new_zeros(len(like), 3, 3), like.new_zeros(len(like), 3)
    count = torch.zeros(len(like), dtype=torch.long, device=like.device)
    for name, uv in pixels.items():
        origin, direction, valid = rig.cameras[name].rays(torch.where(seen[name].unsqueeze(-1), uv, 0.0))
        valid = valid & seen[name]
        across = torch.eye(3, dtype=uv.dtype, device=uv.device) - direction.unsqueeze(-1) * direction.unsqueeze(-2)
        across = torch.where(valid[:, None, None], across, 0.0)
        A, b, count = A + across, b + (across @ origin.unsqueeze(-1)).squeeze(-1), count + valid.long()
    X, info = torch.linalg.solve_ex(A, b.unsqueeze(-1))
    X = X.squeeze(-1)
    sound = (count >= 2) & (info == 0) & X.isfinite().all(-1)
    ahead = torch.tensor([0.0, 0, 1], dtype=X.dtype, device=X.device)
    return torch.where(sound.unsqueeze(-1), X, ahead), sound


def _normal(
    rig: Rig,
    X: Tensor,
    pixels: dict[str, Tensor],
    seen: dict[str, Tensor],
    sigma: dict[str, float],
) -> tuple[Tensor, Tensor, tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Tensor]]]:
    """The normal equations of points, and by camera derivatives `(N, 2, 3)`, residuals and which are projected."""
    A, b = X.new_zeros(len(X), 3, 3), X.new_zeros(len(X), 3)
    slopes, residuals, projected = {}, {}, {}
    for name, uv in pixels.items():
        camera = rig.cameras[name]
        at, valid = camera.project(X)
        counts = seen[name] & valid
        off = torch.where(counts.unsqueeze(-1), at - uv.nan_to_num(0.0), 0.0)
        J = torch.where(counts[:, None, None], _by_camera_point(rig, name, X) @ camera.R, 0.0)
        A = A + J.mT @ J / sigma[name] ** 2
        b = b + (J.mT @ off.unsqueeze(-1)).squeeze(-1) / sigma[name] ** 2
        slopes[name], residuals[name], projected[name] = J, off, valid
    return A, b, (slopes, residuals, projected)


def _by_camera_point(rig: Rig, name: str, X: Tensor) -> Tensor:
    """Derivatives of pixels by the point in the camera's frame `(N, 2, 3)`."""
    camera = rig.cameras[name]
    return camera.K[:2, :2] @ by_direction(camera.distortion, _directions(rig, name, X))


def _directions(rig: Rig, name: str, X: Tensor) -> Tensor:
    camera = rig.cameras[name]
    direction = X @ camera.R.mT + camera.t
    _, valid = camera.project(X)
    ahead = torch.tensor([0.0, 0, 1], dtype=X.dtype, device=X.device)
    return torch.where(valid.unsqueeze(-1), direction, ahead)


def _by_parameters(rig: Rig, name: str, X: Tensor) -> Tensor:
    """Derivatives of pixels by a camera's intrinsics and its place in the rig `(N, 2, own)`."""
    camera, F = rig.cameras[name], rig.cameras[name].K[:2, :2].expand(len(X), 2, 2)
    direction = _directions(rig, name, X)
    at, _ = camera.project(X)
    xy = torch.linalg.solve(camera.K[:2, :2], (at - camera.K[:2, 2]).mT).mT
    columns = [torch.diag_embed(xy), torch.eye(2, dtype=F.dtype, device=F.device).expand_as(F)]
    if isinstance(camera.distortion, CoefficientLens):
        columns.append(F @ camera.distortion.by_coefficients(direction))
    if rig.calibrations[name].skew:
        columns.append(torch.nn.functional.pad(xy[..., 1:, None], (0, 0, 0, 1)))
    if name != next(iter(rig.cameras)):
        by_point = F @ by_direction(camera.distortion, direction)
        arm = direction - camera.t  # R X, which turns
        columns += [-by_point @ cross_matrix(arm), by_point]
    return torch.cat(columns, dim=-1)


def _root(rig: Rig) -> Tensor:
    """A root of the covariance of the rig `(s, s)`."""
    sigma = rig.covariance.shared
    scale = torch.where(sigma.diagonal().isfinite(), sigma.diagonal(), 0.0).clamp(min=0).sqrt()
    unit = torch.where(scale > 0, scale, 1.0)
    sigma = torch.where(sigma.isfinite(), sigma, 0.0)
    values, vectors = torch.linalg.eigh(sigma / unit.unsqueeze(-1) / unit)
    return scale.unsqueeze(-1) * vectors * values.clamp(min=0).sqrt()
