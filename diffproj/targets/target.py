"""`Target`: what is known in the world and seen in photographs."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import instance
from diffproj._core.numerics import check_tensor


@runtime_checkable
class Target(Protocol):
    """Anything with world points, such as `Chessboard` and `Landmarks`."""

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """World points `(N, 3)`, in the order of the views' corners."""
        ...


def points_of(target: Target) -> Float[Tensor, "n 3"]:
    """The points of a target.

    Raises:
        TypeError: it has none, or they are no floating-point tensor.
        ValueError: they are not of shape `(N, 3)`.
    """
    instance("target", target, Target, "dp.Chessboard, dp.Landmarks or anything with .points (N, 3)")
    if isinstance(target, type) and isinstance(target.points, property):
        raise TypeError(f"target: want an instance, as dp.Chessboard(), got the class {target.__name__}")
    points = check_tensor("target.points", target.points, "N", 3)
    if points.ndim != 2:
        raise ValueError(f"target: want .points of shape (N, 3), got {tuple(points.shape)}")
    return points
