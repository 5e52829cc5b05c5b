"""`PlaneProjector`: pixels to points on a plane, as a layer."""

from typing import TYPE_CHECKING

from jaxtyping import Bool, Float
from kornia.geometry.camera import PinholeCamera
from torch import Tensor, nn

from diffproj._core.arguments import Array
from diffproj.geometry.back_projection import PlaneMap
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.plane import Plane
from diffproj.nn.camera import check_tied, tied_axes
from diffproj.nn.fixed_map import FixedMap
from diffproj.nn.learnable_map import LearnableMap
from diffproj.nn.partial import PARTS, Learn, learned_parts, without_autocast


class PlaneProjector(nn.Module):
    """Pixels to points on a plane, as a layer.

    With nothing to learn the map is built once, in construction, and a forward pass costs what applying it costs. With
    something to learn it is built anew in each forward pass, so that gradients reach the parameters.

    Args:
        camera: at its pose, of batch shape `*B`, or Kornia's `PinholeCamera`.
        plane: the plane, of batch shape `*B`.
        learn: the parts to learn: any of `"focal"`, `"principal_point"`, `"distortion"`, `"pose"` and `"plane"`;
            nothing if left out. A mapping also says for which cameras or planes of a batch, as for `LearnableCamera`:
            `{"focal": True, "pose": torch.tensor([True, False])}`.
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
        chosen = learned_parts(learn, (*PARTS, "plane"))
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
    ) -> tuple[Float[Tensor, "*#batch n 3"], Bool[Tensor, "*#batch n"]]:
        """Points on the plane.

        Args:
            pixels: `(*B, N, 2)`.
            warp: how the image that they belong to was warped, from the camera's own pixels: `(*B, 3, 3)`, what
                Kornia's augmentations keep as `transform_matrix`; see `Camera.warped`.
            plane: of these samples, in place of the projector's own.

        Returns:
            Points `(*B, N, 3)` in world units and `valid (*B, N)`; see `back_project`.

        Raises:
            TypeError: no floating-point tensors, or others than the camera's dtype.
            ValueError: shapes or devices that do not fit, or a warp that `Camera.warped` refuses.
        """
        with without_autocast(self.geometry.device):
            if warp is None and plane is None:
                return self.geometry()(pixels)
            camera = self.camera if warp is None else self.camera.warped_by("warp", warp)
            return PlaneMap(camera, self.plane if plane is None else plane)(pixels)

    if TYPE_CHECKING:  # PyTorch types the call of a module as Any
        __call__ = forward

    def extra_repr(self) -> str:
        """What `print` shows between the brackets."""
        return f"learn={self.learn}"
