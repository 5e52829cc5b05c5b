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

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from diffproj.back_projection import back_project
from diffproj.board import Views
from diffproj.camera import Camera, as_camera
from diffproj.lens import BrownConrady, KannalaBrandt
from diffproj.plane import Plane

PARTS = ("focal", "principal_point", "distortion", "pose")
"""What may be learned."""
_PARAMETERS = {
    "focal": ("log_focal",),
    "principal_point": ("principal_point",),
    "distortion": ("distortion",),
    "pose": ("rotation", "translation"),
}
Learn = Sequence[str] | Mapping[str, Any]
"""Parts to learn, or for each part the cameras whose it is, as booleans that broadcast to the batch shape."""


@runtime_checkable
class HasPoints(Protocol):
    """Anything with world points, such as `Chessboard`."""

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """World points `(N, 3)`."""
        ...


class GeometryModule(nn.Module):
    """A module of geometry: `network.half()` and `.bfloat16()` pass it by, moves and other dtypes do not.

    Attributes:
        partly: names of the parameters that are not learned everywhere; see `own`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.partly: set[str] = set()

    def _apply(self, fn, recurse: bool = True):  # type: ignore[override]
        def lifting(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            return tensor.to(moved.device) if moved.dtype in (torch.float16, torch.bfloat16) else moved

        return super()._apply(lifting, recurse)


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
        ...     error, valid = image_residuals(learnable(), views, board)
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
        if lens is not None and not isinstance(lens, BrownConrady | KannalaBrandt):
            raise TypeError(f"camera: want a lens of diffproj, got {type(lens).__name__}")
        available = [part for part in PARTS if lens is not None or part != "distortion"]
        chosen = learned_parts(available if learn is None else learn, available)
        self.learn, self.size, self.batch_shape = tuple(chosen), camera.size, camera.batch_shape
        self._lens = None if lens is None else type(lens)
        coefficients = camera.K[..., 0, :0] if lens is None else lens.expand(*self.batch_shape).coefficients
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
        # Crosswise and elementwise: under autocast a matrix product would round the pose to 8 bits.
        half = learned(self, "rotation").unsqueeze(-1) / 2
        across = torch.linalg.cross(half, self.R_0, dim=-2)
        across = across + torch.linalg.cross(half, across, dim=-2)
        R = self.R_0 + across * (2 / (1 + half.square().sum(-2, keepdim=True)))
        t = self.t_0 + self.reach * learned(self, "translation")
        lens = None
        if self._lens is not None:
            lens = self._lens(self.coefficients_0 + learned(self, "distortion")).expand(*self.batch_shape)
        return Camera._unchecked(K, R, t, lens, self.size)

    def extra_repr(self) -> str:
        """What `print` shows between the brackets."""
        lens = "pinhole" if self._lens is None else self._lens.__name__
        return f"batch_shape={tuple(self.batch_shape)}, {lens}, learn={self.learn}"


def learned_parts(learn: Learn, available: Sequence[str]) -> dict[str, Any]:
    """From part to whether, or for which cameras, it is learned; parts that are learned nowhere are left out.

    Raises:
        ValueError: a part that is not available.
    """
    names = (learn,) if isinstance(learn, str) else tuple(learn)
    unknown = [part for part in names if part not in available]
    if unknown:
        raise ValueError(f"learn: want parts of {', '.join(available)}, got {unknown[0]!r}")
    wanted = {part: learn[part] for part in names} if isinstance(learn, Mapping) else dict.fromkeys(names, True)
    return {part: where for part, where in wanted.items() if bool(torch.as_tensor(where).any())}


def own(module: GeometryModule, name: str, like: Tensor, where: Any, batch: torch.Size) -> None:
    """Give a module zeros `(*B, k)` of a name: a parameter if it is learned, with a mask if not everywhere.

    Args:
        module: whose they are.
        name: of the parameter or buffer; that of the mask is `NAME_learned`.
        like: of the shape, dtype and device that it has; an axis of the batch along which it is one has length 1.
        where: whether it is learned, or for which of the batch.
        batch: the batch shape.

    Raises:
        ValueError: `where` does not broadcast to the batch, or differs along an axis along which this is one.
    """
    zero = torch.zeros_like(like, memory_format=torch.contiguous_format)
    mask = torch.as_tensor(where, device=like.device)
    try:
        mask = mask.bool().expand(batch)
    except RuntimeError:
        raise ValueError(
            f"learn: want booleans that broadcast to the batch shape {tuple(batch)}, got shape {tuple(mask.shape)}"
        ) from None
    if not bool(mask.any()):
        module.register_buffer(name, zero)
        return
    module.register_parameter(name, nn.Parameter(zero))
    if bool(mask.all()):
        return
    for axis, length in enumerate(like.shape[:-1]):
        if length < mask.shape[axis]:
            first = mask.narrow(axis, 0, 1)
            if not bool((mask == first).all()):
                raise ValueError(f"learn: want the same for all poses of one camera, got {mask.tolist()} for {name}")
            mask = first
    module.partly.add(name)
    module.register_buffer(f"{name}_learned", mask.unsqueeze(-1).to(like.dtype))


def learned(module: GeometryModule, name: str) -> Tensor:
    """What `own` made, zero where it is not learned."""
    value: Tensor = getattr(module, name)
    return value * getattr(module, f"{name}_learned") if name in module.partly else value


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
