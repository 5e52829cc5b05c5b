"""What a lens is: the one interface that cameras know, and that a lens from outside the package can offer too."""

from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@runtime_checkable
class Lens(Protocol):
    """A lens: from directions in the camera frame to distorted points on the normalised plane, and back.

    The camera frame has x to the right, y down, z forward. The normalised plane is z = 1: a camera takes a distorted
    point `xy` to the pixel `(f_x x + c_x, f_y y + c_y)`. Both ways promise the same: results are finite everywhere;
    `valid` is false where the model has no honest answer, and there the result is constant, so that its gradient is
    zero. Where it is true the result is differentiable twice in the points and in the lens's own parameters.

    **A lens of your own** needs no base class. Give it these attributes and methods and a camera accepts it. Tensors
    of the lens carry its batch axes in front (`coefficients (*B, k)`), which broadcast against those of the points. To
    be carried by `vmap`, `torch.func` and `torch.compile` along with its camera, the class must be registered with
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
        """`(*B,)`, how far the lens reaches: a radius on the normalised plane, or an angle from the axis in radians.

        Infinite where there is no limit, 0 where the lens is of no use at all.
        """
        ...

    def project_direction(
        self, direction: Float[Tensor, "*batch n 3"]
    ) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """Where directions of any length arrive on the normalised plane, and whether they do."""
        ...

    def unproject(
        self, xy_distorted: Float[Tensor, "*batch n 2"]
    ) -> tuple[Float[Tensor, "*out n 3"], Bool[Tensor, "*out n"]]:
        """The directions that arrive at these points, and whether there are any."""
        ...

    def to(self, *args: Any, **kwargs: Any) -> "Lens":
        """The lens in another dtype or on another device: arguments as `torch.Tensor.to`."""
        ...

    def expand(self, *batch_shape: int) -> "Lens":
        """The lens with its batch axes broadcast to `batch_shape`, without copying."""
        ...

    def detach(self) -> "Lens":
        """The lens cut from the graph of its parameters."""
        ...

    def __getitem__(self, index: Any) -> "Lens":
        """Lenses of the batch, chosen by indexing its batch axes."""
        ...
