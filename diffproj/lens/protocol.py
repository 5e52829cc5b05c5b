"""`Lens`: the interface between cameras and lens models, which a user's own lens can implement too."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Mapping = Callable[[Tensor], tuple[Tensor, Tensor]]


def distorted(project_direction: Mapping, xy: Tensor) -> tuple[Tensor, Tensor]:
    """Points of the normalised plane through a lens that projects directions."""
    return project_direction(torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1))


def undistorted(unproject: Mapping, xy_distorted: Tensor) -> tuple[Tensor, Tensor]:
    """And back; (0, 0) where there is no point, or none in front."""
    direction, valid = unproject(xy_distorted)
    valid = valid & (direction[..., 2] > 0)
    x, y, z = torch.where(valid.unsqueeze(-1), direction, 1.0).unbind(-1)
    return torch.where(valid.unsqueeze(-1), torch.stack([x / z, y / z], dim=-1), 0.0), valid


@runtime_checkable
class Lens(Protocol):
    """A lens: maps directions in the camera frame to distorted points on the normalised plane, and back.

    The camera frame has x to the right, y down, z forward. The normalised plane is z = 1: a camera maps a distorted
    point `xy` to the pixel `(f_x x + c_x, f_y y + c_y)`. Both mappings return finite values everywhere. Where `valid`
    is false (outside the model's domain) the result is a constant with zero gradient; where it is true the result is
    twice differentiable by the points and by the lens's parameters.

    **A custom lens** needs no base class: a camera accepts any object with these attributes and methods. One that
    inherits from this class has `distort` and `undistort` from it, by the other two. Tensors of the lens have its batch
    axes in front (`coefficients (*B, k)`), which broadcast against those of the points. For
    `vmap`, `torch.func` and `torch.compile` along with its camera, the class must be registered with
    `dp.register_lens`.

    Example:
        >>> import diffproj as dp
        >>> isinstance(dp.BrownConrady(torch.zeros(5)), dp.Lens)
        True
    """

    @property
    def batch_shape(self) -> torch.Size:
        """The batch axes `*B`."""
        ...

    @property
    def dtype(self) -> torch.dtype:
        """The floating-point type of the parameters."""
        ...

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        ...

    @property
    def domain(self) -> Float[Tensor, "*lens"]:
        """`(*B,)`, the extent of valid points: a radius on the normalised plane, or an angle from the axis in radians.

        Infinite where there is no limit, 0 where the lens is unusable.
        """
        ...

    def project_direction(
        self, direction: Float[Tensor, "*batch n 3"]
    ) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """Project directions of any length to distorted points on the normalised plane; and which are valid."""
        ...

    def unproject(
        self, xy_distorted: Float[Tensor, "*batch n 2"]
    ) -> tuple[Float[Tensor, "*out n 3"], Bool[Tensor, "*out n"]]:
        """Directions whose projections are these points; and which are valid."""
        ...

    def undistort(
        self, xy_distorted: Float[Tensor, "*batch n 2"]
    ) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """Undistorted points `(x / z, y / z)` of distorted ones; and which are valid: those in front, at z > 0."""
        return undistorted(self.unproject, xy_distorted)

    def distort(self, xy: Float[Tensor, "*batch n 2"]) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """Distorted points of undistorted ones `(x / z, y / z)`; and which are valid."""
        return distorted(self.project_direction, xy)

    def to(self, *args: Any, **kwargs: Any) -> "Lens":
        """The lens in another dtype or on another device: arguments as `torch.Tensor.to`."""
        ...

    def expand(self, *batch_shape: int) -> "Lens":
        """The lens with its batch axes broadcast to `batch_shape`, without copying."""
        ...

    def detach(self) -> "Lens":
        """The lens detached from the autograd graph of its parameters."""
        ...

    def __getitem__(self, index: Any) -> "Lens":
        """Lenses of the batch, chosen by indexing its batch axes."""
        ...
