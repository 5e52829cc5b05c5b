"""`FixedMap`: the map of a camera and a plane that are not learned, held as the buffers of a module."""

from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.numerics import version_of
from diffproj.geometry.back_projection import PlaneMap
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.plane import Plane
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.models import coefficients_of, model_of
from diffproj.lens.plan import Plan
from diffproj.nn.partial import GeometryModule, add_kind
from diffproj.nn.plane import check_one_plane


class FixedMap(GeometryModule):
    """The `PlaneMap` of a camera and a plane, built once; calling it gives the map.

    Everything that the map depends on is a buffer: its matrix, the tensors of camera and plane, and what was worked out
    for the lens, all of which are in the `state_dict`. So whatever swaps or writes a module's state, such as
    `functional_call`, `stack_module_state` or DistributedDataParallel, swaps or writes the whole map. Matrix and plan
    are built again, in full precision, where the dtype or device changes (`.to`), and behind `load_state_dict`.

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

    Behind a lens there are also those of its plan, `domain`, `reach`, `noise`, `rho_max` and `ratio`, so that a
    compiled or exported map works out nothing about the lens.
    """

    K: Tensor
    R: Tensor
    t: Tensor
    coefficients: Tensor
    normal: Tensor
    offset: Tensor
    matrix: Tensor
    domain: Tensor

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
        self._planned_for: tuple[_Mark, _Mark] | None = None
        if self._model.kind is not None:
            for name in PLAN:
                self.register_buffer(name, None)
            self._plan_again()
        self.register_load_state_dict_post_hook(_rebuild)

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.t.device

    @property
    def batch_shape(self) -> torch.Size:
        """The batch shape of the camera."""
        return self.t.shape[:-1]

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
        """The lens of the coefficients and the plan as they are: of the buffers, or of what stands in their place.

        Where the coefficients alone were swapped or written to, the plan is no longer theirs, and worked out anew.
        """
        if self._model.kind is None:
            return None
        if not torch.compiler.is_compiling() and self._planned_for is not None:
            before = self._planned_for
            now = _mark(self.coefficients), _mark(self.domain)
            if now[0] != before[0] and now[1] == before[1]:
                return self._model.lens(self.coefficients)
        return self._model.kind.planned(self.coefficients, Plan(*(getattr(self, name) for name in PLAN)))

    def _plan_again(self) -> None:
        """Work out the plan of the coefficients."""
        with torch.inference_mode(False), torch.no_grad():
            lens = self._model.lens(self.coefficients)
            if lens is None:
                return
            for name, part in lens.plan()._asdict().items():
                setattr(self, name, part.detach().clone(memory_format=torch.contiguous_format))
        self._planned_for = _mark(self.coefficients), _mark(self.domain)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if self._planned_for is not None:  # copied, or read from a file: the tensors are others
            self._planned_for = _mark(self.coefficients), _mark(self.domain)

    def _apply(self, fn, recurse: bool = True):  # type: ignore[override]
        super()._apply(fn, recurse)
        self.rebuild()
        return self

    def rebuild(self) -> None:
        """Build the matrix again from the tensors of camera and plane, in the precision that they have now."""
        with torch.inference_mode(False), torch.no_grad():
            self._plan_again()
            self.matrix = PlaneMap.quietly(self.camera(), self.plane()).matrix


PLAN = tuple(Plan.__annotations__)
"""The names of the parts of a plan."""

_Mark = tuple[int, int]


def _mark(tensor: Tensor) -> _Mark:
    """Which tensor it is, and how often it was written to, as far as that is known."""
    return id(tensor), version_of(tensor)


def _rebuild(fixed: FixedMap, _: Any) -> None:
    """Called behind `load_state_dict`, of the module itself or of a network that it is part of."""
    fixed.rebuild()
