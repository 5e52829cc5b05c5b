"""The largest disc on which a Brown-Conrady lens is one-to-one.

A differentiable map of a convex set into the plane is one-to-one if the symmetric part of its Jacobian is positive
definite everywhere on the set: for two points `a`, `b` the derivative of `(b - a) . F(a + t (b - a))` by `t` is then
positive, so that `F(a) != F(b)`. The disc ends where this first fails, or shortly before a denominator reaches 0.

Without prism and tilt the worst direction is known in closed form. In polar coordinates, with `e = 2 r |(p1, p2)|` and
`c` the cosine of the angle between the point and `(p2, p1)`, the symmetric part is

    [[g + r dg/dr + 3 e c,  e sin],
     [e sin,                g + e c]]

and its determinant is a parabola in `c`. With prism or tilt the directions are sampled, finer with each round.
"""

import math

import torch
from torch import Tensor

from diffproj.lens.brown_equations import Jacobian, Terms, bend, denominator, radial, radial_slope, tilted_jacobian
from diffproj.lens.domain import first_failure, radius_grid
from diffproj.lens.polynomial import polynomial

TAME = 3.0
"""Tables end where the radial factor has grown to this."""
POLE = 2.0**-10
"""A denominator that has cancelled to this share of its terms counts as 0: beyond, rounding is multiplied by 1000."""
HORIZON = 0.125
"""The same for the depth behind a tilt, with more distance: next to the horizon the Jacobian turns within a degree."""
WIDEST = 8.0
"""Tables end here at the latest: 83 degrees from the axis."""
EDGE_POINTS = 360
SECTORS, RAYS = 8, 9
NARROWING = 2
"""By how much the sectors get narrower from round to round. The radii get 10 times closer: the worst ray, which moves
with the radius, cannot get lost."""
DEGREES = (2, 4, 1, 1, 6, 2, 4, 6, 1, 3, 1, 3)
"""The power of the radius that each coefficient up to the tilt is multiplied with, relative to the point."""


def length_scale(coefficients: Tensor) -> Tensor:
    """The radius at which the first of the terms has grown as large as the point itself; 1 where there is none."""
    powers = coefficients.new_tensor(DEGREES[: coefficients.shape[-1]])
    strength = coefficients[..., :12].abs() ** (1 / powers)
    if coefficients.shape[-1] > 12:
        strength = torch.cat([strength, coefficients[..., 12:].tan().abs()], dim=-1)
    strongest = strength.amax(-1)
    return torch.where(strongest == 0, 1, 1 / strongest).clamp_max(1e12)


def domain_radius(coefficients: Tensor) -> Tensor:
    """The radius of the disc `(*B,)` for coefficients `(*B, k)` in float64; 0 where they are not finite."""
    scale = length_scale(coefficients)
    grid = scale.unsqueeze(-1) * radius_grid(coefficients)
    if coefficients.shape[-1] <= 8:
        radius, failed = first_failure(_ClosedForm(coefficients), grid)
    else:
        radius, failed = first_failure(_Sampled(coefficients), grid, nodes=32, rounds=12)
    radius = torch.where(failed, radius, math.inf)
    return torch.where(radius > 1e-9 * scale, radius, 0)  # not NaN, and sound at the very centre


class _ClosedForm:
    """Whether the symmetric part is positive definite on whole circles, by its determinant in the worst direction."""

    def __init__(self, coefficients: Tensor):
        self.terms = Terms.of(coefficients)

    def __call__(self, radius: Tensor, _number: int) -> Tensor:
        s = radius * radius
        factor = radial(self.terms, s)
        along = factor + s * radial_slope(self.terms, s, factor)
        e = radius * torch.hypot(self.terms.two_p1, self.terms.two_p2)
        c = -((along + 3 * factor) / (8 * e)).clamp(0, 1).nan_to_num(1.0)
        determinant = along * factor - e * e + e * (along + 3 * factor) * c + (2 * e * c) ** 2
        return (along > 0) & (factor > 0) & (determinant > 0) & _off_pole(self.terms, s)


class _Sampled:
    """Smallest eigenvalues on rays from the centre: all around at first, then close to the worst ray of each sector.

    The worst ray is that on the last circle that was sound. The worst directions may come in pairs that are almost
    equally bad, hence the sectors.
    """

    def __init__(self, coefficients: Tensor):
        kind = {"dtype": coefficients.dtype, "device": coefficients.device}
        self.terms = Terms.of(coefficients.unsqueeze(-2))
        self.fan = torch.linspace(-math.pi / SECTORS, math.pi / SECTORS, RAYS, **kind)
        middle = torch.arange(SECTORS, **kind) * (2 * math.pi / SECTORS)
        self.towards = middle.expand(*coefficients.shape[:-1], SECTORS)

    def __call__(self, radius: Tensor, number: int) -> Tensor:
        angles = self.towards.unsqueeze(-1) + self.fan / NARROWING**number  # (*B, sectors, rays)
        eigenvalue = self._smallest_eigenvalue(radius.unsqueeze(-1), angles.flatten(-2).unsqueeze(-2))
        worst, ray = eigenvalue.unflatten(-1, (SECTORS, RAYS)).min(-1)  # (*B, M, sectors)
        good = (worst > 0).all(-1)
        last_good = ((~good).to(torch.uint8).argmax(-1) - 1).clamp_min(0)[..., None, None]
        ray = ray.gather(-2, last_good.expand(*good.shape[:-1], 1, SECTORS)).squeeze(-2)
        self.towards = angles.gather(-1, ray.unsqueeze(-1)).squeeze(-1)
        return good

    def _smallest_eigenvalue(self, radius: Tensor, angle: Tensor) -> Tensor:
        """That of the symmetric part, times something positive; negative where the lens has no value."""
        jacobian, depth = tilted_jacobian(self.terms, radius * angle.cos(), radius * angle.sin())
        eigenvalue = _smallest_eigenvalue(jacobian)
        eigenvalue = torch.where(depth > HORIZON, eigenvalue, depth - 2)
        sound = _off_pole(self.terms, radius * radius) & ~eigenvalue.isnan()
        return torch.where(sound, eigenvalue, -math.inf)


def _off_pole(terms: Terms, s: Tensor) -> Tensor:
    """Whether the denominator is positive by more than rounding could explain away."""
    below = denominator(terms, s)
    if terms.below is None:
        return below > 0
    return below > POLE * (1 + s * polynomial(s, [column.abs() for column in terms.below]))


def _smallest_eigenvalue(jacobian: Jacobian) -> Tensor:
    mean = (jacobian.xx + jacobian.yy) / 2
    return mean - torch.hypot((jacobian.xx - jacobian.yy) / 2, (jacobian.xy + jacobian.yx) / 2)


# ------------------------------------------------------------------------------------------------ what goes with it


def table_radius(terms: Terms, domain: Tensor) -> Tensor:
    """Where a table of the inverse should end: at the domain's edge, or where the radial factor gets wild."""
    fraction = torch.linspace(0, 1, 256, dtype=domain.dtype, device=domain.device)
    radius = domain.clamp_max(WIDEST).unsqueeze(-1) * fraction
    tame = radial(terms, radius * radius) <= TAME
    last_tame = tame.to(torch.uint8).cumprod(-1).sum(-1, keepdim=True) - 1
    return torch.where(domain > 0, radius.gather(-1, last_tame).squeeze(-1), 1)


def sway(terms: Terms, radius: Tensor) -> Tensor:
    """The parts of the distorted radius that go with the cosine and the sine of the direction, `(*B, 2)`."""
    s = (radius * radius).unsqueeze(-1)
    parts = [
        s * (tangential + polynomial(s, sideways))
        for tangential, sideways in ((terms.two_p2, terms.sideways_x), (terms.two_p1, terms.sideways_y))
    ]
    return torch.cat(parts, dim=-1)


def reach(terms: Terms, domain: Tensor) -> Tensor:
    """A radius that no point of the domain is distorted beyond (the tilt undone); infinite if the domain is.

    A one-to-one map takes the edge of the disc to the edge of its image. There the squared distorted radius is a
    trigonometric polynomial of degree 4, which is nowhere larger than `1 / cos(4 pi / n)` times the largest of its
    values in `n` equidistant directions (Ehlich and Zeller 1964): 1.0006 here.
    """
    angle = torch.arange(EDGE_POINTS, dtype=domain.dtype, device=domain.device) * (2 * math.pi / EDGE_POINTS)
    radius = torch.where(domain < math.inf, domain, 0).unsqueeze(-1)
    x, y = bend(terms, radius * angle.cos(), radius * angle.sin())
    return torch.where(domain < math.inf, 1.0004 * torch.hypot(x, y).amax(-1), math.inf)


def cancellation(terms: Terms, radius: Tensor) -> Tensor:
    """How much larger than the radial factor its terms get up to `radius`: the factor by which rounding grows."""
    s = (torch.linspace(0, 1, 64, dtype=radius.dtype, device=radius.device) * radius.unsqueeze(-1)) ** 2
    below = denominator(terms, s)
    growth = (1 + s * polynomial(s, [column.abs() for column in terms.above])) / (below * radial(terms, s))
    if terms.below is not None:
        growth = growth + (1 + s * polynomial(s, [column.abs() for column in terms.below])) / below
    return growth.amax(-1).nan_to_num(1.0).clamp(1, 64)
