"""`Target`: what is known in the world and seen in photographs."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Target(Protocol):
    """Anything with world points, such as `Chessboard`.

    Calibration asks for points on the plane z = 0.
    """

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """World points `(N, 3)`, in the order of the views' corners."""
        ...
