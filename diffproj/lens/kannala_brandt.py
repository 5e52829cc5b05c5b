"""`KannalaBrandt`: the fisheye lens, with an exact inverse up to and beyond 90 degrees from the axis.

A direction `(x, y, z)` with the angle `theta` from the axis, and `side = |(x, y)|`, arrives at

    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
    xy_distorted = theta_d / side (x, y)

on the normalised plane, so that `rho = |xy_distorted|` is `theta_d`. Backward, the unknown is the ratio
`sigma = theta / rho`, which is smooth at the centre where `theta` itself is not:

    sigma (1 + k1 theta^2 + ... + k4 theta^8) = 1     with theta^2 = sigma^2 rho^2
    direction = (sigma sin(theta) / theta  xy_distorted, cos(theta))

Sources: Kannala and Brandt 2006 (the model); the order of the coefficients is that of OpenCV's fisheye module.
"""

import math
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.numerics import in_blocks, precise, readable
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.compiling import coordinates, derivative_wanted, with_batch_in_front
from diffproj.lens.domain import first_failure
from diffproj.lens.plan import Plan
from diffproj.lens.polynomial import polynomial
from diffproj.lens.smooth import angle_over_side, sine_over_angle_and_cosine
from diffproj.lens.table import InverseTable, inverse_table

STEPS = 4
"""Newton steps from the table's start to rounding, but for points next to a fold."""
PATIENCE = 60
"""Steps for those."""
ANGLES = 512
"""Angles to look at first for the end of the domain."""
TOLERANCE = 16
"""How many roundings of the equation a solution may be off by."""


class KannalaBrandt(CoefficientLens, tensors={"coefficients": 1}):
    """The equidistant fisheye with four coefficients, in the order of OpenCV's fisheye module.

    Directions are in the camera frame (x right, y down, z forward), distorted points on the normalised plane. The lens
    answers on a cone of field angles around the axis, `domain`, on which it is one-to-one, at most 180 degrees;
    `valid` is false elsewhere, and the result the axis.

    Args:
        coefficients: `(*B, 4)`, `k1 k2 k3 k4`, without unit; kept as they are, gradients flow to them.

    Raises:
        TypeError: not a floating-point tensor.
        ValueError: not four coefficients, or one that is not finite.

    Example:
        >>> lens = KannalaBrandt(torch.tensor([0.01, -0.002, 0.0, 0.0], dtype=torch.float64))
        >>> sideways = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)  # 90 degrees from the axis
        >>> xy_distorted, valid = lens.project_direction(sideways)
        >>> direction, valid = lens.unproject(xy_distorted)
        >>> torch.allclose(direction, sideways), valid
        (True, tensor([True]))
    """

    counts = (4,)

    @property
    def domain(self) -> Float[Tensor, "*lens"]:
        """The largest angle from the axis that the lens answers for, `(*B,)`, in radians, without gradient.

        Up to it `theta_d` rises with `theta`; rounded inward; at most pi.
        """
        return self._domain()

    def project_direction(
        self, direction: Float[Tensor, "*batch n 3"]
    ) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """Where directions of the camera frame arrive on the normalised plane.

        Args:
            direction: `(*B, N, 3)`, of any length; `z` may be negative.

        Returns:
            Distorted points `(*B, N, 2)`, and `valid`: inside the domain, finite and not 0. (0, 0) with zero gradient
            where not.
        """
        domain = self._domain()

        def forward(directions: Tensor) -> tuple[Tensor, Tensor]:
            valid = _within(domain, directions.detach())
            x, y, z = (directions / _size(directions)).unbind(-1)
            x, y, z = torch.where(valid, x, 0), torch.where(valid, y, 0), torch.where(valid, z, 1)
            side_squared = x * x + y * y
            k = list(self._usable(domain).unsqueeze(-2).unbind(-1))
            ratio = angle_over_side(side_squared, z)
            scale = ratio * _profile(k, ratio * ratio * side_squared)
            return torch.stack([x * scale, y * scale], dim=-1), valid

        return in_blocks(forward, self._checked("direction", direction, 3), self.coefficients)  # type: ignore[return-value]

    def unproject(
        self, xy_distorted: Float[Tensor, "*batch n 2"]
    ) -> tuple[Float[Tensor, "*out n 3"], Bool[Tensor, "*out n"]]:
        """The directions that arrive at distorted points: the exact inverse of `project_direction`.

        Derivatives are those of the inverse function, to second order, in points and coefficients, in reverse and in
        forward mode.

        Args:
            xy_distorted: `(*B, N, 2)` on the normalised plane.

        Returns:
            Unit vectors `(*B, N, 3)`, and `valid`: there is one inside the domain. (0, 0, 1) with zero gradient where
            not.
        """
        plan = self._plan()

        def backward(points: Tensor) -> tuple[Tensor, Tensor]:
            coefficients = self._usable(plan.domain)
            sigma, valid = _search(coefficients.detach(), plan, points.detach())
            x, y = torch.where(valid.unsqueeze(-1), points, 0).unbind(-1)
            rho_squared = x * x + y * y
            if derivative_wanted(points, self.coefficients):
                k = list(coefficients.unsqueeze(-2).unbind(-1))
                sigma = _newton(k, rho_squared, _newton(k, rho_squared, sigma))
            sine_over_angle, cosine = sine_over_angle_and_cosine(sigma * sigma * rho_squared)
            scale = sigma * sine_over_angle
            return torch.stack([x * scale, y * scale, cosine], dim=-1), valid

        return in_blocks(backward, self._checked("xy_distorted", xy_distorted, 2), self.coefficients)  # type: ignore[return-value]

    @staticmethod
    def _find_domain(coefficients: Tensor) -> Tensor:
        columns = list(coefficients.unsqueeze(-2).unbind(-1))
        grid = _angles(coefficients).expand(*coefficients.shape[:-1], ANGLES)
        angle, failed = first_failure(lambda theta, _: _slope(columns, theta * theta) > 0, grid)
        return torch.where(failed, angle, math.pi)

    @staticmethod
    def _tabulate(coefficients: Tensor, domain: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        usable = torch.where((domain > 0).unsqueeze(-1), coefficients, 0)
        columns = list(usable.unsqueeze(-2).unbind(-1))

        def rise(theta: Tensor) -> Tensor:
            return theta * _profile(columns, theta * theta)

        end = torch.where(domain > 0, domain, 1)
        table = inverse_table(rise, end, torch.zeros_like(coefficients[..., :2]))
        squares = (end.unsqueeze(-1) * _angles(coefficients) / math.pi) ** 2
        growth = _profile([column.abs() for column in columns], squares) / _profile(columns, squares)
        noise = growth.amax(-1).clamp(1, 64)
        return rise(end.unsqueeze(-1)).squeeze(-1), noise, table.rho_max, table.ratio


def _angles(like: Tensor) -> Tensor:
    return torch.linspace(0, math.pi, ANGLES + 1, dtype=like.dtype, device=like.device)[1:]


def _profile(k: list[Tensor], angle_squared: Tensor) -> Tensor:
    """`theta_d / theta`."""
    return 1 + angle_squared * polynomial(angle_squared, k)


def _slope(k: list[Tensor], angle_squared: Tensor) -> Tensor:
    """`d theta_d / d theta`."""
    odd = [(2 * n + 3) * column for n, column in enumerate(k)]
    return 1 + angle_squared * polynomial(angle_squared, odd)


def _size(direction: Tensor) -> Tensor:
    """The largest component, by which a direction may be divided: its length is nobody's concern, nor is a gradient."""
    size = direction.detach().abs().amax(-1, keepdim=True)
    return torch.where((size > 0) & (size < torch.inf), size, 1)


def _within(domain: Tensor, direction: Tensor) -> Tensor:
    """Whether directions lie in the domain and have a place in the image."""
    x, y, z = (direction / _size(direction)).unbind(-1)
    side = torch.hypot(x, y)
    within = torch.atan2(side, z) <= domain.unsqueeze(-1)
    return within & torch.isfinite(side + z) & ((side > 0) | (z > 0)) & (domain > 0).unsqueeze(-1)


def _newton(k: list[Tensor], rho_squared: Tensor, sigma: Tensor) -> Tensor:
    angle_squared = sigma * sigma * rho_squared
    return sigma - (sigma * _profile(k, angle_squared) - 1) / _slope(k, angle_squared)


@torch.no_grad()
def _search(coefficients: Tensor, plan: Plan, points: Tensor) -> tuple[Tensor, Tensor]:
    """`sigma` without a tape, 1 where there is none in the domain; and whether there is one."""
    k = list(coefficients.unsqueeze(-2).unbind(-1))
    x, y = coordinates(points)
    rho = torch.hypot(x, y)
    possible = (rho <= plan.reach.unsqueeze(-1)) & (plan.domain > 0).unsqueeze(-1)
    rho = torch.where(possible, rho, 0)
    rho_squared = rho * rho
    highest = _highest(plan.domain.unsqueeze(-1), rho)
    sigma = torch.minimum(InverseTable(plan.rho_max, plan.ratio).ratio_at(x, y, rho), highest)
    sigma = _bracketed(k, rho_squared, sigma, highest, STEPS)
    settled = _settled(k, plan.noise.unsqueeze(-1), rho_squared, sigma)
    batch = points.shape[:-2]
    lens = coefficients.expand(*batch, -1), plan.domain.expand(batch), plan.noise.expand(batch)
    again = _look_again if readable(points, coefficients) else _look_again_blindly
    sigma, found = again(*lens, rho, sigma, possible & ~settled)
    valid = possible & (settled | found) & (sigma * rho <= plan.domain.unsqueeze(-1))
    return torch.where(valid, sigma, 1), valid


def _highest(domain: Tensor, rho: Tensor) -> Tensor:
    """An upper bound of the ratio: the angle is at most the domain."""
    return torch.where(rho > 0, domain / rho, torch.inf).clamp_max(torch.finfo(rho.dtype).max)


def _settled(k: list[Tensor], noise: Tensor, rho_squared: Tensor, sigma: Tensor) -> Tensor:
    """Whether the equation holds up to rounding."""
    tolerance = TOLERANCE * torch.finfo(sigma.dtype).eps * noise
    return (sigma * _profile(k, sigma * sigma * rho_squared) - 1).abs() <= tolerance


def _look_again(
    coefficients: Tensor, domain: Tensor, noise: Tensor, rho: Tensor, sigma: Tensor, left: Tensor
) -> tuple[Tensor, Tensor]:
    """Solve what is left over, however long it takes, in float64.

    Args:
        coefficients: `(*B, 4)`.
        domain: `(*B,)`, the plan's.
        noise: the same.
        rho: `(*B, N)`, distorted radii.
        sigma: where the search has come so far.
        left: which points are left over.

    Returns:
        `sigma`, and which of those left over are solved now.
    """
    index = left.nonzero(as_tuple=True)
    if index[0].numel() == 0:
        return sigma, left
    columns = list(precise(coefficients[index[:-1]]).unbind(-1))
    reached, radius = precise(domain[index[:-1]]), precise(rho[index])
    highest = _highest(reached, radius)
    solution = _bracketed(columns, radius * radius, precise(sigma[index]).minimum(highest), highest, PATIENCE)
    sigma = sigma.index_put(index, solution.to(sigma.dtype).minimum(highest.to(sigma.dtype)))
    return sigma, left.index_put(index, _settled(columns, noise[index[:-1]], radius * radius, solution))


@torch.library.custom_op("diffproj::look_again_fisheye", mutates_args=())
def _look_again_blindly(
    coefficients: Tensor, domain: Tensor, noise: Tensor, rho: Tensor, sigma: Tensor, left: Tensor
) -> tuple[Tensor, Tensor]:
    """The same as one opaque operation, for graphs and transforms in which nobody sees whether any are left over."""
    solution, found = _look_again(coefficients, domain, noise, rho, sigma, left)
    return (sigma.clone(), left.clone()) if solution is sigma else (solution, found)


@_look_again_blindly.register_fake
def _look_again_shapes(
    coefficients: Tensor,  # noqa: ARG001
    domain: Tensor,  # noqa: ARG001
    noise: Tensor,  # noqa: ARG001
    rho: Tensor,  # noqa: ARG001
    sigma: Tensor,
    left: Tensor,
) -> tuple[Tensor, Tensor]:
    return torch.empty_like(sigma), torch.empty_like(left)


@_look_again_blindly.register_vmap
def _look_again_batched(
    info: Any, in_dims: tuple[int | None, ...], *tensors: Tensor
) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
    return _look_again_blindly(*with_batch_in_front(info, in_dims, *tensors)), (0, 0)


def _bracketed(k: list[Tensor], rho_squared: Tensor, sigma: Tensor, high: Tensor, steps: int) -> Tensor:
    """Newton's method between a lower and an upper bound, halving where it would leave them."""
    low = torch.zeros_like(sigma)
    for _ in range(steps):
        angle_squared = sigma * sigma * rho_squared
        excess = sigma * _profile(k, angle_squared) - 1
        low, high = torch.where(excess <= 0, sigma, low), torch.where(excess >= 0, sigma, high)
        newton = sigma - excess / _slope(k, angle_squared)
        sigma = torch.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
    return sigma
