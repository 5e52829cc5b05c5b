"""What a camera leaves over of the views of a target: on the image, or on the plane."""

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj.geometry.back_projection import back_project
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.plane import Plane
from diffproj.targets.target import Target
from diffproj.targets.views import Views


def image_residuals(
    camera: Camera | PinholeCamera, views: Views, board: Target
) -> tuple[Float[Tensor, "*batch v n 2"], Bool[Tensor, "*batch v n"]]:
    """Projected minus seen corners in pixels, with gradients to camera, corners and board points.

    Args:
        camera: at the pose of each view, batch shape `(*B, V)`.
        views: corners `(*B, V, N, 2)`.
        board: anything with `.points (N, 3)`.

    Returns:
        Residuals `(*B, V, N, 2)`, zero with zero gradient where not valid; and `valid`: seen, and projected.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> error, valid = image_residuals(calibration.cameras, calibration.views, dp.Chessboard())
        >>> torch.equal(error, calibration.residuals)
        True
    """
    camera = _posed(camera, views)
    projected, valid = camera.project(_points(board, camera))
    valid = valid & views.visible
    return torch.where(valid.unsqueeze(-1), projected - views.pixels.to(projected), 0.0), valid


def plane_residuals(
    camera: Camera | PinholeCamera, views: Views, board: Target
) -> tuple[Float[Tensor, "*batch v n 3"], Bool[Tensor, "*batch v n"]]:
    """Corners put back on the board's plane z = 0, minus where the board has them, in world units.

    Args:
        camera: at the pose of each view, batch shape `(*B, V)`.
        views: corners `(*B, V, N, 2)`.
        board: anything with `.points (N, 3)` on z = 0.

    Returns:
        Residuals `(*B, V, N, 3)`, zero with zero gradient where not valid; and `valid`: seen, and put back.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> error, valid = plane_residuals(calibration.cameras, calibration.views, dp.Chessboard())
        >>> bool(valid.all()), bool(error.norm(dim=-1).mean() < 0.2)  # millimetres
        (True, True)
    """
    camera = _posed(camera, views)
    points, valid = back_project(views.pixels.to(camera.K), camera, Plane.z(0.0))
    valid = valid & views.visible
    return torch.where(valid.unsqueeze(-1), points - _points(board, camera), 0.0), valid


def _posed(camera: Camera | PinholeCamera, views: Views) -> Camera:
    camera = as_camera(camera)
    if camera.batch_shape[-1:] != (len(views),):
        raise ValueError(
            f"camera: want a pose for each of the {len(views)} views, batch shape (*B, {len(views)}), "
            f"got {tuple(camera.batch_shape)}"
        )
    return camera


def _points(board: Target, camera: Camera) -> Tensor:
    return board.points.to(camera.K)
