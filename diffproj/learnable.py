"""`LearnableCamera`: a camera whose parameters a PyTorch optimiser moves, and the residuals that it moves them by.

The parameters are chosen so that steps of one size mean much the same for each of them, and none can leave its range:

* focal lengths through their logarithm, `f = f_0 exp(log_focal)`;
* the principal point in units of the focal length, `c = c_0 + f_0 principal_point`;
* the lens's coefficients as they are, `k = k_0 + distortion`;
* poses on their manifold, `R = exp(rotation) R_0`, and `t = t_0 + |t_0| translation` (in world units where t_0 is 0).

All are zero at first: the camera that the module was made from. What is not learned is a buffer, saved and moved along.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor, nn

from diffproj.back_projection import back_project
from diffproj.board import Views
from diffproj.camera import Camera, as_camera
from diffproj.intrinsics import check_no_skew, focal_and_center, intrinsic_matrix
from diffproj.lens import BrownConrady, KannalaBrandt
from diffproj.plane import Plane

PARTS = ("focal", "principal_point", "distortion", "pose")
"""What may be learned."""


@runtime_checkable
class HasPoints(Protocol):
    """Anything with world points, such as `Chessboard`."""

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """World points `(N, 3)`."""
        ...


class LearnableCamera(nn.Module):
    """A camera, or a batch of them, as a module: calling it gives a `Camera` that carries gradients.

    Intrinsics and lens of a batch of poses of one camera, as `Calibration.cameras` is, are one parameter.

    Args:
        camera: the start. Its tensors are copied; its dtype and device are the module's.
        learn: which parts are learned, of `"focal"`, `"principal_point"`, `"distortion"` and `"pose"`; all that the
            camera has if left out.
        one_camera: whether the last batch axis counts poses of one camera, with one K and one lens. If left out, they
            do where the camera was only expanded over them, which is how `camera.at(R, t)` and calibrations make it; a
            change of dtype or picking by a list makes copies, and then it has to be said.

    Raises:
        TypeError: no camera, or one with a lens of another library.
        ValueError: an unknown part, `"distortion"` of a pinhole, a K with skew, or `one_camera` of different ones.

    Example:
        >>> import diffproj as dp
        >>> views, board = dp.example_views("left"), dp.Chessboard()
        >>> rough = dp.calibrate(views, board, "brown4")
        >>> learnable = LearnableCamera(rough.cameras, learn=("focal", "pose"))
        >>> optimiser = torch.optim.LBFGS(learnable.parameters(), line_search_fn="strong_wolfe")
        >>> def loss():
        ...     optimiser.zero_grad()
        ...     error, valid = image_residuals(learnable(), views, board)
        ...     cost = error[valid].square().sum()
        ...     cost.backward()
        ...     return cost
        >>> _ = optimiser.step(loss)
        >>> learnable().K.shape
        torch.Size([13, 3, 3])
    """

    def __init__(
        self, camera: Camera | PinholeCamera, learn: Sequence[str] | None = None, one_camera: bool | None = None
    ) -> None:
        super().__init__()
        camera = as_camera(camera).detach()
        lens = camera.distortion
        if lens is not None and not isinstance(lens, BrownConrady | KannalaBrandt):
            raise TypeError(f"camera: want a lens of diffproj, got {type(lens).__name__}")
        check_no_skew(camera.K)
        available = [part for part in PARTS if lens is not None or part != "distortion"]
        learn = tuple(available if learn is None else [learn] if isinstance(learn, str) else learn)
        unknown = [part for part in learn if part not in available]
        if unknown:
            raise ValueError(f"learn: want parts of {', '.join(available)}, got {unknown[0]!r}")
        self.learn, self.size, self.batch_shape = learn, camera.size, camera.batch_shape
        self._lens = None if lens is None else type(lens)
        K = _once(camera.K, 2, one_camera)
        focal, center = focal_and_center(K).split(2, dim=-1)
        self.register_buffer("focal_0", focal.clone())
        self.register_buffer("principal_point_0", center.clone())
        self.register_buffer("R_0", camera.R.clone())
        self.register_buffer("t_0", camera.t.clone())
        reach = camera.t.norm(dim=-1, keepdim=True)
        self.register_buffer("reach", torch.where(reach > 0, reach, 1.0))
        coefficients = (
            focal[..., :0] if lens is None else _once(lens.expand(*self.batch_shape).coefficients, 1, one_camera)
        )
        self.register_buffer("coefficients_0", coefficients.clone())
        self._own("log_focal", focal, "focal")
        self._own("principal_point", center, "principal_point")
        self._own("distortion", coefficients, "distortion")
        self._own("rotation", camera.t, "pose")
        self._own("translation", camera.t, "pose")

    focal_0: Tensor
    principal_point_0: Tensor
    R_0: Tensor
    t_0: Tensor
    reach: Tensor
    coefficients_0: Tensor
    log_focal: Tensor
    principal_point: Tensor
    distortion: Tensor
    rotation: Tensor
    translation: Tensor

    def _own(self, name: str, like: Tensor, part: str) -> None:
        zero = torch.zeros_like(like, memory_format=torch.contiguous_format)
        if part in self.learn:
            self.register_parameter(name, nn.Parameter(zero))
        else:
            self.register_buffer(name, zero)

    def forward(self) -> Camera:
        """The camera as it is now, with the batch shape of the one it was made from."""
        focal = self.focal_0 * self.log_focal.exp()
        center = self.principal_point_0 + self.focal_0 * self.principal_point
        K = intrinsic_matrix(focal, center).expand(*self.batch_shape, 3, 3)
        turn = axis_angle_to_rotation_matrix(self.rotation.reshape(-1, 3)).reshape(self.R_0.shape)
        # Elementwise, as everywhere: under autocast a matrix product would round the pose to 8 bits.
        R = (turn.unsqueeze(-1) * self.R_0.unsqueeze(-3)).sum(-2)
        t = self.t_0 + self.reach * self.translation
        lens = None
        if self._lens is not None:
            lens = self._lens(self.coefficients_0 + self.distortion).expand(*self.batch_shape)
        return Camera._unchecked(K, R, t, lens, self.size)

    def extra_repr(self) -> str:
        """What `print` shows between the brackets."""
        lens = "pinhole" if self._lens is None else self._lens.__name__
        return f"batch_shape={tuple(self.batch_shape)}, {lens}, learn={self.learn}"


def image_residuals(
    camera: Camera | PinholeCamera, views: Views, board: HasPoints
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
    camera: Camera | PinholeCamera, views: Views, board: HasPoints
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


def _points(board: HasPoints, camera: Camera) -> Tensor:
    return board.points.to(camera.K)


def _once(tensor: Tensor, trailing: int, one_camera: bool | None) -> Tensor:
    """The tensor with length 1 along the batch axes over which it is the same camera."""
    batch = tensor.ndim - trailing
    for axis in range(batch):
        last = axis == batch - 1
        expanded = tensor.shape[axis] > 1 and tensor.stride(axis) == 0
        first = tensor.narrow(axis, 0, 1)
        if last and one_camera and not bool((tensor == first).all()):
            raise ValueError("one_camera: want one K and one lens for all poses, got different ones")
        if expanded if one_camera is None or not last else one_camera:
            tensor = first
    return tensor
