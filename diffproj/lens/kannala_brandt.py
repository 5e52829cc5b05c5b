"""`KannalaBrandt`: the fisheye lens, with an exact inverse up to and beyond 90 degrees from the axis.

A direction `(x, y, z)` with the angle `theta` from the axis, and `side = |(x, y)|`, is projected to

    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
    xy_distorted = theta_d / side (x, y)

on the normalised plane, so that `rho = |xy_distorted|` is `theta_d`. The inverse solves for the ratio
`sigma = theta / rho`, which is a smooth function of the point at the centre, where `theta` itself is not:

    sigma (1 + k1 theta^2 + ... + k4 theta^8) = 1     with theta^2 = sigma^2 rho^2
    direction = (sigma sin(theta) / theta  xy_distorted, cos(theta))

Sources: Kannala and Brandt 2006 (the model); the order of the coefficients is that of OpenCV's fisheye module.
"""

import math
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.arguments import Array
from diffproj._core.numerics import has_values, in_blocks, in_float64, least_depth
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.compiling import coordinates, derivative_wanted, length_of, with_batch_in_front
from diffproj.lens.domain import first_failure
from diffproj.lens.plan import Plan
from diffproj.lens.polynomial import polynomial
from diffproj.lens.smooth import angle_over_side, angle_over_side_slopes, sine_over_angle_and_cosine
from diffproj.lens.table import InverseTable, inverse_table

NEWTON_STEPS = 4
"""Newton steps from the table's estimate to full precision, except for points next to a fold."""
MAX_STEPS = 60
"""Maximum number of steps for those."""
GRAPH_STEPS = 12
"""Steps in float64 in an exported graph, which holds the same steps for all points."""
GRID_ANGLES = 512
"""Angles of the coarse grid on which the end of the domain is searched."""
TOLERANCE = 16
"""Largest residual of a solution, in units of the equation's rounding error."""


class KannalaBrandt(CoefficientLens, tensors={"coefficients": 1}):
    """The equidistant fisheye with four coefficients, in the order of OpenCV's fisheye module.

    Directions are in the camera frame (x right, y down, z forward), distorted points on the normalised plane. Results
    are valid up to the angle `domain` from the axis, at most 180 degrees, within which the lens is one-to-one;
    elsewhere `valid` is false and the result is the axis.

    Args:
        coefficients: `(*B, 4)`, `k1 k2 k3 k4`, without unit; differentiable.

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
        """Half the field of view: the largest valid angle from the axis, `(*B,)`, in radians, without gradient.

        Up to it `theta_d` increases with `theta`; rounded down; at most pi.
        """
        return self._domain()

    def project_direction(
        self, direction: Float[Tensor, "*batch n 3"] | Array
    ) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """Project directions of the camera frame to distorted points on the normalised plane.

        Args:
            direction: `(*B, N, 3)`, of any length; `z` may be negative.

        Returns:
            Distorted points `(*B, N, 2)`, and `valid`: inside the domain, finite, not the zero vector, and not on the
            negative axis to within rounding. (0, 0) with zero gradient where not valid.
        """
        domain = self._domain()

        def forward(directions: Tensor) -> tuple[Tensor, Tensor]:
            valid = _within(domain, directions.detach())
            x, y, z = (directions / _largest_component(directions)).unbind(-1)
            x, y, z = torch.where(valid, x, 0), torch.where(valid, y, 0), torch.where(valid, z, 1)
            side_squared = x * x + y * y
            k = self._by_power()
            ratio = angle_over_side(side_squared, z)
            scale = ratio * _profile(k, ratio * ratio * side_squared)
            return torch.stack([x * scale, y * scale], dim=-1), valid

        return in_blocks(forward, self._checked("direction", direction, 3), self.coefficients)  # type: ignore[return-value]

    def unproject(
        self, xy_distorted: Float[Tensor, "*batch n 2"] | Array
    ) -> tuple[Float[Tensor, "*out n 3"], Bool[Tensor, "*out n"]]:
        """Directions whose projections are the distorted points: the exact inverse of `project_direction`.

        First and second derivatives by points and coefficients are those of the inverse function, in reverse and
        forward mode.

        Args:
            xy_distorted: `(*B, N, 2)` on the normalised plane.

        Returns:
            Unit vectors `(*B, N, 3)`, and `valid`: a solution inside the domain was found. (0, 0, 1) with zero gradient
            where not valid.
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

    def by_direction(self, direction: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*out n 2 3"]:
        """Derivatives of the distorted points by valid directions `(*B, N, 3)`: `(*B, N, 2, 3)`."""
        size = _largest_component(direction)
        x, y, z = (direction / size).unbind(-1)
        k = self._by_power()
        side_squared = x * x + y * y
        ratio = angle_over_side(side_squared, z)
        by_square, by_z = angle_over_side_slopes(side_squared, z, ratio)
        angle_squared = ratio * ratio * side_squared
        profile = _profile(k, angle_squared)
        rise = ratio * polynomial(angle_squared, [(n + 1) * column for n, column in enumerate(k)])
        # The distorted point is scale (x, y), with scale = ratio profile.
        scale = ratio * profile
        slope = 2 * (by_square * profile + rise * (2 * ratio * by_square * side_squared + ratio * ratio))
        fall = by_z * (profile + 2 * rise * ratio * side_squared)
        across = slope * x * y
        rows = [
            torch.stack([scale + slope * x * x, across, fall * x], dim=-1),
            torch.stack([across, scale + slope * y * y, fall * y], dim=-1),
        ]
        return torch.stack(rows, dim=-2) / size.unsqueeze(-1)

    def by_coefficients(self, direction: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*out n 2 4"]:
        """Derivatives of the distorted points of valid directions `(*B, N, 3)` by the coefficients `(*B, N, 2, 4)`."""
        x, y, z = (direction / _largest_component(direction)).unbind(-1)
        side_squared = x * x + y * y
        ratio = angle_over_side(side_squared, z)
        angle_squared = ratio * ratio * side_squared
        powers = torch.stack([angle_squared**n for n in range(1, 5)], dim=-1) * ratio.unsqueeze(-1)
        return torch.stack([x.unsqueeze(-1) * powers, y.unsqueeze(-1) * powers], dim=-2)

    def _by_power(self) -> list[Tensor]:
        return list(self._usable(self._domain()).unsqueeze(-2).unbind(-1))

    def turned(
        self,
        cosine: Float[Tensor, "*lens"],
        sine: Float[Tensor, "*lens"],  # noqa: ARG002
    ) -> tuple["KannalaBrandt", Bool[Tensor, "*lens"]]:
        """The lens turned about its axis, which is the same, and that there is one `(*lens,)`."""
        return self, torch.ones_like(cosine, dtype=torch.bool)

    @staticmethod
    def _find_domain(coefficients: Tensor) -> Tensor:
        columns = list(coefficients.unsqueeze(-2).unbind(-1))
        grid = _angles(coefficients).expand(*coefficients.shape[:-1], GRID_ANGLES)
        angle, failed = first_failure(lambda theta, _: _slope(columns, theta * theta) > 0, grid)
        return torch.where(failed, angle, math.pi)

    @staticmethod
    def _tabulate(coefficients: Tensor, domain: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        usable = torch.where((domain > 0).unsqueeze(-1), coefficients, 0)
        columns = list(usable.unsqueeze(-2).unbind(-1))

        def rise(theta: Tensor) -> Tensor:
            return theta * _profile(columns, theta * theta)

        end = torch.where(domain > 0, domain, 1)
        table = inverse_table(rise, end)
        squares = (end.unsqueeze(-1) * _angles(coefficients) / math.pi) ** 2
        growth = _profile([column.abs() for column in columns], squares) / _profile(columns, squares)
        noise = growth.amax(-1).clamp(1, 64)
        return rise(end.unsqueeze(-1)).squeeze(-1), noise, table.rho_max, table.ratio


def _angles(like: Tensor) -> Tensor:
    return torch.linspace(0, math.pi, GRID_ANGLES + 1, dtype=like.dtype, device=like.device)[1:]


def _profile(k: list[Tensor], angle_squared: Tensor) -> Tensor:
    """`theta_d / theta`."""
    return 1 + angle_squared * polynomial(angle_squared, k)


def _slope(k: list[Tensor], angle_squared: Tensor) -> Tensor:
    """`d theta_d / d theta`."""
    odd = [(2 * n + 3) * column for n, column in enumerate(k)]
    return 1 + angle_squared * polynomial(angle_squared, odd)


def _largest_component(direction: Tensor) -> Tensor:
    """Largest absolute component, without gradient, to normalise by; 1 if it is next to 0 or not finite."""
    size = direction.detach().abs().amax(-1, keepdim=True)
    return torch.where((size > least_depth(size.dtype)) & (size < torch.inf), size, 1)


def _within(domain: Tensor, direction: Tensor) -> Tensor:
    """Whether directions lie in the domain and have a unique projection: not 0, nor backwards to within rounding."""
    x, y, z = (direction / _largest_component(direction)).unbind(-1)
    side = length_of(x, y)
    within = torch.atan2(side, z) <= domain.unsqueeze(-1)
    eps = torch.finfo(side.dtype).eps
    aside = (side > eps) | (z > eps)
    return within & torch.isfinite(side + z) & aside & (domain > 0).unsqueeze(-1)


def _newton(k: list[Tensor], rho_squared: Tensor, sigma: Tensor) -> Tensor:
    angle_squared = sigma * sigma * rho_squared
    return sigma - (sigma * _profile(k, angle_squared) - 1) / _slope(k, angle_squared)


@torch.no_grad()
def _search(coefficients: Tensor, plan: Plan, points: Tensor) -> tuple[Tensor, Tensor]:
    """`sigma` without autograd, 1 where there is no solution in the domain; and whether there is one."""
    k = list(coefficients.unsqueeze(-2).unbind(-1))
    x, y = coordinates(points)
    rho = length_of(x, y)
    possible = (rho <= plan.reach.unsqueeze(-1)) & (plan.domain > 0).unsqueeze(-1)
    rho = torch.where(possible, rho, 0)
    rho_squared = rho * rho
    highest = _highest(plan.domain.unsqueeze(-1), rho)
    sigma = torch.minimum(InverseTable(plan.rho_max, plan.ratio).ratio_at(rho_squared), highest)
    sigma = _bracketed(k, rho_squared, sigma, highest, NEWTON_STEPS)
    settled = _settled(k, plan.noise.unsqueeze(-1), rho_squared, sigma)
    batch = points.shape[:-2]
    lens = coefficients.expand(*batch, -1), plan.domain.expand(batch), plan.noise.expand(batch)
    left = possible & ~settled
    if torch.compiler.is_exporting():
        sigma, found = _solved_in_graph(*lens, rho, sigma, left)
    else:
        again = _solve_remaining if has_values(points, coefficients) else _solve_remaining_op
        sigma, found = again(*lens, rho, sigma, left)
    valid = possible & (settled | found) & (sigma * rho <= plan.domain.unsqueeze(-1))
    return torch.where(valid, sigma, 1), valid


def _highest(domain: Tensor, rho: Tensor) -> Tensor:
    """Upper bound of `sigma`: the angle is at most the domain."""
    return torch.where(rho > 0, domain / rho, torch.inf).clamp_max(torch.finfo(rho.dtype).max)


def _settled(k: list[Tensor], noise: Tensor, rho_squared: Tensor, sigma: Tensor) -> Tensor:
    """Whether the equation holds up to rounding."""
    tolerance = TOLERANCE * torch.finfo(sigma.dtype).eps * noise
    return (sigma * _profile(k, sigma * sigma * rho_squared) - 1).abs() <= tolerance


def _solve_remaining(
    coefficients: Tensor, domain: Tensor, noise: Tensor, rho: Tensor, sigma: Tensor, left: Tensor
) -> tuple[Tensor, Tensor]:
    """Solve the points that have not converged, in float64, by at most `MAX_STEPS` bracketed Newton steps.

    Args:
        coefficients: `(*B, 4)`.
        domain: `(*B,)`, the plan's.
        noise: `(*B,)`, the plan's.
        rho: `(*B, N)`, distorted radii.
        sigma: `(*B, N)`, the current estimate.
        left: which points remain to be solved.

    Returns:
        `sigma`, and which of the remaining points are solved now.
    """
    index = left.nonzero(as_tuple=True)
    if index[0].numel() == 0:
        return sigma, left
    columns = list(in_float64(coefficients[index[:-1]]).unbind(-1))
    reached, radius = in_float64(domain[index[:-1]]), in_float64(rho[index])
    highest = _highest(reached, radius)
    solution = _bracketed(columns, radius * radius, in_float64(sigma[index]).minimum(highest), highest, MAX_STEPS)
    sigma = sigma.index_put(index, solution.to(sigma.dtype).minimum(highest.to(sigma.dtype)))
    return sigma, left.index_put(index, _settled(columns, noise[index[:-1]], radius * radius, solution))


def _solved_in_graph(
    coefficients: Tensor, domain: Tensor, noise: Tensor, rho: Tensor, sigma: Tensor, left: Tensor
) -> tuple[Tensor, Tensor]:
    """The same by `GRAPH_STEPS` steps for every point: plain operations that any runtime has."""
    columns = list(in_float64(coefficients).unsqueeze(-2).unbind(-1))
    radius = in_float64(rho)
    highest = _highest(in_float64(domain).unsqueeze(-1), radius)
    start = in_float64(sigma).nan_to_num(1.0).minimum(highest)
    solution = _bracketed(columns, radius * radius, start, highest, GRAPH_STEPS)
    solved = left & _settled(columns, in_float64(noise).unsqueeze(-1), radius * radius, solution)
    rounded = solution.to(sigma.dtype).minimum(highest.to(sigma.dtype))
    return torch.where(solved, rounded, sigma), solved


@torch.library.custom_op("diffproj::solve_remaining_kannala_brandt", mutates_args=())
def _solve_remaining_op(
    coefficients: Tensor, domain: Tensor, noise: Tensor, rho: Tensor, sigma: Tensor, left: Tensor
) -> tuple[Tensor, Tensor]:
    """`_solve_remaining` as one opaque operation, for graphs and transforms where `left` cannot be read."""
    solution, found = _solve_remaining(coefficients, domain, noise, rho, sigma, left)
    return (sigma.clone(), left.clone()) if solution is sigma else (solution, found)


@_solve_remaining_op.register_fake
def _solve_remaining_shapes(
    coefficients: Tensor,  # noqa: ARG001
    domain: Tensor,  # noqa: ARG001
    noise: Tensor,  # noqa: ARG001
    rho: Tensor,  # noqa: ARG001
    sigma: Tensor,
    left: Tensor,
) -> tuple[Tensor, Tensor]:
    return torch.empty_like(sigma), torch.empty_like(left)


@_solve_remaining_op.register_vmap
def _solve_remaining_batched(
    info: Any, in_dims: tuple[int | None, ...], *tensors: Tensor
) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
    return _solve_remaining_op(*with_batch_in_front(info, in_dims, *tensors)), (0, 0)


def _bracketed(k: list[Tensor], rho_squared: Tensor, sigma: Tensor, high: Tensor, steps: int) -> Tensor:
    """Newton's method between a lower and an upper bound, with bisection where a step would leave them."""
    low = torch.zeros_like(sigma)
    for _ in range(steps):
        angle_squared = sigma * sigma * rho_squared
        excess = sigma * _profile(k, angle_squared) - 1
        low, high = torch.where(excess <= 0, sigma, low), torch.where(excess >= 0, sigma, high)
        newton = sigma - excess / _slope(k, angle_squared)
        sigma = torch.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
    return sigma
