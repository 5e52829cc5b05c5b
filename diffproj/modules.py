"""Parts for a training pipeline: pixels of a network in, points on a plane out, and a loss in world units.

    network -> pixels -> PlaneProjector -> points, valid -> PlaneLoss -> millimetres

The projector's camera and plane may be learned along, whole or in parts; `CalibrationPrior` keeps them where the
calibration says they are, as firmly as it knows. Geometry runs in the camera's own precision, under autocast too.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor, nn

from diffproj._numerics import check_tensor, precise, readable
from diffproj.back_projection import PlaneMap
from diffproj.calibration import Calibration
from diffproj.camera import Camera, as_camera
from diffproj.intrinsics import focal_and_center
from diffproj.learnable import PARTS, GeometryModule, Learn, LearnableCamera, learned, learned_parts, own
from diffproj.lens.coefficients import CoefficientLens
from diffproj.losses import Loss
from diffproj.plane import Plane


class LearnablePlane(GeometryModule):
    """A plane, or a batch of them, as a module: calling it gives a `Plane` that carries gradients.

    The normal turns on the sphere, `n = |n_0| unit(n_0 / |n_0| + T tilt)` with T two directions of the plane, and the
    plane moves along it, `d = |n_0| (d_0 / |n_0| + scale shift)`. Both parameters are zero at first.

    Args:
        plane: the start.
        scale: the distance in world units by which a shift of 1 moves the plane; as far as it is from the camera makes
            steps of tilt and shift alike.
        learn: whether it is learned, or which planes of the batch are: booleans that broadcast to its shape.

    Raises:
        ValueError: a plane for each point, or booleans that do not fit.

    Example:
        >>> learnable = LearnablePlane(Plane(torch.tensor([0.0, 0.0, 2.0]), torch.tensor(8.0)))
        >>> learnable().offset, [name for name, _ in learnable.named_parameters()]
        (tensor(8., grad_fn=<MulBackward0>), ['tilt', 'shift'])
    """

    unit_0: Tensor
    distance_0: Tensor
    length_0: Tensor
    tangents: Tensor
    scale: Tensor
    tilt: Tensor
    shift: Tensor

    def __init__(self, plane: Plane, scale: float = 1.0, learn: Any = True) -> None:
        super().__init__()
        if plane.is_per_point:
            raise ValueError("plane: want one plane for all points, got one for each (Plane.per_point)")
        normal, offset = plane.normal.detach(), plane.offset.detach()
        length = normal.norm(dim=-1)
        self.register_buffer("scale", torch.as_tensor(scale).to(normal))
        self.register_buffer("length_0", length)
        self.register_buffer("unit_0", normal / length.unsqueeze(-1))
        self.register_buffer("distance_0", offset / length)
        smallest = nn.functional.one_hot(normal.abs().argmin(-1), 3).to(normal)
        first = nn.functional.normalize(torch.linalg.cross(normal, smallest), dim=-1)
        second = nn.functional.normalize(torch.linalg.cross(normal, first), dim=-1)
        self.register_buffer("tangents", torch.stack([first, second], dim=-1))
        own(self, "tilt", self.tangents[..., 0, :], learn, plane.batch_shape)
        own(self, "shift", offset.unsqueeze(-1), learn, plane.batch_shape)

    def forward(self) -> Plane:
        """The plane as it is now."""
        turned = self.unit_0 + (self.tangents * learned(self, "tilt").unsqueeze(-2)).sum(-1)
        normal = turned * (self.length_0 / torch.linalg.vector_norm(turned, dim=-1)).unsqueeze(-1)
        distance = self.distance_0 + self.scale * learned(self, "shift").squeeze(-1)
        return Plane._unchecked(normal, self.length_0 * distance)


_FROZEN = ("_matrix", "_frozen_K", "_frozen_R", "_frozen_t", "_frozen_coefficients")
"""What a frozen projector has ready."""


class PlaneProjector(GeometryModule):
    """Pixels to points on a plane, as a layer.

    Args:
        camera: at its pose, of batch shape `*B`, or Kornia's `PinholeCamera`.
        plane: the plane, of batch shape `*B`.
        learn: what is learned along: any of `"focal"`, `"principal_point"`, `"distortion"`, `"pose"` and `"plane"`;
            nothing if left out, and then the map is built once. A mapping says it for each camera, or plane, of a
            batch, as for `LearnableCamera`: `{"focal": True, "pose": torch.tensor([True, False])}`.
        tied_intrinsics: whether the cameras of a batch learn one K and one lens, as for `LearnableCamera`: if left out,
            where all start with the same.

    Raises:
        TypeError: no camera or no plane, or different dtypes.
        ValueError: an unknown part to learn, or batch shapes that do not broadcast.

    Example:
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> projector = PlaneProjector(Camera(K, t=torch.tensor([0.0, 0, 1000])), Plane.z(0.0), learn=("focal", "pose"))
        >>> points, valid = projector(torch.tensor([[370.0, 240.0]]))
        >>> points.tolist(), [name for name, _ in projector.named_parameters()]
        ([[100.0, 0.0, 0.0]], ['_camera.log_focal', '_camera.rotation', '_camera.translation'])
    """

    _frozen_coefficients: Tensor

    def __init__(
        self, camera: Camera | PinholeCamera, plane: Plane, learn: Learn = (), tied_intrinsics: bool | None = None
    ) -> None:
        super().__init__()
        camera = as_camera(camera).detach()
        PlaneMap(camera, plane)  # checks that they fit together
        plane = plane.like(camera.K)
        chosen = learned_parts(learn, (*PARTS, "plane"))
        self.learn = tuple(chosen)
        whole = chosen.pop("plane", False)
        self._camera = LearnableCamera(camera, chosen, tied_intrinsics)
        away = ((plane.normal * camera.center).sum(-1) - plane.offset).abs() / plane.normal.norm(dim=-1)
        self._plane = LearnablePlane(plane, float(away.mean()) or 1.0, whole)
        # Buffers, so that whatever swaps or writes a module's state (DDP, functional_call) does so here, too.
        for name in _FROZEN:
            self.register_buffer(name, None, persistent=False)
        self._lens: CoefficientLens | None = None
        self._rebuild()
        self.register_load_state_dict_post_hook(_rebuild)

    @property
    def camera(self) -> Camera:
        """The camera as it is now, with gradients to what is learned."""
        return self._camera()

    @property
    def plane(self) -> Plane:
        """The plane as it is now, with gradients if it is learned."""
        return self._plane()

    def map(self) -> PlaneMap:
        """The map as it is now; a frozen projector has it ready."""
        if self.learn:
            return PlaneMap(self._camera(), self._plane())
        lens = self._lens
        if lens is not None and (torch.compiler.is_compiling() or lens.coefficients is not self._frozen_coefficients):
            lens = type(lens)._unchecked(self._frozen_coefficients)
            if readable(self._frozen_coefficients):  # kept, for it remembers what it works out about itself
                self._lens = lens
        camera = Camera._unchecked(self._frozen_K, self._frozen_R, self._frozen_t, lens, self._camera.size)
        return PlaneMap._unchecked(self._matrix, camera, False)

    def forward(
        self,
        pixels: Float[Tensor, "*#batch n 2"],
        warp: Float[Tensor, "*#batch 3 3"] | None = None,
        plane: Plane | None = None,
    ) -> tuple[Float[Tensor, "*#batch n 3"], Bool[Tensor, "*#batch n"]]:
        """Points on the plane.

        Args:
            pixels: `(*B, N, 2)`.
            warp: how the image that they belong to was warped, from the camera's own pixels: `(*B, 3, 3)`, what
                Kornia's augmentations keep as `transform_matrix`; see `Camera.warped`.
            plane: of these samples, in place of the projector's own.

        Returns:
            Points `(*B, N, 3)` and `valid (*B, N)`; see `back_project`.

        Raises:
            TypeError: no floating-point tensors, or others than the camera's dtype.
            ValueError: shapes or devices that do not fit, or a warp that `Camera.warped` refuses.
        """
        with torch.autocast(self._camera.t_0.device.type, enabled=False):
            if warp is None and plane is None:
                return self.map()(pixels)
            camera = self.camera if warp is None else self.camera.warped(warp)
            return PlaneMap(camera, self.plane if plane is None else plane)(pixels)

    def _apply(self, fn, recurse: bool = True):  # type: ignore[override]
        super()._apply(fn, recurse)
        self._rebuild()  # in the new precision, not rounded from the old one
        return self

    def _rebuild(self) -> None:
        if self.learn:
            return
        with torch.inference_mode(False), torch.no_grad():
            camera = self._camera()
            self._matrix = PlaneMap(camera, self._plane()).matrix
            self._frozen_K, self._frozen_R, self._frozen_t = camera.K.clone(), camera.R.clone(), camera.t.clone()
            if isinstance(camera.distortion, CoefficientLens):
                self._frozen_coefficients = camera.distortion.coefficients.clone()
                self._lens = type(camera.distortion)._unchecked(self._frozen_coefficients)

    def extra_repr(self) -> str:
        """What `print` shows between the brackets."""
        return f"learn={self.learn}"


def _rebuild(projector: PlaneProjector, _: Any) -> None:
    """Called behind `load_state_dict`, of the projector itself or of a network that it is part of."""
    projector._rebuild()


class PlaneLoss(nn.Module):
    """Squared or robust distance between points in world units, over those that are valid.

    The sum is divided by the number of all points, valid or not: then a point that becomes invalid takes nothing from
    the others and changes no gradient of theirs.

    Args:
        loss: a robust loss, its scale in world units (in pixels with `resolution`); squared distances if left out.

    Example:
        >>> points = torch.tensor([[3.0, 4.0, 0.0], [9.0, 9.0, 9.0]])
        >>> PlaneLoss()(points, torch.zeros(2, 3), torch.tensor([True, False]))
        tensor(12.5000)
    """

    def __init__(self, loss: Loss | None = None) -> None:
        super().__init__()
        if loss is not None and not isinstance(loss, Loss):
            raise TypeError(f"loss: want one such as dp.Huber(5.0), got {type(loss).__name__}")
        self.loss = loss

    def forward(
        self,
        points: Float[Tensor, "*batch n 3"],
        target: Float[Tensor, "*#batch n 3"],
        valid: Bool[Tensor, "*#batch n"] | None = None,
        weights: Float[Tensor, "*#batch n"] | None = None,
        resolution: Float[Tensor, "*#batch n"] | None = None,
    ) -> Float[Tensor, ""]:
        """The loss, a number.

        Args:
            points: `(*B, N, 3)`, in world units.
            target: where they should be.
            valid: which count; all if left out.
            weights: of the points.
            resolution: world units a pixel at each point (`ground_resolution`): distances are divided by it, so that
                far points, which a pixel moves further, count as much as near ones.
        """
        points, target = check_tensor("points", points, "N", 3), check_tensor("target", target, "N", 3)
        counts = torch.ones_like(points[..., 0], dtype=torch.bool) if valid is None else valid
        off = torch.where(counts.unsqueeze(-1), points - target.to(points), 0.0)
        if resolution is not None:
            off = off / torch.where(counts, resolution, 1.0).detach().unsqueeze(-1).to(off)
        value = off.square().sum(-1)
        value = value if self.loss is None else self.loss.value(value)
        return (value if weights is None else value * weights.to(value)).mean()


def ground_resolution(
    pixels: Float[Tensor, "*#batch n 2"], camera: Camera | PinholeCamera, plane: Plane
) -> tuple[Float[Tensor, "*#batch n"], Bool[Tensor, "*#batch n"]]:
    """World units that a pixel covers on the plane along its worst direction.

    Args:
        pixels: `(*B, N, 2)`.
        camera: as for `back_project`.
        plane: as for `back_project`.

    Returns:
        `(*B, N)`, 0 where not valid; and `valid (*B, N)`.

    Example:
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> ground_resolution(torch.tensor([[320.0, 240.0]]), Camera(K, t=torch.tensor([0.0, 0, 1000])), Plane.z(0.0))
        (tensor([2.]), tensor([True]))
    """
    to_plane = PlaneMap(camera, plane)
    pixels = check_tensor("pixels", pixels, "N", 2)
    right, down = torch.zeros_like(pixels), torch.zeros_like(pixels)
    right[..., 0], down[..., 1] = 1.0, 1.0
    (_, valid), (by_u, _) = torch.func.jvp(to_plane, (pixels,), (right,))[:2]
    by_v = torch.func.jvp(to_plane, (pixels,), (down,))[1][0]
    # The larger singular value of the 3 x 2 Jacobian, from its 2 x 2 Gram matrix.
    a, b, c = (by_u * by_u).sum(-1), (by_u * by_v).sum(-1), (by_v * by_v).sum(-1)
    spread = torch.hypot((a - c) / 2, b)
    return ((a + c) / 2 + spread).sqrt(), valid


class CalibrationPrior(nn.Module):
    """How far a camera has moved from its calibration, in the calibration's own deviations: `1/2 d^T C^-1 d`.

    Added to a loss that is a negative log-likelihood, it makes the calibration's data count along with the new.

    Args:
        calibration: of one camera, with its covariance.
        view: the view whose pose counts as well; none if left out.

    Raises:
        ValueError: many cameras, or a calibration without covariance.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> prior = CalibrationPrior(calibration, view=0)
        >>> prior(calibration.cameras[0]).item()
        0.0
    """

    center: Tensor
    precision: Tensor
    R_0: Tensor

    def __init__(self, calibration: Calibration, view: int | None = None) -> None:
        super().__init__()
        if calibration.views.batch_shape or not calibration.has_covariance:
            raise ValueError("calibration: want one camera with its covariance, as calibrate gives it")
        camera = calibration.camera if view is None else calibration.cameras[view]
        known = calibration.covariance
        C = known.shared if view is None else known.view(view)
        bows = [i for i, name in enumerate(known.names) if name.startswith("bow")]
        kept = [i for i in range(len(C)) if i not in bows and bool(C[i, i].isfinite()) and float(C[i, i]) > 0]
        C = C[kept][:, kept].detach()
        scale = C.diagonal().rsqrt()
        inverse = torch.linalg.inv(C * scale * scale.unsqueeze(-1)) * scale * scale.unsqueeze(-1)
        size = len(known.shared) - len(bows) + (0 if view is None else 6)
        where = torch.tensor([i - sum(b < i for b in bows) for i in kept])
        precision = C.new_zeros(size, size)
        precision[where.unsqueeze(-1), where] = inverse
        self.posed = view is not None
        self.register_buffer("R_0", precise(camera.R.detach()).clone())
        self.register_buffer("center", self._vector(camera.detach()).clone())
        self.register_buffer("precision", precision)

    def forward(self, camera: Camera | PinholeCamera) -> Float[Tensor, "*batch"]:
        """`1/2 d^T C^-1 d` of a camera of batch shape `*B`, such as `projector.camera`; in float64."""
        off = self._vector(as_camera(camera)) - self.center
        return (off * (self.precision * off.unsqueeze(-2)).sum(-1)).sum(-1) / 2

    def _vector(self, camera: Camera) -> Tensor:
        parts = [focal_and_center(precise(camera.K))]
        if camera.distortion is not None:
            parts.append(precise(camera.distortion.coefficients))  # type: ignore[attr-defined]
        if self.posed:
            turned = (precise(camera.R).unsqueeze(-3) * self.R_0.unsqueeze(-2)).sum(-1).mT  # R R_0^T
            omega = rotation_matrix_to_axis_angle(turned.reshape(-1, 3, 3)).reshape(*turned.shape[:-2], 3)
            parts += [omega, precise(camera.t)]
        return torch.cat([part.expand(*camera.batch_shape, part.shape[-1]) for part in parts], dim=-1)
