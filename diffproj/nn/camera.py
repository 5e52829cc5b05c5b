"""`LearnableCamera`: a camera whose parameters a PyTorch optimiser moves, and the residuals that it moves them by.

The parameters are chosen so that steps of one size mean much the same for each of them, and none can leave its range:

* focal lengths through their logarithm, `f = f_0 exp(log_focal)`, which scales the columns of `F` in general;
* the principal point in units of the focal length, `c = c_0 + F_0 principal_point`;
* the lens's coefficients as they are, `k = k_0 + distortion`;
* poses on their manifold, `R = Q(rotation) R_0`, and `t = t_0 + |t_0| translation` (in world units where t_0 is 0).

`Q(w)` turns about the axis w by `2 atan(|w| / 2)`: Cayley's map, which agrees with the rotation vector to second order
and is rational, so that it costs little and all its derivatives are exact at 0.

All are zero at first: the camera that the module was made from. What is not learned is a buffer, saved and moved along.
"""

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.cayley import turned
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.models import coefficients_of
from diffproj.nn.partial import PARTS, GeometryModule, Learn, learned, learned_parts, own

_PARAMETERS = {
    "focal": ("log_focal",),
    "principal_point": ("principal_point",),
    "distortion": ("distortion",),
    "pose": ("rotation", "translation"),
}


class LearnableCamera(GeometryModule):
    """A camera, or a batch of them, as a module: calling it gives a `Camera` that carries gradients.

    Intrinsics and lens of a batch of poses of one camera, as `Calibration.cameras` is, are one parameter.

    Args:
        camera: the start. Its tensors are copied; its dtype and device are the module's.
        learn: which parts are learned, of `"focal"`, `"principal_point"`, `"distortion"` and `"pose"`; all that the
            camera has if left out. A mapping says it for each camera of a batch: from a part to booleans that
            broadcast to the batch shape.
        tied_intrinsics: whether the cameras along a batch axis are one camera at several poses, with one K and one lens
            to learn. If left out, they are where all start with the same values. True demands it of the last axis;
            with False each camera learns its own, however they start.

    Raises:
        TypeError: no camera, or one with a lens of another library.
        ValueError: an unknown part, `"distortion"` of a pinhole, booleans that do not fit or that part what is one
            parameter, or `tied_intrinsics` of different ones.

    Example:
        >>> import diffproj as dp
        >>> views, board = dp.example_views("left"), dp.Chessboard()
        >>> rough = dp.calibrate(views, board, "brown4")
        >>> learnable = LearnableCamera(rough.cameras, learn=("focal", "pose"))
        >>> optimiser = torch.optim.LBFGS(learnable.parameters(), line_search_fn="strong_wolfe")
        >>> def loss():
        ...     optimiser.zero_grad()
        ...     error, valid = dp.image_residuals(learnable(), views, board)
        ...     cost = error[valid].square().sum()
        ...     cost.backward()
        ...     return cost
        >>> _ = optimiser.step(loss)
        >>> learnable().K.shape
        torch.Size([13, 3, 3])
    """

    def __init__(
        self, camera: Camera | PinholeCamera, learn: Learn | None = None, tied_intrinsics: bool | None = None
    ) -> None:
        super().__init__()
        camera = as_camera(camera).detach()
        lens = camera.distortion
        if lens is not None and not isinstance(lens, CoefficientLens):
            raise TypeError(f"camera: want a lens of diffproj, got {type(lens).__name__}")
        available = [part for part in PARTS if lens is not None or part != "distortion"]
        chosen = learned_parts(available if learn is None else learn, available)
        self.learn, self.size, self.batch_shape = tuple(chosen), camera.size, camera.batch_shape
        self._lens = None if lens is None else type(lens)
        coefficients = coefficients_of(lens, camera.t).expand(*self.batch_shape, -1)
        tied = _tied_axes(camera.K, coefficients, tied_intrinsics)
        K, coefficients = (_first_along(tied, part) for part in (camera.K, coefficients))
        focal = K[..., 0, :2]
        self.register_buffer("K_0", K.clone())
        self.register_buffer("R_0", camera.R.clone())
        self.register_buffer("t_0", camera.t.clone())
        reach = camera.t.norm(dim=-1, keepdim=True)
        self.register_buffer("reach", torch.where(reach > 0, reach, 1.0))
        self.register_buffer("coefficients_0", coefficients.clone())
        likes = {"focal": focal, "principal_point": focal, "distortion": coefficients, "pose": camera.t}
        for part, names in _PARAMETERS.items():
            for name in names:
                own(self, name, likes[part], chosen.get(part, False), self.batch_shape)

    K_0: Tensor
    R_0: Tensor
    t_0: Tensor
    reach: Tensor
    coefficients_0: Tensor
    log_focal: Tensor
    principal_point: Tensor
    distortion: Tensor
    rotation: Tensor
    translation: Tensor

    def forward(self) -> Camera:
        """The camera as it is now, with the batch shape of the one it was made from."""
        scale = nn.functional.pad(learned(self, "log_focal").exp(), (0, 1), value=1.0)
        shift = (self.K_0[..., :2] * learned(self, "principal_point").unsqueeze(-2)).sum(-1, keepdim=True)
        K = self.K_0 * scale.unsqueeze(-2) + nn.functional.pad(shift, (2, 0))
        K = K.expand(*self.batch_shape, 3, 3)
        R = turned(self.R_0, learned(self, "rotation"))
        t = self.t_0 + self.reach * learned(self, "translation")
        lens = None
        if self._lens is not None:
            lens = self._lens(self.coefficients_0 + learned(self, "distortion")).expand(*self.batch_shape)
        return Camera.unchecked(K, R, t, lens, self.size)

    def extra_repr(self) -> str:
        """What `print` shows between the brackets."""
        lens = "pinhole" if self._lens is None else self._lens.__name__
        return f"batch_shape={tuple(self.batch_shape)}, {lens}, learn={self.learn}"


def _tied_axes(K: Tensor, coefficients: Tensor, tied: bool | None) -> list[int]:
    """The batch axes along which K `(*B, 3, 3)` and lens `(*B, k)` are those of one camera."""
    if tied is False:
        return []
    batch = K.ndim - 2
    axes = [axis for axis in range(batch) if all(_alike_along(axis, part) for part in (K, coefficients))]
    if tied and batch and batch - 1 not in axes:
        raise ValueError("tied_intrinsics: want one K and one lens for all poses, got different ones")
    return axes


def _alike_along(axis: int, tensor: Tensor) -> bool:
    return bool((tensor == tensor.narrow(axis, 0, 1)).all())


def _first_along(axes: list[int], tensor: Tensor) -> Tensor:
    """The tensor with length 1 along these axes."""
    for axis in axes:
        tensor = tensor.narrow(axis, 0, 1)
    return tensor
