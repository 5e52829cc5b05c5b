"""Calibration: camera parameters and poses from the corners of a board seen in photographs.

`calibrate` finds intrinsics, lens and one pose a view (Zhang 2000); `locate` finds poses alone, with the intrinsics
held. Both minimise the reprojection error in pixels with OpenCV's solvers and return a `Calibration`, whose residuals
are computed by this package's own projection, so that they cross-check the solver.
"""

from dataclasses import dataclass
from typing import Literal, Protocol, get_args, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from diffproj.board import Views
from diffproj.camera import Camera
from diffproj.lens import BrownConrady

LensModel = Literal["none", "brown4", "brown5"]
"""Which lens `calibrate` fits: none, or Brown-Conrady with `k1 k2 p1 p2 [k3]`."""

_HELD: dict[LensModel, int] = {
    "none": cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3,
    "brown4": cv2.CALIB_FIX_K3,
    "brown5": 0,
}
_COEFFICIENTS: dict[LensModel, int] = {"none": 0, "brown4": 4, "brown5": 5}
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)

WORST_DEVIATION = 0.1
"""Standard deviation of a focal length or principal point, relative to the focal length, beyond which the views are
said not to determine it."""


class CalibrationError(RuntimeError):
    """The corners do not determine the camera, or the solver failed; the message says which."""


@runtime_checkable
class PlanarTarget(Protocol):
    """What is calibrated against: anything with points, such as `Chessboard`."""

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """World points `(N, 3)` on the plane z = 0, in the order of the views' corners."""
        ...


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera with the poses of the views that it was found from, and those views.

    Attributes:
        camera: intrinsics and lens with the world frame in the camera: what one saves.
        cameras: the same camera at the pose of each view, batch shape `(V,)`: `X_cam = R X_board + t`.
        views: the corners that were fitted.
        points: the board's corners `(N, 3)` in world units.
    """

    camera: Camera
    cameras: Camera
    views: Views
    points: Float[Tensor, "n 3"]

    @property
    def residuals(self) -> Float[Tensor, "v n 2"]:
        """Projected minus seen corners `(V, N, 2)` in pixels; zero where a corner was not seen."""
        projected, valid = self.cameras.project(self.points)
        seen = (self.views.visible & valid).unsqueeze(-1)
        return torch.where(seen, projected - self.views.pixels, 0.0)

    @property
    def view_rms(self) -> Float[Tensor, " v"]:
        """RMS reprojection error of each view `(V,)` in pixels."""
        return (self.residuals.square().sum(dim=(-2, -1)) / self.views.visible.sum(dim=-1)).sqrt()

    @property
    def rms(self) -> float:
        """RMS reprojection error in pixels as OpenCV defines it: `sqrt(sum |e|^2 / number of points)`."""
        return float((self.residuals.square().sum() / self.views.visible.sum()).sqrt())

    def summary(self) -> str:
        """The calibration as a text for people: intrinsics, lens, and the RMS of each view."""
        K = self.camera.K
        lines = [
            f"focal lengths    {K[0, 0]:10.3f} {K[1, 1]:10.3f} px",
            f"principal point  {K[0, 2]:10.3f} {K[1, 2]:10.3f} px",
        ]
        if isinstance(self.camera.distortion, BrownConrady):
            names = ["k1", "k2", "p1", "p2", "k3"]
            coefficients = self.camera.distortion.coefficients.tolist()
            lines.append(
                "lens             " + "  ".join(f"{n} {c:.5f}" for n, c in zip(names, coefficients, strict=False))
            )
        lines.append(f"RMS              {self.rms:10.4f} px over {int(self.views.visible.sum())} corners")
        width = max(map(len, self.views.names))
        per_view = zip(self.views.names, self.view_rms.tolist(), strict=True)
        lines += [f"  {name:<{width}}  {rms:.4f} px" for name, rms in per_view]
        return "\n".join(lines)


def calibrate(views: Views, board: PlanarTarget, distortion: LensModel = "brown5") -> Calibration:
    """Find intrinsics, lens and one pose a view that minimise the reprojection error in pixels.

    Args:
        views: corners `(V, N, 2)` seen in V >= 2 photographs of known size, at least 4 in each.
        board: anything with `.points (N, 3)` on z = 0, such as `Chessboard`; its unit is the world's.
        distortion: which lens to fit.

    Returns:
        The calibration, in float64.

    Raises:
        ValueError: views and board do not fit together, or there is too little to start from.
        CalibrationError: the views do not determine the camera, for example because all are parallel.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> round(calibration.rms, 2), [round(f) for f in calibration.camera.K.diagonal()[:2].tolist()]
        (0.18, [533, 533])
    """
    if distortion not in get_args(LensModel):
        raise ValueError(f"distortion: want one of {', '.join(get_args(LensModel))}, got {distortion!r}")
    points = _checked_points(views, board)
    if len(views) < 2:
        raise ValueError(f"views: want at least 2 to find the intrinsics, got {len(views)}")
    if views.size is None:
        raise ValueError("views: want the photographs' size, got None; give Views(..., size=(width, height))")
    # OpenCV takes points in float32 alone; a board's points are exact there, pixels to 3e-5.
    object_points = [points[seen].numpy().astype(np.float32) for seen in views.visible.cpu()]
    image_points = [
        pixels[seen].detach().numpy().astype(np.float32)
        for pixels, seen in zip(views.pixels.cpu(), views.visible.cpu(), strict=True)
    ]
    try:
        _, K, dist, rvecs, tvecs = cv2.calibrateCamera(
            object_points, image_points, views.size, None, None, flags=_HELD[distortion], criteria=_STOP
        )
    except cv2.error as error:
        raise CalibrationError(f"calibrate: the solver failed on these views ({error.err})") from error
    coefficients = dist.ravel()[: _COEFFICIENTS[distortion]]
    try:
        cameras = Camera.from_opencv(K, coefficients, np.array(rvecs), np.array(tvecs), views.size)
        calibration = Calibration(cameras[0].without_pose(), cameras, views.to(torch.float64), points)
        if float(_deviations(calibration).amax() / calibration.camera.K[0, 0]) < WORST_DEVIATION:
            return calibration
    except ValueError:  # the solver ended at numbers that are no camera
        pass
    raise CalibrationError(
        "calibrate: these views do not determine focal length and principal point; "
        "add photographs with the board tilted by 20 to 50 degrees about both axes"
    )


def locate(views: Views, board: PlanarTarget, camera: Camera) -> Calibration:
    """Find the pose of each view with intrinsics and lens held, from at least 4 corners a view.

    A plane seen from afar has two poses that explain it almost equally well; both are refined and the better kept.

    Args:
        views: corners `(V, N, 2)`.
        board: anything with `.points (N, 3)` on z = 0.
        camera: a single camera, pinhole or with a `BrownConrady` lens; its own pose does not matter.

    Returns:
        A calibration with the given intrinsics and the poses found, in float64.

    Raises:
        TypeError: the camera has another lens.
        ValueError: views, board and camera do not fit together, or too few corners.
        CalibrationError: no pose explains a view.

    Example:
        >>> import diffproj as dp
        >>> views, board = dp.example_views("left"), dp.Chessboard()
        >>> camera = dp.calibrate(views[:8], board).camera
        >>> round(dp.locate(views[8:], board, camera).rms, 2)
        0.18
    """
    points = _checked_points(views, board)
    if camera.batch_shape:
        raise ValueError(f"camera: want a single camera, got batch shape {tuple(camera.batch_shape)}; index it")
    if camera.distortion is not None and not isinstance(camera.distortion, BrownConrady):
        raise TypeError(f"camera: want a pinhole or a BrownConrady lens, got {type(camera.distortion).__name__}")
    camera = camera.detach().to("cpu", torch.float64).without_pose()
    poses = [
        _pose(points[seen], pixels[seen].detach().double(), camera, name)
        for pixels, seen, name in zip(views.pixels.cpu(), views.visible.cpu(), views.names, strict=True)
    ]
    R, t = (torch.from_numpy(np.stack(parts)) for parts in zip(*poses, strict=True))
    return Calibration(camera, camera.at(R, t), views.to(torch.float64), points)


def _deviations(calibration: Calibration) -> Float[Tensor, "4"]:
    """Standard deviations of f_x, f_y, c_x, c_y in pixels, infinite where the views do not determine them.

    From the Gauss-Newton normal equations at the residuals' own level, with lens and poses free: with A the Jacobian
    of a view's pixels to the shared parameters and B that to its pose, the poses drop out of the equations by

        S = sum over views of A^T A - A^T B (B^T B)^-1 B^T A,    covariance = sigma^2 S^-1.
    """
    cameras, views = calibration.cameras, calibration.views
    lens = cameras.distortion
    coefficients = lens.coefficients if isinstance(lens, BrownConrady) else cameras.t[:, :0]
    F, c = cameras.K.diagonal(dim1=-2, dim2=-1)[:, :2], cameras.K[:, :2, 2]
    shared = torch.cat([F, c, coefficients], dim=-1)
    count = shared.shape[-1]

    def project(parameters: Tensor, R: Tensor, t: Tensor) -> Tensor:
        (f_x, f_y, c_x, c_y), turn, shift = parameters[:4].unbind(), parameters[count : count + 3], parameters[-3:]
        zero, one = torch.zeros_like(f_x), torch.ones_like(f_x)
        K = torch.stack([f_x, zero, c_x, zero, f_y, c_y, zero, zero, one]).reshape(3, 3)
        lens = BrownConrady(parameters[4:count]) if count > 4 else None
        return Camera(K, axis_angle_to_rotation_matrix(turn) @ R, t + shift, lens).project(calibration.points)[0]

    parameters = torch.nn.functional.pad(shared, (0, 6))
    J = torch.func.vmap(torch.func.jacfwd(project))(parameters, cameras.R, cameras.t) * views.visible[..., None, None]
    A, B = J.flatten(1, 2).split([count, 6], dim=-1)
    S = (A.mT @ A - A.mT @ B @ torch.linalg.solve(B.mT @ B, B.mT @ A)).sum(dim=0)
    # The parameters' units differ by orders of magnitude; what is singular shows after scaling.
    scale = S.diagonal().clamp(min=torch.finfo(S.dtype).tiny).rsqrt()
    values, vectors = torch.linalg.eigh(scale[:, None] * S * scale)
    if float(values[0]) <= 1e-12:
        return torch.full((4,), torch.inf, dtype=S.dtype)
    variance = calibration.rms**2 / 2 * (vectors.square() / values).sum(dim=-1) * scale.square()
    return variance[:4].sqrt()


def _pose(
    points: Float[Tensor, "n 3"], pixels: Float[Tensor, "n 2"], camera: Camera, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """The pose `(R, t)` of one view: the start on undistorted points, the refinement in pixels."""
    direction, valid = camera.directions(pixels)
    usable: Bool[Tensor, " n"] = valid
    object_points, image_points = points[usable].numpy(), direction[usable, :2].numpy()
    K, dist, _, _ = camera.to_opencv()
    best = None
    try:
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(object_points, image_points, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        for rvec, tvec in zip(rvecs, tvecs, strict=True):
            rvec, tvec = cv2.solvePnPRefineLM(points.numpy(), pixels.numpy(), K, dist, rvec, tvec, _STOP)
            projected, _ = cv2.projectPoints(points.numpy(), rvec, tvec, K, dist)
            error = float(np.square(projected.reshape(-1, 2) - pixels.numpy()).sum())
            if np.isfinite(error) and (best is None or error < best[0]):
                best = (error, cv2.Rodrigues(rvec)[0], tvec.ravel())
    except cv2.error as error:
        raise CalibrationError(f"locate: no pose found for {name!r} ({error.err})") from error
    if best is None:
        raise CalibrationError(f"locate: no pose explains {name!r}; are its corners in the board's order?")
    return best[1], best[2]


def _checked_points(views: Views, board: PlanarTarget) -> Float[Tensor, "n 3"]:
    """The board's points in float64, after checking that views and board fit together."""
    if not isinstance(views, Views):
        raise TypeError(f"views: want dp.Views, got {type(views).__name__}; dp.Views(pixels, size=...) makes them")
    if views.batch_shape:
        raise ValueError(f"views: want those of one camera, (V, N, 2), got batch shape {tuple(views.batch_shape)}")
    if len(views) == 0:
        raise ValueError("views: want at least one, got none")
    points = board.points.detach().to("cpu", torch.float64)
    if points.shape != (views.pixels.shape[-2], 3):
        raise ValueError(
            f"views: want {points.shape[0]} corners in each as the board has, got {views.pixels.shape[-2]}; "
            "do columns and rows of the board fit?"
        )
    if bool((points[:, 2] != 0).any()):
        raise ValueError("board: want all points on z = 0")
    few = [name for name, count in zip(views.names, views.visible.sum(dim=-1).tolist(), strict=True) if count < 4]
    if few:
        raise ValueError(
            f"views: want at least 4 visible corners in each, got fewer in {', '.join(few)}; leave them out"
        )
    return points
