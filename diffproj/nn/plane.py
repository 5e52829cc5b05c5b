"""`LearnablePlane`: a plane that a PyTorch optimiser moves."""

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from diffproj._core.arguments import number
from diffproj.geometry.plane import Plane, as_plane
from diffproj.nn.partial import GeometryModule, add_parameter, learned


class LearnablePlane(GeometryModule):
    """A plane, or a batch of planes, as a module: calling it gives a `Plane` that carries gradients.

    With the starting plane `n_0 . X = d_0`, the normal tilts, `n = |n_0| unit(n_0 / |n_0| + T tilt)`, where the columns
    of T are two unit vectors of the starting plane (`Plane.tangents`), and the plane moves along its normal,
    `d = |n_0| (d_0 / |n_0| + scale shift)`. The parameters `tilt (*B, 2)` and `shift (*B, 1)` start at zero and have no
    unit; a small tilt is an angle in radians.

    Args:
        plane: the starting plane, of batch shape `*B`. Its tensors are copied; its dtype and device are the module's.
        scale: the distance in world units by which a shift of 1 moves the plane. With the distance between camera and
            plane here, equal steps of tilt and shift move the points about equally far.
        learn: True, False, or booleans that broadcast to the batch shape: the planes that are learned.

    Raises:
        TypeError: it is no plane, or another argument is of the wrong kind.
        ValueError: one plane for each point (`Plane.per_point`), a scale that is not positive, or booleans that do not
            broadcast.

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
        check_one_plane(plane)
        plane = plane.detach()
        length, (unit, distance) = plane.length, plane.normalised()
        scale = number("scale", scale, "a distance in world units, above 0", above=0)
        self.register_buffer("scale", length.new_tensor(scale))
        self.register_buffer("length_0", length)
        self.register_buffer("unit_0", unit)
        self.register_buffer("distance_0", distance)
        self.register_buffer("tangents", plane.tangents())
        add_parameter(self, "tilt", self.tangents[..., 0, :], learn, plane.batch_shape)
        add_parameter(self, "shift", self.distance_0.unsqueeze(-1), learn, plane.batch_shape)

    def forward(self) -> Plane:
        """The plane with the current values of the parameters, of the batch shape of the starting plane."""
        tilted = self.unit_0 + (self.tangents * learned(self, "tilt").unsqueeze(-2)).sum(-1)
        normal = tilted * (self.length_0 / torch.linalg.vector_norm(tilted, dim=-1)).unsqueeze(-1)
        distance = self.distance_0 + self.scale * learned(self, "shift").squeeze(-1)
        return Plane.unchecked(normal, self.length_0 * distance)

    if TYPE_CHECKING:  # PyTorch types the call of a module as Any
        __call__ = forward


def check_one_plane(plane: Plane) -> None:
    """Check that a plane does not stand for one plane for each point.

    Raises:
        TypeError: it is no plane.
        ValueError: it does.
    """
    if as_plane(plane).is_per_point:
        raise ValueError("plane: want one plane for all points, got one for each (Plane.per_point)")
