"""The equations of the Brown-Conrady lens with its rational, prism and tilt terms, and their Jacobian.

With `s = x^2 + y^2` a point `(x, y)` of the normalised plane goes to

    g  = (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)       radial, rational
    x' = x g + 2 p1 x y + p2 (s + 2 x^2) + s1 s + s2 s^2                    tangential, thin prism
    y' = y g + p1 (s + 2 y^2) + 2 p2 x y + s3 s + s4 s^2

and on a sensor tilted by `tau_x`, `tau_y` the point `(x', y')` goes on to `(X, Y) / W` with

    X = cos(tau_x) x'
    Y = cos(tau_y) y' - sin(tau_x) sin(tau_y) x'
    W = sin(tau_y) x' - cos(tau_y) sin(tau_x) y' + cos(tau_x) cos(tau_y)

The tangential terms are `2 (p1 y + p2 x) (x, y) + s (p2, p1)`, which is how they are computed.

Sources: Brown 1966 (radial, tangential); Claus and Fitzgibbon 2005 (rational); Weng, Cohen and Herniou 1992 (thin
prism); Louhichi, Fournel, Lavest and Ben Aissia 2007 (tilt). The order of the coefficients is OpenCV's.
"""

from collections.abc import Iterator
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffproj.lens.polynomial import minus_product, plus_product, polynomial

COUNTS = (4, 5, 8, 12, 14)
"""Numbers of coefficients that the model can have."""
UNTILTED = 12
"""Up to how many of them there is no tilt."""
Values = Any
"""A tensor; or, of a lens without tilt, an array of NumPy."""
Columns = tuple[Values, ...]


class Tilt(NamedTuple):
    """Cosines and sines of the two tilt angles, columns `(*B, 1)`."""

    cos_x: Tensor
    sin_x: Tensor
    cos_y: Tensor
    sin_y: Tensor

    def depth(self, x: Tensor, y: Tensor) -> Tensor:
        """`W`: positive for points in front of the tilted sensor's horizon."""
        return self.sin_y * x - self.cos_y * self.sin_x * y + self.cos_x * self.cos_y

    def clearance(self, x: Tensor, y: Tensor) -> Tensor:
        """`W` relative to the sum of its terms' magnitudes: close to 0 near the tilted sensor's horizon."""
        terms = self.sin_y * x, self.cos_y * self.sin_x * y, self.cos_x * self.cos_y
        return self.depth(x, y) / sum(term.abs() for term in terms)

    def apply(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """`(X, Y) / W`."""
        depth = self.depth(x, y)
        return self.cos_x * x / depth, (self.cos_y * y - self.sin_x * self.sin_y * x) / depth

    def undo(self, x_tilted: Tensor, y_tilted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The inverse of `apply`: the point `(x', y')`, and `1 / W`, which must be positive."""
        x = x_tilted / self.cos_x
        y = (y_tilted + self.sin_x * self.sin_y * x) / self.cos_y
        inverse_depth = (1 - self.sin_y * x + self.cos_y * self.sin_x * y) / (self.cos_x * self.cos_y)
        return x / inverse_depth, y / inverse_depth, inverse_depth


class Terms(NamedTuple):
    """The coefficients grouped by term, as columns `(*B, 1)` that broadcast against points `(*B, N)`.

    Polynomials are in `s`, lowest power first. A "slope" is twice the derivative by `s`: times `x` it is that by `x`.

    Attributes:
        above, above_slope: `(numerator - 1) / s` of the radial factor; the slope of the numerator.
        below, below_slope: the same for the denominator; `None` without rational terms.
        one, two_p1, two_p2: constants.
        sideways_x, sideways_y: the part of fixed direction, divided by `s`: `p2 + s1 + s2 s` and `p1 + s3 + s4 s`.
        sideways_slope_x, sideways_slope_y: the slopes of `s` times that.
        tilt: `None` without tilt.
    """

    above: Columns
    above_slope: Columns
    below: Columns | None
    below_slope: Columns | None
    one: Values
    two_p1: Values
    two_p2: Values
    sideways_x: Columns
    sideways_y: Columns
    sideways_slope_x: Columns
    sideways_slope_y: Columns
    tilt: Tilt | None

    @classmethod
    def of(cls, coefficients: Values) -> "Terms":
        """Group coefficients `(*B, k)`."""
        if isinstance(coefficients, Tensor):
            k1, k2, p1, p2, *rest = coefficients.unsqueeze(-2).unbind(-1)
        else:
            k1, k2, p1, p2, *rest = (coefficients[..., i, None] for i in range(coefficients.shape[-1]))
        above = k1, k2, *rest[:1]
        below = tuple(rest[1:4])
        prism = rest[4:8]
        sideways_x, sideways_y = ((p2 + prism[0], prism[1]), (p1 + prism[2], prism[3])) if prism else ((p2,), (p1,))
        return cls(
            above,
            _slope(above),
            below or None,
            _slope(below) if below else None,
            _ones_like(k1),
            2 * p1,
            2 * p2,
            sideways_x,
            sideways_y,
            _slope(sideways_x),
            _slope(sideways_y),
            Tilt(rest[8].cos(), rest[8].sin(), rest[9].cos(), rest[9].sin()) if rest[8:] else None,
        )


def _ones_like(values: Values) -> Values:
    return torch.ones_like(values) if isinstance(values, Tensor) else np.ones_like(values)


def _slope(over_s: Columns) -> Columns:
    return tuple(2 * (power + 1) * column for power, column in enumerate(over_s))


class Jacobian(NamedTuple):
    """Derivatives of `(x', y')` by `(x, y)`: `xy` is that of `x'` by `y`."""

    xx: Values
    xy: Values
    yx: Values
    yy: Values


def denominator(terms: Terms, s: Values) -> Values:
    """Denominator of the radial factor `g`, at squared radii `s`."""
    return _ones_like(s) if terms.below is None else 1 + s * polynomial(s, terms.below)


def radial(terms: Terms, s: Values) -> Values:
    """The radial factor `g`, at squared radii `s`."""
    return 1 + s * _growth(terms, s)


def _growth(terms: Terms, s: Values) -> Values:
    """`(g - 1) / s`."""
    above = polynomial(s, terms.above)
    return above if terms.below is None else (above - polynomial(s, terms.below)) / denominator(terms, s)


def radial_slope(terms: Terms, s: Values, factor: Values) -> Values:
    """`2 dg/ds`, where `g` is `factor`."""
    slope = polynomial(s, terms.above_slope)
    if terms.below_slope is None:
        return slope
    return (slope - factor * polynomial(s, terms.below_slope)) / denominator(terms, s)


def term_growth(terms: Terms, s: Values) -> Values:
    """Sum of the magnitudes of the radial factor's terms over the factor: by this much rounding errors grow."""
    below = denominator(terms, s)
    growth = (1 + s * polynomial(s, [column.abs() for column in terms.above])) / (below * radial(terms, s))
    if terms.below is not None:
        growth = growth + (1 + s * polynomial(s, [column.abs() for column in terms.below])) / below
    return growth


def bend(terms: Terms, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """`(x', y')`: all distortion but the tilt."""
    s = plus_product(x * x, y, y)
    factor = plus_product(_tangential_factor(terms, x, y), s, _growth(terms, s))
    sideways_x, sideways_y = polynomial(s, terms.sideways_x), polynomial(s, terms.sideways_y)
    return plus_product(x * factor, s, sideways_x), plus_product(y * factor, s, sideways_y)


def residual(terms: Terms, target: tuple[Values, Values], x: Values, y: Values) -> tuple[Values, Values, Values]:
    """`target - (x', y')`, and `s`."""
    s = plus_product(x * x, y, y)
    factor = plus_product(_tangential_factor(terms, x, y), s, _growth(terms, s))
    off_x = minus_product(minus_product(target[0], x, factor), s, polynomial(s, terms.sideways_x))
    return off_x, minus_product(minus_product(target[1], y, factor), s, polynomial(s, terms.sideways_y)), s


def bend_off(terms: Terms, target: tuple[Values, Values], x: Values, y: Values) -> tuple[Values, Values, Jacobian]:
    """Residual `target - (x', y')` and Jacobian of `(x', y')`, in as few operations as possible."""
    s = plus_product(x * x, y, y)
    growth = _growth(terms, s)
    factor = plus_product(_tangential_factor(terms, x, y), s, growth)
    slope = radial_slope(terms, s, plus_product(terms.one, s, growth) if terms.below else factor)
    sideways_x, sideways_y = polynomial(s, terms.sideways_x), polynomial(s, terms.sideways_y)
    steep_x, steep_y = polynomial(s, terms.sideways_slope_x), polynomial(s, terms.sideways_slope_y)
    slope_x, slope_y = plus_product(terms.two_p2, x, slope), plus_product(terms.two_p1, y, slope)
    jacobian = Jacobian(
        plus_product(factor, x, slope_x + steep_x),
        plus_product(x * slope_y, y, steep_x),
        plus_product(y * slope_x, x, steep_y),
        plus_product(factor, y, slope_y + steep_y),
    )
    off_x = minus_product(minus_product(target[0], x, factor), s, sideways_x)
    off_y = minus_product(minus_product(target[1], y, factor), s, sideways_y)
    return off_x, off_y, jacobian


def newton_direction(
    terms: Terms, target: tuple[Values, Values], x: Values, y: Values
) -> tuple[Values, Values, Values, Values, Values]:
    """Residual at `(x, y)`, and the Newton step there as its two numerators and their common denominator."""
    off_x, off_y, slope = bend_off(terms, target, x, y)
    determinant = minus_product(slope.xx * slope.yy, slope.xy, slope.yx)
    step_x = minus_product(slope.yy * off_x, slope.xy, off_y)
    step_y = minus_product(slope.xx * off_y, slope.yx, off_x)
    return off_x, off_y, step_x, step_y, determinant


def _tangential_factor(terms: Terms, x: Values, y: Values) -> Values:
    """`1 + 2 (p1 y + p2 x)`."""
    return plus_product(x * terms.two_p2, y, terms.two_p1) + terms.one


class Tilted(NamedTuple):
    """The full model, tilt included, at a point.

    Attributes:
        x, y: the distorted point.
        jacobian: its derivatives, times the depth.
        depth: `W`, 1 without tilt.
    """

    x: Tensor
    y: Tensor
    jacobian: Jacobian
    depth: Tensor


def tilted(terms: Terms, x: Tensor, y: Tensor) -> Tilted:
    """Evaluate the full model, tilt included, with its derivatives."""
    zero = torch.zeros_like(x)
    x_off, y_off, bent = bend_off(terms, (zero, zero), x, y)
    tilt = terms.tilt
    if tilt is None:
        return Tilted(-x_off, -y_off, bent, torch.ones_like(x))
    depth = tilt.depth(-x_off, -y_off)
    x_tilted, y_tilted = tilt.apply(-x_off, -y_off)
    down = tilt.cos_y * tilt.sin_x
    xx, xy = tilt.cos_x - x_tilted * tilt.sin_y, x_tilted * down
    yx, yy = -tilt.sin_x * tilt.sin_y - y_tilted * tilt.sin_y, tilt.cos_y + y_tilted * down
    chained = Jacobian(
        xx * bent.xx + xy * bent.yx,
        xx * bent.xy + xy * bent.yy,
        yx * bent.xx + yy * bent.yx,
        yx * bent.xy + yy * bent.yy,
    )
    return Tilted(x_tilted, y_tilted, chained, depth)


def by_coefficients(terms: Terms, x: Tensor, y: Tensor, count: int) -> Tensor:
    """Derivatives of the distorted point by the first `count` coefficients `(*B, N, 2, count)`."""
    columns = list(islice(columns_by_coefficients(terms, x, y), count))
    if terms.tilt is not None:
        columns = _by_tilt(terms.tilt, *bend(terms, x, y), columns)
    return torch.stack([torch.stack(row, dim=-1) for row in zip(*columns, strict=True)], dim=-2)


def columns_by_coefficients(terms: Terms, x: Tensor, y: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Derivatives of `(x', y')`, before the tilt, by one of its coefficients after the other."""
    s = plus_product(x * x, y, y)
    below = denominator(terms, s)

    def by_power(power: int) -> tuple[Tensor, Tensor]:
        grows = s**power / below
        return x * grows, y * grows

    yield from (by_power(power) for power in (1, 2))
    yield 2 * x * y, s + 2 * y * y
    yield s + 2 * x * x, 2 * x * y
    yield by_power(3)
    factor = radial(terms, s)
    for power in (1, 2, 3):
        u, v = by_power(power)
        yield -factor * u, -factor * v
    zero = torch.zeros_like(x)
    yield from ((s, zero), (s * s, zero), (zero, s), (zero, s * s))


def _by_tilt(tilt: Tilt, x: Tensor, y: Tensor, columns: list[tuple[Tensor, Tensor]]) -> list[tuple[Tensor, Tensor]]:
    """Derivatives of the point `(x', y')` by other coefficients, as those of the tilted one; then its own by both."""
    x_tilted, y_tilted = tilt.apply(x, y)
    depth = tilt.depth(x, y)
    fall_x = -tilt.cos_y * (tilt.cos_x * y + tilt.sin_x)  # dW / dtau_x
    fall_y = tilt.cos_y * x + tilt.sin_y * (tilt.sin_x * y - tilt.cos_x)

    def onward(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        fall = tilt.sin_y * u - tilt.cos_y * tilt.sin_x * v
        sideways = tilt.cos_y * v - tilt.sin_x * tilt.sin_y * u
        return (tilt.cos_x * u - x_tilted * fall) / depth, (sideways - y_tilted * fall) / depth

    own = [
        ((-tilt.sin_x * x - x_tilted * fall_x) / depth, (-tilt.cos_x * tilt.sin_y * x - y_tilted * fall_x) / depth),
        (-x_tilted * fall_y / depth, (-tilt.sin_y * y - tilt.sin_x * tilt.cos_y * x - y_tilted * fall_y) / depth),
    ]
    return [onward(u, v) for u, v in columns] + own
