"""`Lens`: the interface between cameras and lens models, which a user's own lens can implement too."""

from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@runtime_checkable
class Lens(Protocol):
    """A lens: maps directions in the camera frame to distorted points on the normalised plane, and back.

    The camera frame has x to the right, y down, z forward. The normalised plane is z = 1: a camera maps a distorted
    point `xy` to the pixel `(f_x x + c_x, f_y y + c_y)`. Both mappings return finite values everywhere. Where `valid`
    is false (outside the model's domain) the result is a constant with zero gradient; where it is true the result is
    twice differentiable by the points and by the lens's parameters.

    **A custom lens** needs no base class: a camera accepts any object with these attributes and methods. Tensors of
    the lens have its batch axes in front (`coefficients (*B, k)`), which broadcast against those of the points. For
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
