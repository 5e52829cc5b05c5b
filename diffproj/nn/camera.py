"""`LearnableCamera`: a camera whose parameters a PyTorch optimiser moves.

The parameters are chosen so that steps of one size mean much the same for each of them, and none can leave its range:

* focal lengths through their logarithm, `f = f_0 exp(log_focal)`, which scales the columns of `F` in general;
* the principal point in units of the focal length, `c = c_0 + F_0 principal_point`;
* the coefficients of the lens by addition, `k = k_0 + distortion`;
* rotations by `R = Q(rotation) R_0`, where `Q(w)` turns about the axis w by `2 atan(|w| / 2)` (Cayley's map, which
  agrees with the rotation vector to second order; see `diffproj.geometry.cayley`);
* translations in units of their length, `t = t_0 + |t_0| translation` (in world units where t_0 is 0);
* in the place of both, the angles `pitch` (down), `yaw` (to the right) and `roll` (the horizon sinks to the right)
  about the camera's own x, y and z, in radians, and the `height` along the world's z, in units of the same length. They
  turn and lift the camera where it stands, as does a rotation that is learned without a translation.

All parameters are zero at first, which gives the camera that the module was made from. Parts that are not learned are
buffers, which are saved and moved along.
"""

from typing import TYPE_CHECKING, Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from diffproj._core.arguments import flag
from diffproj._core.numerics import dot, has_values, wants_derivative
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.cayley import turned
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.models import coefficients_of, model_of
from diffproj.nn.partial import (
    OF_POSE,
    PARTS,
    TURNS,
    GeometryModule,
    Learn,
    add_kind,
    add_parameter,
    check_swapped_kind,
    learned,
    learned_parts,
    same_values,
)

_PARAMETERS = {
    "log_focal": ("focal",),
    "principal_point": ("principal_point",),
    "distortion": ("distortion",),
    "rotation": ("pose", "rotation"),
    "translation": ("pose", "translation"),
}
"""From each parameter to the parts that it belongs to."""


class LearnableCamera(GeometryModule):
    """A camera, or a batch of cameras, as a module: calling it gives a `Camera` that carries gradients.

    The poses of one camera, such as `Calibration.cameras`, share one K and one lens: these are one parameter, and stay
    one however long they are trained. Such intrinsics are tied. Whether they are is decided once, in construction, by
    the values that the camera starts with, and not by how its tensors lie in memory.

    Args:
        camera: the starting camera, of batch shape `*B`, or Kornia's `PinholeCamera`. Its tensors are copied; its dtype
            and device are the module's.
        learn: the parts to learn, of `"focal"`, `"principal_point"`, `"distortion"` and `"pose"`; all that the camera
            has if left out. In the place of the pose, parts of it: `"rotation"`, `"translation"`, `"pitch"`, `"yaw"`,
            `"roll"` and `"height"`. A mapping also says for which cameras of the batch: from the part to True, False,
            or booleans that broadcast to the batch shape.
        tied_intrinsics: whether the cameras along a batch axis share one K and one lens. If left out, they do along
            every axis along which all start with the same values of both. True does the same and refuses cameras that
            differ along the last axis; False gives each camera its own K and lens, also where they start alike.

    Raises:
        TypeError: not a camera, or one whose lens is of another package.
        ValueError: an unknown part; `"distortion"` of a pinhole; booleans that do not broadcast to the batch shape, or
            that differ between cameras with tied intrinsics; or `tied_intrinsics=True` for cameras that differ.

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
        self._kept: CoefficientLens | None = None
        camera = as_camera(camera).detach()
        check_tied(tied_intrinsics)
        self._model = model_of(camera.distortion)
        available = [part for part in PARTS if self._model.count or part != "distortion"]
        chosen = learned_parts(available if learn is None else learn, (*available, *OF_POSE))
        self.learn, self.size, self.batch_shape = tuple(chosen), camera.size, camera.batch_shape
        axes = tied_axes(camera, tied_intrinsics)
        K, coefficients = (_first_along(axes, part) for part in _intrinsics(camera))
        focal = K[..., 0, :2]
        self.register_buffer("K_0", K.clone())
        self.register_buffer("R_0", camera.R.clone())
        self.register_buffer("t_0", camera.t.clone())
        reach = camera.t.norm(dim=-1, keepdim=True)
        self.register_buffer("reach", torch.where(reach > 0, reach, 1.0))
        self.register_buffer("coefficients_0", coefficients.clone())
        add_kind(self, camera)
        likes = {"log_focal": focal, "principal_point": focal, "distortion": coefficients}
        for name, parts in _PARAMETERS.items():
            where = next((chosen[part] for part in parts if part in chosen), False)
            add_parameter(self, name, likes.get(name, camera.t), where, self.batch_shape)
        for name in (*TURNS, "height"):
            if name in chosen:
                add_parameter(self, name, camera.t[..., :1], chosen[name], self.batch_shape)
        # By its parts the camera is turned where it stands; in a pose R and t are free of each other.
        within = chosen.keys() & {*OF_POSE}
        self._stays = bool(within) and within != {"rotation", "translation"}
        self.register_load_state_dict_pre_hook(_explain_other_tying)

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
        """The camera with the current values of the parameters, of the batch shape of the starting camera."""
        check_swapped_kind(self)
        scale = nn.functional.pad(learned(self, "log_focal").exp(), (0, 1), value=1.0)
        shift = (self.K_0[..., :2] * learned(self, "principal_point").unsqueeze(-2)).sum(-1, keepdim=True)
        K = self.K_0 * scale.unsqueeze(-2) + nn.functional.pad(shift, (2, 0))
        K = K.expand(*self.batch_shape, 3, 3)
        R = turned(self.R_0, learned(self, "rotation"))
        if chosen := [name for name in TURNS if name in self.learn]:
            none = torch.zeros_like(self.t_0[..., :1])
            pitch, yaw, roll = (learned(self, name) if name in chosen else none for name in TURNS)
            R = turned(R, torch.cat([pitch, -yaw, roll], dim=-1))
        t = self.t_0 + self.reach * learned(self, "translation")
        if self._stays:
            center = -dot(self.R_0.mT, self.t_0.unsqueeze(-2))
            t = t + dot(self.R_0 - R, center.unsqueeze(-2))
            if "height" in self.learn:
                t = t - R[..., 2] * self.reach * learned(self, "height")
        return Camera.unchecked(K, R, t, self._lens(), self.size)

    if TYPE_CHECKING:  # PyTorch types the call of a module as Any
        __call__ = forward

    def _lens(self) -> CoefficientLens | None:
        """The lens; where no gradient reaches its coefficients, the same one for as long as their values stay."""
        kind = self._model.kind
        if kind is None:
            return None
        coefficients = self.coefficients_0 + learned(self, "distortion")
        if wants_derivative(coefficients) or not has_values(coefficients):
            return kind.unchecked(coefficients).expand(*self.batch_shape)
        kept = self._kept
        if kept is None or not same_values(coefficients, kept.coefficients):
            with torch.inference_mode(False):
                kept = self._kept = kind.unchecked(coefficients.detach().clone())
        return kept.expand(*self.batch_shape)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_kept": None}

    def extra_repr(self) -> str:
        """What `print` shows between the brackets."""
        return f"batch_shape={tuple(self.batch_shape)}, lens={self._model.name}, learn={self.learn}"


def check_tied(tied: bool | None) -> None:
    """Check the argument `tied_intrinsics`.

    Raises:
        TypeError: it is neither True nor False nor `None`.
    """
    if tied is not None:
        flag("tied_intrinsics", tied)


def tied_axes(camera: Camera, tied: bool | None) -> list[int]:
    """The batch axes along which the cameras share one K and one lens; see `tied_intrinsics` of `LearnableCamera`.

    Raises:
        TypeError: the lens is of another package.
        ValueError: `tied` is true, and the cameras differ along the last axis.
    """
    parts = _intrinsics(camera)
    if tied is False:
        return []
    batch = camera.batch_shape
    axes = [axis for axis in range(len(batch)) if batch[axis] and all(_is_constant(part, axis) for part in parts)]
    if tied and batch and batch[-1] and len(batch) - 1 not in axes:
        raise ValueError("tied_intrinsics: want one K and one lens for all poses, got different ones")
    return axes


def _intrinsics(camera: Camera) -> tuple[Tensor, Tensor]:
    """K `(*B, 3, 3)` and the coefficients of the lens `(*B, k)`, none for a pinhole."""
    return camera.K, coefficients_of(camera.distortion, camera.t).expand(*camera.batch_shape, -1)


def _is_constant(tensor: Tensor, axis: int) -> bool:
    """Whether all values along an axis are the same; without values, whether they are one value in memory."""
    if not has_values(tensor):
        return tensor.stride(axis) == 0
    return bool((tensor == tensor.narrow(axis, 0, 1)).all())


def _first_along(axes: list[int], tensor: Tensor) -> Tensor:
    """The tensor with length 1 along these axes."""
    for axis in axes:
        tensor = tensor.narrow(axis, 0, 1)
    return tensor


def _explain_other_tying(learnable: LearnableCamera, state: dict[str, Any], prefix: str, *rest: Any) -> None:
    """Called before `load_state_dict`: name the cause where intrinsics are tied in one of the two and not in the other.

    PyTorch then adds its own lines about the shapes that differ, and raises.
    """
    errors: list[str] = rest[-1]
    K, t = state.get(f"{prefix}K_0"), state.get(f"{prefix}t_0")
    if K is None or t is None or t.shape != learnable.t_0.shape or K.shape == learnable.K_0.shape:
        return
    errors.append(
        f"{prefix}K_0: want K of shape {tuple(learnable.K_0.shape)}, got {tuple(K.shape)} for the same "
        "batch of cameras: intrinsics are tied in one of the two modules and not in the other; build this one with "
        "tied_intrinsics as the saved one was, or from cameras that start alike where those of the saved one did"
    )
