"""`LearnablePlane`: a plane that a PyTorch optimiser moves."""

from typing import Any

import torch
from torch import Tensor, nn

from diffproj.geometry.plane import Plane
from diffproj.nn.partial import GeometryModule, learned, own


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
        return Plane.unchecked(normal, self.length_0 * distance)
