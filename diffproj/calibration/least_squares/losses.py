"""Robust losses (M-estimators) of the squared residual.

A loss is a function rho of `e2 = |e|^2 (...,)`, in squared units of the residual (px^2 for the image objective), with
`rho(0) = 0` and `rho'(0) = 1`, so that small residuals count as in least squares. Its derivative is a residual's weight
in iteratively reweighted least squares. All are twice differentiable at `e2 = 0` too.

Sources: Huber 1964; Triggs, McLauchlan, Hartley and Fitzgibbon 2000, "Bundle adjustment", section 3.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import called, number
from diffproj._core.numerics import check_tensor

SMALLEST = 1e-100
"""The smallest scale; its inverse is the largest. What is computed of their squares is still right."""


@runtime_checkable
class Loss(Protocol):
    """Interface of a robust loss; a custom loss implements these two methods."""

    def value(self, squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """`rho(e2)`, in the unit of `squared`."""
        ...

    def weight(self, squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """`rho'(e2)`, between 0 and 1."""
        ...


@dataclass(frozen=True)
class _Scaled:
    scale: float

    def __post_init__(self) -> None:
        want = f"a positive number in the residual's unit, between {SMALLEST:g} and {1 / SMALLEST:g}"
        scale = number("scale", self.scale, want, least=SMALLEST, most=1 / SMALLEST)
        object.__setattr__(self, "scale", scale)


def _checked(squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Squared residuals; one look where they are a tensor, for the solver asks often."""
    if isinstance(squared, Tensor) and squared.is_floating_point() and squared.layout is torch.strided:
        return squared
    return check_tensor("squared", squared)


class Huber(_Scaled):
    """Quadratic up to `scale`, linear beyond: the influence of an outlier is bounded by that of a residual of `scale`.

    Example:
        >>> Huber(1.0).value(torch.tensor([0.25, 9.0]))
        tensor([0.2500, 5.0000])
    """

    def value(self, squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """`e2`, and `2 scale |e| - scale^2` beyond `scale`."""
        squared = _checked(squared)
        far = squared > self.scale**2
        return torch.where(far, 2 * self.scale * torch.where(far, squared, 1).sqrt() - self.scale**2, squared)

    def weight(self, squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """1, and `scale / |e|` beyond `scale`."""
        squared = _checked(squared)
        far = squared > self.scale**2
        return torch.where(far, self.scale / torch.where(far, squared, 1).sqrt(), torch.ones_like(squared))


class SoftL1(_Scaled):
    """`2 scale^2 (sqrt(1 + e2 / scale^2) - 1)`: similar to Huber's loss, but smooth.

    Example:
        >>> SoftL1(1.0).weight(torch.tensor([0.0, 8.0]))
        tensor([1.0000, 0.3333])
    """

    def value(self, squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """`2 scale^2 (sqrt(1 + e2 / scale^2) - 1)`, without cancellation."""
        squared = _checked(squared)
        return 2 * squared / (1 + (1 + squared / self.scale**2).sqrt())

    def weight(self, squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """`1 / sqrt(1 + e2 / scale^2)`."""
        return (1 + _checked(squared) / self.scale**2).rsqrt()


class Cauchy(_Scaled):
    """`scale^2 log(1 + e2 / scale^2)`: the influence of far outliers tends to 0. Not convex: needs a fair start.

    The scale should not be below the noise of a coordinate: from there on intervals of 95 % hold 95 % of the parameters
    (sampled), at half of it 92 %, and 2 % of the fits do not converge.

    Example:
        >>> Cauchy(1.0).weight(torch.tensor([0.0, 1.0, 99.0]))
        tensor([1.0000, 0.5000, 0.0100])
    """

    def value(self, squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """`scale^2 log(1 + e2 / scale^2)`."""
        return self.scale**2 * (_checked(squared) / self.scale**2).log1p()

    def weight(self, squared: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """`1 / (1 + e2 / scale^2)`."""
        return 1 / (1 + _checked(squared) / self.scale**2)


def check_loss(loss: Loss | None) -> None:
    """Check that something is a loss, or `None`.

    Raises:
        TypeError: it is neither.
    """
    if isinstance(loss, type) or not (loss is None or isinstance(loss, Loss)):
        raise TypeError(f"loss: want one such as dp.Huber(0.5), got {called(loss)}")


def slope_and_bend(loss: Loss | None, squared: Tensor) -> tuple[Tensor, Tensor]:
    """First and second derivative, rho' and rho'', of a loss by the squared residual; least squares if `None`."""
    if loss is None:
        return torch.ones_like(squared), torch.zeros_like(squared)
    with torch.inference_mode(False), torch.enable_grad():
        e2 = squared.detach().clone().requires_grad_()
        slope = loss.weight(e2)
        bend = torch.autograd.grad(slope.sum(), e2, allow_unused=True)[0] if slope.requires_grad else None
    return slope.detach(), torch.zeros_like(squared) if bend is None else bend
