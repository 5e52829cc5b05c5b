"""`PlaneProjector`: pixels to points on a plane, as a layer."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.numerics import has_values
from diffproj.geometry.back_projection import PlaneMap
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.plane import Plane
from diffproj.lens.coefficients import CoefficientLens
from diffproj.nn.camera import LearnableCamera
from diffproj.nn.partial import PARTS, GeometryModule, Learn, learned_parts
from diffproj.nn.plane import LearnablePlane

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
            lens = type(lens).unchecked(self._frozen_coefficients)
            if has_values(self._frozen_coefficients):  # kept, for it remembers what it works out about itself
                self._lens = lens
        camera = Camera.unchecked(self._frozen_K, self._frozen_R, self._frozen_t, lens, self._camera.size)
        return PlaneMap.unchecked(self._matrix, camera, False)

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
                self._lens = type(camera.distortion).unchecked(self._frozen_coefficients)

    def extra_repr(self) -> str:
        """What `print` shows between the brackets."""
        return f"learn={self.learn}"


def _rebuild(projector: PlaneProjector, _: Any) -> None:
    """Called behind `load_state_dict`, of the projector itself or of a network that it is part of."""
    projector._rebuild()
