"""What a camera leaves over of the views of a target: on the image, in pixels, or on the plane, in world units.

The three functions after the public two, "projected minus seen", "put back minus known" and "nearest minus known", are
those by which calibrations, their validation and their derivatives count residuals.
"""

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.arguments import first_of
from diffproj._core.numerics import broadcast_batches, has_values
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.plane import Plane
from diffproj.targets.target import Target, points_of
from diffproj.targets.views import Views, as_views


def image_residuals(
    camera: Camera | PinholeCamera, views: Views, target: Target
) -> tuple[Float[Tensor, "*batch v n 2"], Bool[Tensor, "*batch v n"]]:
    """Projected minus seen corners in pixels, with gradients to camera, corners and the target's points.

    Args:
        camera: at the pose of each view, batch shape `(*B, V)`.
        views: corners `(*B, V, N, 2)`.
        target: anything with `.points (N, 3)`.

    Returns:
        Residuals `(*B, V, N, 2)`, zero with zero gradient where not valid; and `valid`: seen, and projected.

    Raises:
        TypeError: not a camera, views and a target in this order.
        ValueError: other numbers of poses or corners than the views have.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> error, valid = image_residuals(calibration.cameras, calibration.views, dp.Chessboard())
        >>> torch.equal(error, calibration.residuals)
        True
    """
    camera, points = _posed(camera, views, target)
    return projected_minus_seen(camera, points.to(camera.K), views.pixels.to(camera.K), views.visible)


def plane_residuals(
    camera: Camera | PinholeCamera, views: Views, target: Target
) -> tuple[Float[Tensor, "*batch v n 3"], Bool[Tensor, "*batch v n"]]:
    """Corners put back on the board's plane z = 0, minus where the board has them, in world units.

    Args:
        camera: at the pose of each view, batch shape `(*B, V)`.
        views: corners `(*B, V, N, 2)`.
        target: anything with `.points (N, 3)` on z = 0.

    Returns:
        Residuals `(*B, V, N, 3)`, zero with zero gradient where not valid; and `valid`: seen, and put back.

    Raises:
        TypeError: not a camera, views and a target in this order.
        ValueError: other numbers of poses or corners than the views have, or points that are not on z = 0.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> error, valid = plane_residuals(calibration.cameras, calibration.views, dp.Chessboard())
        >>> bool(valid.all()), bool(error.norm(dim=-1).mean() < 0.2)  # millimetres
        (True, True)
    """
    camera, points = _posed(camera, views, target)
    if has_values(points) and bool((off := points.detach()[:, 2] != 0).any()):
        got = first_of(points, off)
        raise ValueError(f"target: want points on z = 0, got {got}; image_residuals takes them wherever they are")
    return put_back_minus_known(camera, points.to(camera.K), views.pixels.to(camera.K), views.visible)


def projected_minus_seen(
    camera: Camera,
    points: Float[Tensor, "*#batch n 3"],
    pixels: Float[Tensor, "*#batch n 2"],
    counts: Bool[Tensor, "*#batch n"],
) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
    """Reprojection errors `(*B, N, 2)` in pixels, zero with zero gradient where not valid.

    Args:
        camera: at its poses, batch shape `*B`.
        points: world points `(*B, N, 3)`.
        pixels: where they were seen `(*B, N, 2)`, finite.
        counts: which of them count `(*B, N)`.

    Returns:
        The errors, and `valid`: those that count and that the camera projects.
    """
    projected, valid = camera.project(points)
    valid = valid & counts
    return torch.where(valid.unsqueeze(-1), projected - pixels, 0.0), valid


def put_back_minus_known(
    camera: Camera,
    points: Float[Tensor, "*#batch n 3"],
    pixels: Float[Tensor, "*#batch n 2"],
    counts: Bool[Tensor, "*#batch n"],
) -> tuple[Float[Tensor, "*out n 3"], Bool[Tensor, "*out n"]]:
    """Errors on the plane z = 0 `(*B, N, 3)` in world units, zero with zero gradient where not valid.

    Args and returns are those of `projected_minus_seen`, the points on z = 0.
    """
    landed, valid = back_project(pixels, camera, Plane.z(0.0))
    valid = valid & counts
    return torch.where(valid.unsqueeze(-1), landed - points, 0.0), valid


def nearest_minus_known(
    camera: Camera,
    points: Float[Tensor, "*#batch n 3"],
    pixels: Float[Tensor, "*#batch n 2"],
    counts: Bool[Tensor, "*#batch n"],
) -> tuple[Float[Tensor, "*out n 3"], Bool[Tensor, "*out n"]]:
    """How far from a pixel's ray its point lies: the nearest place on the ray, minus the point, in world units.

    For points in space, which no plane holds. Args and returns are those of `projected_minus_seen`.
    """
    origin, direction, valid = camera.rays(pixels)
    offset = points - origin
    along = (offset * direction).sum(-1, keepdim=True)
    valid = valid & counts & (along.squeeze(-1) > 0)
    return torch.where(valid.unsqueeze(-1), along * direction - offset, 0.0), valid


def _posed(camera: Camera | PinholeCamera, views: Views, target: Target) -> tuple[Camera, Tensor]:
    """The camera, and the target's points `(N, 3)`, known to fit the views."""
    camera, views, points = as_camera(camera), as_views(views), points_of(target)
    if camera.batch_shape[-1:] != (len(views),):
        raise ValueError(
            f"camera: want a pose for each of the {len(views)} views, batch shape (*B, {len(views)}), "
            f"got {tuple(camera.batch_shape)}"
        )
    if len(points) != views.pixels.shape[-2]:
        raise ValueError(f"views: want {len(points)} corners in each as the target has, got {views.pixels.shape[-2]}")
    broadcast_batches(camera=camera.batch_shape[:-1], views=views.batch_shape)
    if camera.K.is_meta != views.pixels.is_meta:
        raise ValueError(f"camera, views: want both with values, got devices {camera.device} and {views.device}")
    return camera, points
