"""The largest disc on which a Brown-Conrady lens is one-to-one.

A differentiable map of a convex set into the plane is one-to-one if the symmetric part of its Jacobian is positive
definite everywhere on the set: for two points `a`, `b` the derivative of `(b - a) . F(a + t (b - a))` by `t` is then
positive, so that `F(a) != F(b)`. The disc ends where this first fails, or shortly before a denominator reaches 0.

Without prism and tilt the direction of the smallest determinant on a circle is known in closed form. In polar
coordinates, with `e = 2 r |(p1, p2)|` and `c` the cosine of the angle between the point and `(p2, p1)`, the symmetric
part is

    [[g + r dg/dr + 3 e c,  e sin],
     [e sin,                g + e c]]

and its determinant is a quadratic polynomial in `c`. With prism or tilt the determinant on a circle is a trigonometric
polynomial, whose minimum is found numerically.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffproj._core.numerics import arrays_of, has_values
from diffproj._core.torch_private import in_forward_mode
from diffproj.lens.brown_equations import Terms, bend, denominator, radial, radial_slope, term_growth, tilted
from diffproj.lens.domain import first_failure, library_of, radius_grid
from diffproj.lens.polynomial import polynomial

MAX_TABLE_FACTOR = 3.0
"""The table of the inverse ends where the radial factor `g` exceeds this."""
MIN_DENOMINATOR = 2.0**-10
"""Least denominator, relative to the sum of its terms' magnitudes; below it rounding errors grow 1000-fold."""
MIN_CLEARANCE = 0.125
"""The same for the depth `W` of the tilt; larger, because near its horizon the Jacobian changes within a degree."""
MIN_FACING = 2.0**-10
"""Least `cos(tau_x) cos(tau_y)`: a sensor seen edge-on has no image, and close to it rounding errors grow 1000-fold."""
MAX_TABLE_RADIUS = 8.0
"""Largest radius of the table of the inverse: 83 degrees from the axis."""
EDGE_DIRECTIONS = 360
"""Directions in which the image of the domain's edge is sampled."""
DEGREE = 8
"""Degree of the trigonometric polynomial: the determinant times the fourth power of the depth."""
SAMPLES, COARSE_GRID, FINE_GRID = 20, 64, 256
"""Directions in which it is evaluated, and to which it is interpolated: in the first round and in later ones."""
LATER_GRIDS = {"nodes": 32, "rounds": 8}
"""How the search goes on where a circle takes that long."""
NEWTON_STEPS = 3
"""Newton steps that refine its minimum on the fine grid."""
CIRCLE = 64
"""Directions in which the image of a circle is looked at, where that takes no table."""
BLOCK_LENSES = 8
"""Lenses with prism or tilt per block: intermediate results stay in the processor's cache."""
RADIUS_POWERS = (2, 4, 1, 1, 6, 2, 4, 6, 1, 3, 1, 3)
"""Power of the radius in each coefficient's term, relative to the point; for all coefficients but the tilt."""


def length_scale(coefficients: Any) -> Any:
    """Smallest radius at which one term is as large as the point itself, `(*B,)`; 1 if all coefficients are 0."""
    library, size = library_of(coefficients), abs(coefficients)
    strength = size[..., :12] ** (1 / _powers(coefficients))
    if coefficients.shape[-1] > 12:
        strength = library.concatenate((strength, library.tan(size[..., 12:])), -1)
    strongest = library.amax(strength, -1)
    return library.where(strongest == 0, 1.0, 1 / strongest).clip(None, 1e12)


def last_crossing(coefficients: Any) -> Any:
    """Radius beyond which the term of highest order dominates all others, `(*B,)`; 0 if there is one term or none."""
    library, powers = library_of(coefficients), _powers(coefficients)
    size = library.log(abs(coefficients[..., : len(powers)]))
    steps = powers[:, None] - powers  # from the power of the second term to that of the first
    crossing = (size[..., None, :] - size[..., :, None]) / steps.clip(1)
    latest = library.amax(library.where((steps > 0) & library.isfinite(crossing), crossing, -math.inf), (-2, -1))
    return library.exp(latest).clip(None, 1e12)


def _powers(coefficients: Any) -> Any:
    powers = RADIUS_POWERS[: coefficients.shape[-1]]
    return coefficients.new_tensor(powers) if isinstance(coefficients, Tensor) else np.array(powers, dtype=np.float64)


def domain_radius(coefficients: Tensor) -> Tensor:
    """Radius of the disc `(*B,)` for coefficients `(*B, k)` in float64; 0 where they are not finite."""
    if coefficients.shape[-1] <= 8:
        plain = has_values(coefficients) and not in_forward_mode()
        library, (values,) = arrays_of(coefficients) if plain else (torch, (coefficients,))
        with np.errstate(all="ignore"):
            scale, grid = _first_grid(values)
            found = _radius(scale, *first_failure(_ClosedForm(values), grid))
        return torch.as_tensor(found, dtype=coefficients.dtype, device=coefficients.device) if library is np else found
    if coefficients.ndim > 1:
        blocks = coefficients.flatten(0, -2).split(BLOCK_LENSES)
        return torch.cat([_by_circles(block) for block in blocks]).reshape(coefficients.shape[:-1])
    return _by_circles(coefficients)


def _by_circles(coefficients: Tensor) -> Tensor:
    scale, grid = _first_grid(coefficients)
    return _radius(scale, *first_failure(_Circles(coefficients), grid, **LATER_GRIDS))


def _first_grid(coefficients: Any) -> tuple[Any, Any]:
    """The length scale `(*B,)`, and the radii at which the search begins `(*B, M)`."""
    scale = length_scale(coefficients)
    return scale, radius_grid(scale, 10 * last_crossing(coefficients))


def _radius(scale: Any, radius: Any, failed: Any) -> Any:
    """Infinite where nothing failed; 0 for NaN, and where it fails at the centre."""
    library = library_of(radius)
    radius = library.where(failed, radius, math.inf)
    return library.where(radius > 1e-9 * scale, radius, 0.0)


def domain_reaches(coefficients: Tensor, radius: Tensor) -> Tensor:
    """Whether the domains of lenses `(P, k)` in float64 reach radii `(P,)`: no for NaN.

    The search for the domain, on no more of its first grid than is needed, and only until that is decided: far inside
    of it in an eighth of the time with prism or tilt, in a third without.
    """
    closed = coefficients.shape[-1] <= 8
    if not closed and len(coefficients) > BLOCK_LENSES:
        blocks = coefficients.split(BLOCK_LENSES), radius.split(BLOCK_LENSES)
        return torch.cat([domain_reaches(*block) for block in zip(*blocks, strict=True)])
    values, needed = arrays_of(coefficients, radius)[1] if closed else (coefficients, radius)
    with np.errstate(all="ignore"):
        scale, grid = _first_grid(values)
        nodes = int((grid < needed[..., None]).sum(-1).max()) + 4
        holds, later = (_ClosedForm(values), {}) if closed else (_Circles(values), LATER_GRIDS)
        found = _radius(scale, *first_failure(holds, grid[..., :nodes], **later, needed=needed))
    return torch.as_tensor(found >= needed, device=radius.device)


def surely_encloses(coefficients: Tensor, radius: Tensor, distance: Tensor) -> Tensor:
    """Whether the images of circles of radius `(P,)` about the axes of lenses `(P, k)` lie beyond distances `(P,)`.

    That is where `X^2 + Y^2 > distance^2 W^2`, or 1 for `W` without tilt: the difference of the two is a trigonometric
    polynomial of degree 4. Between n equidistant directions it is lower by at most `8 (pi / n)^2` times its largest
    size (Bernstein), which is `1 / cos(4 pi / n)` times that in those directions at most (Ehlich and Zeller 1964).
    False says nothing.
    """
    terms = Terms.of(coefficients)
    angle = torch.arange(CIRCLE, dtype=radius.dtype, device=radius.device) * (2 * math.pi / CIRCLE)
    x, y = bend(terms, radius.unsqueeze(-1) * angle.cos(), radius.unsqueeze(-1) * angle.sin())
    depth = torch.ones_like(x) if (tilt := terms.tilt) is None else tilt.depth(x, y)
    if tilt is not None:
        x, y = tilt.cos_x * x, tilt.cos_y * y - tilt.sin_x * tilt.sin_y * x
    beyond = x.square() + y.square() - (distance.unsqueeze(-1) * depth).square()
    lower = 8 * (math.pi / CIRCLE) ** 2 / math.cos(4 * math.pi / CIRCLE)
    return beyond.amin(-1) > lower * beyond.abs().amax(-1)


class _ClosedForm:
    """Whether the symmetric part is positive definite on whole circles: closed form, for lenses of 4, 5 or 8."""

    def __init__(self, coefficients: Any):
        self.library, self.terms = library_of(coefficients), Terms.of(coefficients)
        self.slant = self.library.hypot(self.terms.two_p1, self.terms.two_p2)

    def __call__(self, radius: Any, _number: int) -> Any:
        s = radius * radius
        factor = radial(self.terms, s)
        along = factor + s * radial_slope(self.terms, s, factor)
        e = radius * self.slant
        total = along + 3 * factor
        c = (total / (-8 * e)).clip(-1, 0)
        c = self.library.where(self.library.isnan(c), -1.0, c)
        determinant = along * factor - e * e + e * total * c + (2 * e * c) ** 2
        return (along > 0) & (factor > 0) & (determinant > 0) & _away_from_pole(self.terms, s)


class _Circles:
    """The same for lenses with prism or tilt, by the minimum of the determinant on each circle.

    Multiplied by a power of the depth of the tilt, the determinant on a circle around the axis is a trigonometric
    polynomial of degree 8, which a few values determine. In the first round its sign is checked on a coarse grid; in
    later ones its minimum on a fine grid, interpolated by parabolas, is refined by Newton's method.
    """

    def __init__(self, coefficients: Tensor):
        self.terms = Terms.of(coefficients.unsqueeze(-2))
        kind = {"dtype": coefficients.dtype, "device": coefficients.device}
        angle = torch.arange(SAMPLES, **kind) * (2 * math.pi / SAMPLES)
        self.cosine, self.sine = angle.cos(), angle.sin()
        self.orders = torch.arange(DEGREE + 1, **kind)
        weight = (2 - (self.orders == 0).to(angle)) / SAMPLES
        turned = angle.unsqueeze(-1) * self.orders
        self.analysis = torch.cat([turned.cos() * weight, turned.sin() * weight], dim=-1)  # values to coefficients
        turned = self.orders.unsqueeze(-1) * (torch.arange(FINE_GRID, **kind) * (2 * math.pi / FINE_GRID))
        self.synthesis = torch.cat([turned.cos(), turned.sin()], dim=-2)  # coefficients to values
        self.doubling = self.analysis @ self.synthesis[:, :: FINE_GRID // COARSE_GRID]

    def __call__(self, radius: Tensor, number: int) -> Tensor:
        radius = radius.unsqueeze(-1)  # (*B, M, 1)
        there = tilted(self.terms, radius * self.cosine, radius * self.sine)
        xx, xy, yx, yy = (part * there.depth for part in there.jacobian)
        trace, mixed = xx + yy, (xy + yx) / 2
        size = trace.abs().amax(-1, keepdim=True)
        determinant = (xx / size) * (yy / size) - (mixed / size) ** 2
        good = self._positive(determinant) if number else (determinant @ self.doubling > 0).all(-1)
        good &= (trace > 0).all(-1) & _away_from_pole(self.terms, radius * radius).all(-1)
        tilt = self.terms.tilt
        if tilt is None:
            return good
        x, y = bend(self.terms, radius * self.cosine, radius * self.sine)
        x, y = (part @ self.doubling for part in (x, y))
        facing = (tilt.cos_x * tilt.cos_y).squeeze(-1) > MIN_FACING
        return good & facing & (tilt.clearance(x, y) > MIN_CLEARANCE).all(-1)

    def _positive(self, samples: Tensor) -> Tensor:
        """Whether trigonometric polynomials, given by their samples, are positive in all directions."""
        waves = samples @ self.analysis
        values = waves @ self.synthesis
        before, after = values.roll(1, -1), values.roll(-1, -1)
        rise, bend_up = (after - before) / 2, after - 2 * values + before
        ahead = torch.where(bend_up > rise.abs(), -rise / bend_up, 0)
        index = (values + rise * ahead / 2).argmin(-1, keepdim=True)
        angle = (index + ahead.gather(-1, index)) * (2 * math.pi / FINE_GRID)
        cosines, sines = waves.split(DEGREE + 1, dim=-1)
        for _ in range(NEWTON_STEPS):
            turned = angle * self.orders
            cosine, sine = turned.cos(), turned.sin()
            slope = (self.orders * (sines * cosine - cosines * sine)).sum(-1, keepdim=True)
            curvature = -(self.orders**2 * (cosines * cosine + sines * sine)).sum(-1, keepdim=True)
            angle = angle - torch.where(curvature > 0, slope / curvature, 0).clamp(
                -math.pi / FINE_GRID, math.pi / FINE_GRID
            )
        turned = angle * self.orders
        polished = (cosines * turned.cos() + sines * turned.sin()).sum(-1)
        return (polished > 0) & (values > 0).all(-1)


def _away_from_pole(terms: Terms, s: Any) -> Any:
    """Whether the denominator is positive by a safe margin: more than `MIN_DENOMINATOR` of its terms' magnitudes."""
    below = denominator(terms, s)
    if terms.below is None:
        return below > 0
    return below > MIN_DENOMINATOR * (1 + s * polynomial(s, [abs(column) for column in terms.below]))


# -------------------------------------------------------------------------------------- other parts of a lens's plan


def table_radius(terms: Terms, domain: Tensor) -> Tensor:
    """Radius at which the table of the inverse ends: the domain's, or less where a `MAX_TABLE_...` limit applies."""
    fraction = torch.linspace(0, 1, 256, dtype=domain.dtype, device=domain.device)
    radius = domain.clamp_max(MAX_TABLE_RADIUS).unsqueeze(-1) * fraction
    tabulated = radial(terms, radius * radius) <= MAX_TABLE_FACTOR
    last = tabulated.to(torch.uint8).cumprod(-1).sum(-1, keepdim=True) - 1
    return torch.where(domain > 0, radius.gather(-1, last).squeeze(-1), 1)


def reach(terms: Terms, domain: Tensor) -> Tensor:
    """Upper bound of the distorted radius over the domain (before the tilt), `(*B,)`; infinite if the domain is.

    A one-to-one map takes the edge of the disc to the edge of its image. There the squared distorted radius is a
    trigonometric polynomial of degree 4, whose maximum is at most `1 / cos(4 pi / n)` times the largest of its values
    in `n` equidistant directions (Ehlich and Zeller 1964): 1.0006 here, below the square of the factor used.
    """
    angle = torch.arange(EDGE_DIRECTIONS, dtype=domain.dtype, device=domain.device) * (2 * math.pi / EDGE_DIRECTIONS)
    radius = torch.where(domain < math.inf, domain, 0).unsqueeze(-1)
    x, y = bend(terms, radius * angle.cos(), radius * angle.sin())
    return torch.where(domain < math.inf, 1.0004 * torch.hypot(x, y).amax(-1), math.inf)


def cancellation(terms: Terms, radius: Tensor) -> Tensor:
    """Largest `term_growth` up to `radius`, `(*B,)`, from 1 to 64: the factor by which rounding errors grow."""
    s = (torch.linspace(0, 1, 64, dtype=radius.dtype, device=radius.device) * radius.unsqueeze(-1)) ** 2
    return term_growth(terms, s).amax(-1).nan_to_num(1.0).clamp(1, 64)
