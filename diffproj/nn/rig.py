"""`LearnableRig`: cameras that stand still to each other, whose parameters a PyTorch optimiser moves.

Each camera is a `LearnableCamera`, with a K and a lens of its own and one pose: its place in the rig. Where the rig
itself moves, it has a pose at each of its moments, which all cameras share:

    X_rig = R_m X_world + t_m        X_cam = R_c X_rig + t_c

The first camera's place is the rig's frame and not learned, for otherwise rig and moments could drift together.
"""

import json
from collections.abc import Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from diffproj._core.arguments import Array, called, choice
from diffproj._core.numerics import check_tensor, dot, has_values
from diffproj.calibration.rigs.options import owner_among
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.cayley import turned
from diffproj.geometry.rotations import check_pose
from diffproj.nn.camera import LearnableCamera
from diffproj.nn.partial import OF_POSE, PARTS, GeometryModule, Learn, add_parameter, asked_parts, learned
from diffproj.nn.whole_numbers import digits_of, numbers_of

MOMENTS = "moments"
"""Among the parts to learn: the poses of the rig itself."""


class LearnableRig(GeometryModule):
    """The cameras of a rig as a module: calling it gives a `Camera` for each name, with gradients.

    Args:
        rig: the cameras to start from at their places, by name: a calibrated rig, or a mapping from names to single
            cameras of one dtype on one device. Lenses and sizes may differ.
        learn: the parts to learn: of all cameras, any of `"focal"`, `"principal_point"`, `"distortion"` and `"pose"`,
            the place in the rig, or parts of it as for `LearnableCamera`; of one camera, such as `"left.focal"` or
            `"right.pose"`; and `"moments"`, the rig's own poses. The first camera's place is learned only where it is
            named. Everything if left out. A mapping says True or False for each; for `"moments"` also which of them, as
            booleans that broadcast to their batch shape.
        moments: where the rig itself stands, `X_rig = R X_world + t`: `(R, t)` of shapes `(*B, 3, 3)` and `(*B, 3)`,
            such as `(calibrated.R_target, calibrated.t_target)`. Left out, the rig's frame is the world.

    Attributes:
        names: of the cameras, in their order.
        members: a `LearnableCamera` each, which `rig["left"]` gives by name, for example for a learning rate of its
            own.
        moments: the module of the rig's own poses, or `None`.

    Raises:
        TypeError: no rig, no cameras, different dtypes, or a lens of another package.
        ValueError: none, a batch of cameras, different devices, an unknown part, or moments that are no poses.

    Example:
        >>> import diffproj as dp
        >>> pair = {"left": dp.example_views("left"), "right": dp.example_views("right")}
        >>> rig = LearnableRig(dp.calibrate_rig(pair, dp.Chessboard()), learn=("focal", "pose"))
        >>> sorted(name for name, _ in rig.named_parameters())[:3]
        ['members.0.log_focal', 'members.1.log_focal', 'members.1.rotation']
        >>> cameras = rig()
        >>> points, valid = dp.back_project(pair["left"].pixels[0], cameras["left"], dp.Plane.z(400.0))
        >>> points.sum().backward()
        >>> rig["left"].log_focal.grad.shape
        torch.Size([2])
    """

    spelled: Tensor

    def __init__(
        self,
        rig: RigCalibration | Mapping[str, Camera | PinholeCamera],
        learn: Learn | None = None,
        moments: tuple[Tensor | Array, Tensor | Array] | None = None,
    ) -> None:
        super().__init__()
        cameras = _checked(rig)
        first = next(iter(cameras.values()))
        parts, of_moments = _chosen(learn, cameras, moments is not None)
        self.names = tuple(cameras)
        self.members = nn.ModuleList(LearnableCamera(camera, parts[name]) for name, camera in cameras.items())
        self.moments = None if moments is None else RigPoses(*_poses(moments, first), of_moments)
        text = list(json.dumps(self.names).encode())
        self.register_buffer("spelled", digits_of(text, first.device, bits=8))
        self.register_load_state_dict_pre_hook(partial(_check_names, self.names))

    def __getitem__(self, name: str) -> LearnableCamera:
        """The module of one camera.

        Raises:
            TypeError: the name is no string.
            ValueError: there is no such camera.
        """
        number = self.names.index(choice("name", name, self.names))
        return cast(LearnableCamera, self.members[number])

    def __len__(self) -> int:
        """The number of cameras."""
        return len(self.names)

    def __iter__(self) -> Iterator[str]:
        """The names of the cameras."""
        return iter(self.names)

    def forward(self) -> dict[str, Camera]:
        """The cameras by name with the current values of the parameters, of the batch shape of the moments."""
        placed = {name: self[name]() for name in self.names}
        if self.moments is None:
            return placed
        R_m, t_m = self.moments()
        batch, found = t_m.shape[:-1], {}
        for name, camera in placed.items():
            R = (camera.R.unsqueeze(-1) * R_m.unsqueeze(-3)).sum(-2)  # elementwise: autocast and TF32 round products
            t = dot(camera.R, t_m.unsqueeze(-2)) + camera.t
            lens = None if camera.distortion is None else camera.distortion.expand(*batch)
            found[name] = Camera.unchecked(camera.K.expand(*batch, 3, 3), R, t, lens, camera.size)
        return found

    if TYPE_CHECKING:  # PyTorch types the call of a module as Any
        __call__ = forward

    def extra_repr(self) -> str:
        """What `print` shows between the brackets."""
        return f"names={self.names}"


class RigPoses(GeometryModule):
    """The poses of a rig at its moments, `(R, t)` of batch shape `*B`, parametrised as those of a `LearnableCamera`."""

    R_0: Tensor
    t_0: Tensor
    reach: Tensor

    def __init__(self, R: Float[Tensor, "*batch 3 3"], t: Float[Tensor, "*batch 3"], learn: Any) -> None:
        super().__init__()
        self.register_buffer("R_0", R.clone())
        self.register_buffer("t_0", t.clone())
        reach = t.norm(dim=-1, keepdim=True)
        self.register_buffer("reach", torch.where(reach > 0, reach, 1.0))
        for name in ("rotation", "translation"):
            add_parameter(self, name, t, learn, t.shape[:-1])

    def forward(self) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
        """World to rig."""
        return turned(self.R_0, learned(self, "rotation")), self.t_0 + self.reach * learned(self, "translation")

    if TYPE_CHECKING:  # PyTorch types the call of a module as Any
        __call__ = forward


def _checked(rig: object) -> dict[str, Camera]:
    """The cameras at their places."""
    given = rig.cameras if isinstance(rig, RigCalibration) else rig
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise TypeError(f"rig: want a dp.RigCalibration or a mapping from names to dp.Camera, got {called(rig)}")
    if not given:
        raise ValueError("rig: want at least one camera, got none")
    cameras = {str(name): as_camera(camera, f"rig[{name!r}]").detach() for name, camera in given.items()}
    first = next(iter(cameras.values()))
    for name, camera in cameras.items():
        if camera.batch_shape:
            raise ValueError(f"rig[{name!r}]: want one camera, got batch shape {tuple(camera.batch_shape)}")
        if camera.dtype != first.dtype:
            raise TypeError(f"rig[{name!r}]: want dtype {first.dtype} as the first has, got {camera.dtype}")
        if camera.device != first.device:
            raise ValueError(f"rig[{name!r}]: want device {first.device} as the first has, got {camera.device}")
    return cameras


def _poses(moments: object, like: Camera) -> tuple[Tensor, Tensor]:
    """Poses of the rig, checked, in the cameras' dtype."""
    if not isinstance(moments, tuple | list) or len(moments) != 2:
        raise TypeError(f"moments: want a pair (R, t), world to rig, got {called(moments)}")
    try:
        R, t = check_tensor("R", moments[0], 3, 3).detach(), check_tensor("t", moments[1], 3).detach()
        R, t = R.to(like.device, like.dtype), t.to(like.device, like.dtype)
        batch = torch.broadcast_shapes(R.shape[:-2], t.shape[:-1])
        if has_values(R, t):
            check_pose(R, t)
    except (TypeError, ValueError) as error:
        raise type(error)(f"moments: {error}") from None
    except RuntimeError:
        raise ValueError(
            f"moments: want R and t of batch shapes that broadcast, got {tuple(moments[0].shape)} and "
            f"{tuple(moments[1].shape)}"
        ) from None
    return R.expand(*batch, 3, 3), t.expand(*batch, 3)


def _chosen(learn: Learn | None, cameras: Mapping[str, Camera], moving: bool) -> tuple[dict[str, dict[str, Any]], Any]:
    """The parts to learn of each camera, and of which moments."""
    names = tuple(cameras)
    if learn is None:
        learn = (*PARTS, *([MOMENTS] if moving else []))
    wanted = asked_parts(learn)
    parts: dict[str, dict[str, Any]] = {name: {} for name in names}
    for entry, where in wanted.items():
        if entry == MOMENTS:
            if not moving:
                raise ValueError("learn: want 'moments' for a rig that is given moments=(R, t), got none")
            continue
        owner, part = owner_among(names, entry)
        if part not in (*PARTS, *OF_POSE):
            offered = ", ".join((*PARTS, *OF_POSE, *([MOMENTS] if moving else [])))
            raise ValueError(
                f"learn: want parts of {offered}, or one of the rig's cameras and its part, as {names[-1]}.pose, "
                f"got {entry!r}"
            )
        if owner is not None:
            parts[owner][part] = where
            continue
        for name in names[0 if part in PARTS[:3] else 1 :]:
            if part != "distortion" or cameras[name].distortion is not None:
                parts[name].setdefault(part, where)
    return parts, wanted.get(MOMENTS, False)


def _check_names(own: tuple[str, ...], _: nn.Module, state: dict[str, Any], prefix: str, *rest: Any) -> None:
    """Called before `load_state_dict`, which adds the message to its own: a state of others."""
    saved = state.get(f"{prefix}spelled")
    if saved is None or saved.ndim != 2 or not has_values(saved):
        return
    theirs = tuple(json.loads(bytes(numbers_of(saved).tolist())))
    if theirs != own:
        errors: list[str] = rest[-1]
        errors.append(
            f"{prefix}spelled: want the state of a rig of cameras {', '.join(own)}, got one of {', '.join(theirs)}"
        )
