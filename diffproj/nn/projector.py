"""`PlaneProjector`: pixels to points on a plane, as a layer."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float, Int
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from diffproj._core.arguments import Array, whole_number, whole_numbers
from diffproj._core.numerics import has_values
from diffproj.geometry.back_projection import PlaneMap
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.plane import Plane
from diffproj.nn.camera import check_tied, tied_axes
from diffproj.nn.fixed_map import FixedMap
from diffproj.nn.learnable_map import LearnableMap
from diffproj.nn.partial import OF_POSE, PARTS, Learn, learned_parts, without_autocast


class PlaneProjector(nn.Module):
    """Pixels to points on a plane, as a layer.

    With nothing to learn the map is built once, in construction, and a forward pass costs what applying it costs. With
    something to learn it is built anew in each forward pass, so that gradients reach the parameters.

    Args:
        camera: at its pose, of batch shape `*B`, or Kornia's `PinholeCamera`.
        plane: the plane, of batch shape `*B`.
        learn: the parts to learn: any of `"focal"`, `"principal_point"`, `"distortion"`, `"pose"`, or parts of it as
            for `LearnableCamera`, and `"plane"`; nothing if left out. A mapping also says for which cameras or planes
            of a batch: `{"focal": True, "pose": torch.tensor([True, False])}`.
        tied_intrinsics: whether the cameras of a batch share one K and one lens, as for `LearnableCamera`: if left out,
            they do where all start with the same values.

    Attributes:
        learn: the parts that are learned; empty for a fixed map.
        geometry: the module behind it: a `FixedMap`, or a `LearnableMap`, whose modules `camera` and `plane` hold the
            parameters, for example for learning rates of their own.

    Raises:
        TypeError: no camera or no plane, different dtypes, or a camera whose lens is of another package.
        ValueError: an unknown part to learn, one plane for each point, batch shapes that do not broadcast, or what
            `LearnableCamera` refuses.

    Example:
        >>> import torch
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> projector = PlaneProjector(Camera(K, t=torch.tensor([0.0, 0, 1000])), Plane.z(0.0), learn="focal")
        >>> points, valid = projector(torch.tensor([[370.0, 240.0]]))
        >>> points.tolist(), [name for name, _ in projector.named_parameters()]
        ([[100.0, 0.0, 0.0]], ['geometry.camera.log_focal'])
    """

    geometry: FixedMap | LearnableMap

    def __init__(
        self, camera: Camera | PinholeCamera, plane: Plane, learn: Learn = (), tied_intrinsics: bool | None = None
    ) -> None:
        super().__init__()
        camera = as_camera(camera).detach()
        check_tied(tied_intrinsics)
        chosen = learned_parts(learn, (*PARTS, *OF_POSE, "plane"))
        self.learn = tuple(chosen)
        if chosen:
            self.geometry = LearnableMap(camera, plane, chosen, tied_intrinsics)
        else:
            tied_axes(camera, tied_intrinsics)  # refuses different cameras that are said to be one
            self.geometry = FixedMap(camera, plane)

    @property
    def camera(self) -> Camera:
        """The camera as it is now, with gradients to what is learned; with a fixed map it shares the buffers."""
        return self.geometry.camera()

    @property
    def plane(self) -> Plane:
        """The plane as it is now, with gradients if it is learned; with a fixed map it shares the buffers."""
        return self.geometry.plane()

    def map(self) -> PlaneMap:
        """The map as it is now: built here where something is learned; otherwise ready, and it shares the buffers."""
        return self.geometry()

    def forward(
        self,
        pixels: Float[Tensor, "*#batch n 2"] | Array,
        warp: Float[Tensor, "*#batch 3 3"] | Array | None = None,
        plane: Plane | None = None,
        camera: Int[Tensor, "*samples"] | Sequence[int] | int | None = None,
    ) -> tuple[Float[Tensor, "*#batch n 3"], Bool[Tensor, "*#batch n"]]:
        """Points on the plane.

        Args:
            pixels: `(*B, N, 2)`.
            warp: how the image that they belong to was warped, from the camera's own pixels: `(*B, 3, 3)`, what
                Kornia's augmentations keep as `transform_matrix`; see `Camera.warped`.
            plane: of these samples, in place of the projector's own.
            camera: which of the projector's cameras took each sample: whole numbers `(*S)` from 0, along the first
                batch axis. Pixels, and a warp or plane, are then those of the samples, `(*S, N, 2)`.

        Returns:
            Points `(*B, N, 3)` in world units and `valid (*B, N)`; see `back_project`.

        Raises:
            TypeError: no floating-point tensors, or others than the camera's dtype.
            ValueError: shapes or devices that do not fit, or a warp that `Camera.warped` refuses.
        """
        geometry = self.geometry
        with without_autocast(geometry.device):
            if warp is None and plane is None and camera is None:
                return geometry()(pixels)
            return self._map_of(warp, plane, camera)(pixels)

    def _map_of(
        self,
        warp: Tensor | Array | None,
        plane: Plane | None,
        chosen: Tensor | Sequence[int] | int | None = None,
    ) -> PlaneMap:
        """The map of samples by some of the cameras, whose images were warped, or that lie on a plane of their own."""
        if chosen is not None:
            chosen = self._positions(chosen)
        if warp is None and plane is None:
            return self.geometry() if chosen is None else self.geometry()[chosen]
        # Of a frozen camera the one that has been worked out, whose lens remembers its plan.
        frozen = self.geometry.frozen() if isinstance(self.geometry, LearnableMap) else None
        camera = self.camera if frozen is None else frozen.camera
        own = self.plane if plane is None else plane
        if chosen is not None:
            camera = camera[chosen]
            own = own[chosen] if plane is None and own.batch_shape else own
        camera = camera if warp is None else camera.warped_by("warp", warp)
        return PlaneMap(camera, own)

    def _positions(self, chosen: Tensor | Sequence[int] | int) -> Tensor:
        """Which cameras, as a tensor of whole numbers."""
        shape = self.geometry.batch_shape
        if not shape:
            raise ValueError("camera: want none for a projector of one camera; build it of a batch, dp.stack(cameras)")
        return camera_numbers(chosen, shape[0], self.geometry.device)

    def miss(
        self,
        pixels: Float[Tensor, "*#batch n 2"] | Array,
        warp: Float[Tensor, "*#batch 3 3"] | Array | None = None,
        plane: Plane | None = None,
        camera: Int[Tensor, "*samples"] | Sequence[int] | int | None = None,
    ) -> Float[Tensor, "*#batch n"]:
        """The angles in radians by which rays miss the plane `(*B, N)`, for a `PlaneLoss` that pulls.

        See `PlaneMap.miss`; arguments as for the call.
        """
        with without_autocast(self.geometry.device):
            return self._map_of(warp, plane, camera).miss(pixels)

    if TYPE_CHECKING:  # PyTorch types the call of a module as Any
        __call__ = forward

    def extra_repr(self) -> str:
        """What `print` shows between the brackets."""
        return f"learn={self.learn}"


def camera_numbers(chosen: Tensor | Sequence[int] | int, count: int, device: torch.device) -> Tensor:
    """Which of so many cameras took each sample, as a tensor of whole numbers.

    Raises:
        TypeError: no whole numbers.
        ValueError: one of no camera; looked at on a CPU, for a GPU would have to be waited for.
    """
    if isinstance(chosen, int):
        number = whole_number("camera", chosen, f"a number from 0 to {count - 1}", least=0, most=count - 1)
        found = torch.tensor(number, dtype=torch.long, device=device)
    else:
        found = whole_numbers("camera", chosen, "which camera took each sample", device).to(device)
    if found.device.type == "cpu" and has_values(found) and found.numel():
        low, high = (int(end) for end in found.aminmax())
        if low < 0 or high >= count:
            raise ValueError(f"camera: want numbers from 0 to {count - 1}, got {low if low < 0 else high}")
    return found
