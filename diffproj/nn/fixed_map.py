"""`FixedMap`: the map of a camera and a plane that are not learned, held as the buffers of a module."""

from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj.geometry.back_projection import PlaneMap
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.plane import Plane
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.models import coefficients_of, model_of
from diffproj.lens.plan import Plan
from diffproj.nn.partial import GeometryModule, add_kind, check_swapped_kind
from diffproj.nn.plane import check_one_plane


class FixedMap(GeometryModule):
    """The `PlaneMap` of a camera and a plane, built once; calling it gives the map.

    Everything that the map depends on is a buffer: its matrix, the tensors of camera and plane, and what was worked out
    for the lens, all of which are in the `state_dict`. So whatever swaps or writes a module's state, such as
    `functional_call`, `stack_module_state` or DistributedDataParallel, swaps or writes the whole map. Matrix and plan
    are built again, in full precision, where the dtype or device changes (`.to`), and behind `load_state_dict`; and
    where a part of what they were made from is swapped or written to without them, such as K alone. A compiled or
    exported graph does not look for that: there, swap the whole state.

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
        self._made: dict[str, _Mark] = {}
        if self._model.kind is not None:
            for name in PLAN:
                self.register_buffer(name, None)
            self._plan_again()
        self._mark_all()
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
        if self._is_outdated(OF_MATRIX, "matrix"):
            return PlaneMap.quietly(self.camera(), self.plane())
        return PlaneMap.unchecked(self.matrix, self.camera(), False)

    def camera(self) -> Camera:
        """The camera."""
        check_swapped_kind(self)
        return self._camera()

    def _camera(self) -> Camera:
        return Camera.unchecked(self.K, self.R, self.t, self._current_lens(), self._size)

    def plane(self) -> Plane:
        """The plane."""
        return Plane.unchecked(self.normal, self.offset)

    def _current_lens(self) -> CoefficientLens | None:
        """The lens of the coefficients and the plan as they are: of the buffers, or of what stands in their place."""
        if self._model.kind is None:
            return None
        if self._is_outdated(("coefficients",), "domain"):
            return self._model.lens(self.coefficients)
        return self._model.kind.planned(self.coefficients, Plan(*(getattr(self, name) for name in PLAN)))

    def _is_outdated(self, made_from: tuple[str, ...], result: str) -> bool:
        """Whether a part of what a result was made from was swapped or written to, and the result was not.

        Of the module's own buffers, matrix and plan are then built again, and none is.
        """
        if torch.compiler.is_compiling():
            return False
        buffers, made = self._buffers, self._made
        for name in made_from:  # asked in each call
            tensor, version = made[name]
            if buffers[name] is not tensor or (version >= 0 and tensor._version != version):
                break
        else:
            return False
        written = all(buffers[name] is made[name][0] for name in (*made_from, result))
        tensor, version = made[result]
        if buffers[result] is not tensor or (
            version >= 0 and tensor._version != version
        ):  # all of it, as by DistributedDataParallel
            if written:
                self._mark_all()
            return False
        if not written:
            return True
        self.rebuild()
        return False

    def _mark_all(self) -> None:
        """Take all buffers as they are now for what goes together."""
        self._made = {name: _mark(buffer) for name, buffer in self._buffers.items() if buffer is not None}

    def _plan_again(self) -> None:
        """Work out the plan of the coefficients."""
        with torch.inference_mode(False), torch.no_grad():
            lens = self._model.lens(self.coefficients)
            if lens is None:
                return
            for name, part in lens.plan()._asdict().items():
                # No infinity: what averages the buffers of a network, such as `AveragedModel`, would make NaN of it.
                part = part.detach().clamp(max=torch.finfo(part.dtype).max)
                setattr(self, name, part.clone(memory_format=torch.contiguous_format))

    def __getstate__(self) -> dict[str, Any]:
        self._is_outdated(OF_MATRIX, "matrix")  # built again here, for the marks are not those of a copy
        self._current_lens()
        return self.__dict__ | {"_made": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._mark_all()

    def _apply(self, fn, recurse: bool = True):  # type: ignore[override]
        super()._apply(fn, recurse)
        self.rebuild()
        return self

    def rebuild(self) -> None:
        """Build matrix and plan again from the tensors of camera and plane, in the precision that they have now."""
        with torch.inference_mode(False), torch.no_grad():
            self._plan_again()
            self._mark_all()
            self.matrix = PlaneMap.quietly(self._camera(), self.plane()).matrix
            self._mark_all()


OF_MATRIX = ("K", "R", "t", "normal", "offset")
"""The names of what the matrix is made from."""
PLAN = tuple(Plan.__annotations__)
"""The names of the parts of a plan."""

_Mark = tuple[Tensor, int]


def _mark(tensor: Tensor) -> _Mark:
    """Which tensor it is, and how often it was written to; -1 of one whose writes PyTorch does not count."""
    return tensor, -1 if tensor.is_inference() else tensor._version


def _rebuild(fixed: FixedMap, _: Any) -> None:
    """Called behind `load_state_dict`, of the module itself or of a network that it is part of."""
    fixed.rebuild()
