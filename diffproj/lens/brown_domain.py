"""The largest disc on which a Brown-Conrady lens is one-to-one.

A differentiable map of a convex set into the plane is one-to-one if the symmetric part of its Jacobian is positive
definite everywhere on the set: for two points `a`, `b` the derivative of `(b - a) . F(a + t (b - a))` by `t` is then
positive, so that `F(a) != F(b)`. The disc ends where this first fails, or shortly before a denominator reaches 0.

Without prism and tilt the worst direction is known in closed form. In polar coordinates, with `e = 2 r |(p1, p2)|` and
`c` the cosine of the angle between the point and `(p2, p1)`, the symmetric part is

    [[g + r dg/dr + 3 e c,  e sin],
     [e sin,                g + e c]]

and its determinant is a parabola in `c`. With prism or tilt it is a trigonometric polynomial,
whose smallest value is searched.
"""

import math

import torch
from torch import Tensor

from diffproj.lens.brown_equations import Terms, bend, denominator, radial, radial_slope, term_growth, tilted
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
DEGREE = 8
"""Of the determinant as a trigonometric polynomial, when it is multiplied by the fourth power of the depth."""
SAMPLES, COARSE, FINE = 20, 64, 256
"""In how many directions it is evaluated, and in how many it is then known: at first and later."""
POLISHING = 3
"""Newton steps from the fine grid's smallest value."""
LENSES = 8
"""Handled at once."""
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
    if coefficients.ndim > 1 and coefficients.shape[-1] > 8:  # in blocks that stay in the processor's cache
        blocks = coefficients.flatten(0, -2).split(LENSES)
        return torch.cat([_domain_radius(block) for block in blocks]).reshape(coefficients.shape[:-1])
    return _domain_radius(coefficients)


def _domain_radius(coefficients: Tensor) -> Tensor:
    scale = length_scale(coefficients)
    grid = scale.unsqueeze(-1) * radius_grid(coefficients)
    if coefficients.shape[-1] <= 8:
        radius, failed = first_failure(_ClosedForm(coefficients), grid)
    else:
        radius, failed = first_failure(_Circles(coefficients), grid, nodes=32, rounds=8)
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


class _Circles:
    """The same for lenses with prism or tilt, by the smallest value of the determinant on each circle.

    Times a power of the depth behind the tilt the determinant is, on a circle around the axis, a trigonometric
    polynomial of degree 8: a few of its values tell all others. Its smallest value on a fine grid, between whose nodes
    parabolas are laid, is improved by Newton's method.
    """

    def __init__(self, coefficients: Tensor):
        self.terms = Terms.of(coefficients.unsqueeze(-2))
        kind = {"dtype": coefficients.dtype, "device": coefficients.device}
        angle = torch.arange(SAMPLES, **kind) * (2 * math.pi / SAMPLES)
        self.cosine, self.sine = angle.cos(), angle.sin()
        self.orders = torch.arange(DEGREE + 1, **kind)
        weight = (2 - (self.orders == 0).to(angle)) / SAMPLES
        turned = angle.unsqueeze(-1) * self.orders
        self.analysis = torch.cat([turned.cos() * weight, turned.sin() * weight], dim=-1)  # values to a polynomial
        turned = self.orders.unsqueeze(-1) * (torch.arange(FINE, **kind) * (2 * math.pi / FINE))
        self.synthesis = torch.cat([turned.cos(), turned.sin()], dim=-2)  # a polynomial to values
        self.doubling = self.analysis @ self.synthesis[:, :: FINE // COARSE]

    def __call__(self, radius: Tensor, number: int) -> Tensor:
        radius = radius.unsqueeze(-1)  # (*B, M, 1)
        there = tilted(self.terms, radius * self.cosine, radius * self.sine)
        xx, xy, yx, yy = (part * there.depth for part in there.jacobian)
        trace, mixed = xx + yy, (xy + yx) / 2
        size = trace.abs().amax(-1, keepdim=True)
        determinant = (xx / size) * (yy / size) - (mixed / size) ** 2
        good = self._positive(determinant) if number else (determinant @ self.doubling > 0).all(-1)
        good &= (trace > 0).all(-1) & _off_pole(self.terms, radius * radius).all(-1)
        if self.terms.tilt is None:
            return good
        x, y = bend(self.terms, radius * self.cosine, radius * self.sine)
        x, y = (part @ self.doubling for part in (x, y))
        return good & (self.terms.tilt.clearance(x, y) > HORIZON).all(-1)

    def _positive(self, samples: Tensor) -> Tensor:
        """Whether trigonometric polynomials are positive all around."""
        waves = samples @ self.analysis
        values = waves @ self.synthesis
        before, after = values.roll(1, -1), values.roll(-1, -1)
        rise, bend_up = (after - before) / 2, after - 2 * values + before
        ahead = torch.where(bend_up > rise.abs(), -rise / bend_up, 0)
        index = (values + rise * ahead / 2).argmin(-1, keepdim=True)
        angle = (index + ahead.gather(-1, index)) * (2 * math.pi / FINE)
        cosines, sines = waves.split(DEGREE + 1, dim=-1)
        for _ in range(POLISHING):
            turned = angle * self.orders
            cosine, sine = turned.cos(), turned.sin()
            slope = (self.orders * (sines * cosine - cosines * sine)).sum(-1, keepdim=True)
            curvature = -(self.orders**2 * (cosines * cosine + sines * sine)).sum(-1, keepdim=True)
            angle = angle - torch.where(curvature > 0, slope / curvature, 0).clamp(-math.pi / FINE, math.pi / FINE)
        turned = angle * self.orders
        polished = (cosines * turned.cos() + sines * turned.sin()).sum(-1)
        return (polished > 0) & (values > 0).all(-1)


def _off_pole(terms: Terms, s: Tensor) -> Tensor:
    """Whether the denominator is positive by more than rounding could explain away."""
    below = denominator(terms, s)
    if terms.below is None:
        return below > 0
    return below > POLE * (1 + s * polynomial(s, [column.abs() for column in terms.below]))


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
    return term_growth(terms, s).amax(-1).nan_to_num(1.0).clamp(1, 64)
