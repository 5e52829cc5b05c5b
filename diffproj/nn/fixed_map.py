"""`FixedMap`: the map of a camera and a plane that are not learned, held as the buffers of a module."""

from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.numerics import has_values
from diffproj.geometry.back_projection import PlaneMap
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.plane import Plane
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.models import coefficients_of, model_of
from diffproj.nn.partial import GeometryModule, add_kind
from diffproj.nn.plane import check_one_plane


class FixedMap(GeometryModule):
    """The `PlaneMap` of a camera and a plane, built once; calling it gives the map.

    Everything that the map depends on is a buffer: its matrix, and the tensors of camera and plane, all of which are in
    the `state_dict`. So whatever swaps or writes a module's state, such as `functional_call`, `stack_module_state` or
    DistributedDataParallel, swaps or writes the whole map. The matrix is built again, in full precision, where the
    dtype or device changes (`.to`), and behind `load_state_dict`.

    Args:
        camera: of batch shape `*B`. Its tensors are copied, without gradients.
        plane: of batch shape `*B`, copied likewise.

    Raises:
        TypeError: not a plane, different dtypes, or a camera whose lens is of another package.
        ValueError: one plane for each point (`Plane.per_point`), or batch shapes that do not broadcast.

    Example:
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
        >>> fixed = FixedMap(Camera(K, t=torch.tensor([0.0, 0, 1000])), Plane.z(0.0))
        >>> points, valid = fixed()(torch.tensor([[370.0, 240.0]]))
        >>> points.tolist(), [name for name, _ in fixed.named_buffers()]
        ([[100.0, 0.0, 0.0]], ['K', 'R', 't', 'coefficients', 'normal', 'offset', 'matrix', 'kind'])
    """

    K: Tensor
    R: Tensor
    t: Tensor
    coefficients: Tensor
    normal: Tensor
    offset: Tensor
    matrix: Tensor

    def __init__(self, camera: Camera | PinholeCamera, plane: Plane) -> None:
        super().__init__()
        camera = as_camera(camera)
        matrix = PlaneMap(camera, plane).matrix  # which also checks that they fit together
        check_one_plane(plane)
        self._model, self._size = model_of(camera.distortion), camera.size
        plane = plane.like(camera.K)
        coefficients = coefficients_of(camera.distortion, camera.t).expand(*camera.batch_shape, -1)
        tensors = {"K": camera.K, "R": camera.R, "t": camera.t, "coefficients": coefficients}
        tensors |= {"normal": plane.normal, "offset": plane.offset, "matrix": matrix}
        with torch.inference_mode(False):  # so that the module trains and saves wherever it was built
            for name, tensor in tensors.items():
                self.register_buffer(name, tensor.detach().clone(memory_format=torch.contiguous_format))
        add_kind(self, camera)
        # The lens of the current coefficients, kept because it remembers what it works out about itself.
        self._lens: CoefficientLens | None = None
        self.register_load_state_dict_post_hook(_rebuild)

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.t.device

    def forward(self) -> PlaneMap:
        """The map. It shares the buffers, as `camera` and `plane` do: what is written to them later changes it too."""
        return PlaneMap.unchecked(self.matrix, self.camera(), False)

    def camera(self) -> Camera:
        """The camera."""
        return Camera.unchecked(self.K, self.R, self.t, self._current_lens(), self._size)

    def plane(self) -> Plane:
        """The plane."""
        return Plane.unchecked(self.normal, self.offset)

    def _current_lens(self) -> CoefficientLens | None:
        """The lens of the coefficients as they are: of the buffer, or of what stands in its place at the moment."""
        if self._model.kind is None:
            return None
        lens, coefficients = self._lens, self.coefficients
        if torch.compiler.is_compiling() or lens is None or lens.coefficients is not coefficients:
            lens = self._model.lens(coefficients)
            if has_values(coefficients):
                self._lens = lens
        return lens

    def _apply(self, fn, recurse: bool = True):  # type: ignore[override]
        super()._apply(fn, recurse)
        self.rebuild()
        return self

    def rebuild(self) -> None:
        """Build the matrix again from the tensors of camera and plane, in the precision that they have now."""
        with torch.inference_mode(False), torch.no_grad():
            self.matrix = PlaneMap(self.camera(), self.plane()).matrix


def _rebuild(fixed: FixedMap, _: Any) -> None:
    """Called behind `load_state_dict`, of the module itself or of a network that it is part of."""
    fixed.rebuild()
