"""`LearnableMap`: the map of a camera and a plane of which something is learned."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from diffproj._core.numerics import has_values
from diffproj._core.torch_private import in_forward_mode
from diffproj.geometry.back_projection import PlaneMap
from diffproj.geometry.camera import Camera
from diffproj.geometry.plane import Plane
from diffproj.nn.camera import LearnableCamera
from diffproj.nn.partial import same_values
from diffproj.nn.plane import LearnablePlane


class LearnableMap(nn.Module):
    """A `LearnableCamera` and a `LearnablePlane`; calling it builds their `PlaneMap`, which carries gradients.

    Where no parameter asks for a gradient (`requires_grad_(False)`) the map is built once, and again where a value of
    the module's has changed, in whatever way it was written: on a CPU, for on a GPU looking would take longer.

    Args:
        camera: the starting camera, of batch shape `*B`.
        plane: the starting plane, of batch shape `*B`.
        learn: from each part that is learned, the plane among them as `"plane"`, to True or to the elements of the
            batch for which it is; see `LearnableCamera`.
        tied_intrinsics: as for `LearnableCamera`.

    Raises:
        TypeError: not a plane, different dtypes, or what `LearnableCamera` refuses.
        ValueError: batch shapes that do not broadcast, or what `LearnableCamera` and `LearnablePlane` refuse.

    Example:
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> learnable = LearnableMap(Camera(K, t=torch.tensor([0.0, 0, 1000])), Plane.z(0.0), {"plane": True})
        >>> points, valid = learnable()(torch.tensor([[370.0, 240.0]]))
        >>> points.tolist(), [name for name, _ in learnable.named_parameters()]
        ([[100.0, 0.0, 0.0]], ['plane.tilt', 'plane.shift'])
    """

    def __init__(
        self, camera: Camera, plane: Plane, learn: dict[str, Any], tied_intrinsics: bool | None = None
    ) -> None:
        super().__init__()
        self._kept: tuple[list[Tensor], PlaneMap] | None = None
        PlaneMap(camera, plane)  # checks that they fit together
        plane = plane.like(camera.K)
        distance = plane.distance(camera.center.unsqueeze(-2)).abs()
        of_camera = {part: where for part, where in learn.items() if part != "plane"}
        self.camera = LearnableCamera(camera, of_camera, tied_intrinsics)
        # Without a distance, as of a camera on the plane, of none at all, or without values, steps are in world units.
        scale = float(distance.mean()) if has_values(distance) else 0.0
        self.plane = LearnablePlane(plane, scale if 0 < scale < math.inf else 1.0, learn.get("plane", False))

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.camera.t_0.device

    @property
    def batch_shape(self) -> torch.Size:
        """The batch shape of the camera."""
        return self.camera.batch_shape

    def forward(self) -> PlaneMap:
        """The map with the current values of the parameters."""
        kept = self.frozen()
        return PlaneMap.quietly(self.camera(), self.plane()) if kept is None else kept

    def frozen(self) -> PlaneMap | None:
        """The map if nothing is learned at the moment, kept for as long as no value changes; `None` otherwise."""
        state = [
            tensor
            for module in (self.camera, self.plane)
            for tensors in (module._parameters, module._buffers)
            for tensor in tensors.values()
            if tensor is not None
        ]
        if any(module._modules for module in (self.camera, self.plane)):  # parametrised: what stands there is no tensor
            return None
        if torch.compiler.is_compiling() or in_forward_mode() or any(tensor.requires_grad for tensor in state):
            return None
        if self.device.type != "cpu" or not has_values(*state):
            return None
        kept = self._kept
        if kept is None or not all(map(same_values, state, kept[0])):
            with torch.inference_mode(False), torch.no_grad():
                values = [tensor.detach().clone() for tensor in state]
                kept = self._kept = values, PlaneMap.quietly(self.camera().detach(), self.plane().detach())
        return kept[1]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_kept": None}
