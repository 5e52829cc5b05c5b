"""Forward lens equations with their derivatives in closed form, written into the rows of a panel.

For the solver's inner loop: points in the camera frame are `(P, V, 3, N)`, with one lens and one pair of focal lengths
`f (P, 1, 2, 1)` for each of P problems. Each function writes the derivatives of `f` times the distorted point, by the
coefficients and by the point in the camera frame, to a `Place`, and returns the distorted point `(P, V, 2, N)` on the
normalised plane. The focal lengths are multiplied in where there are fewest numbers.

The lens's domain is not checked: intermediate lenses of the solver may have a fold within the image. The equations are
those of `diffproj.lens`; the tests compare the two.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.kannala_brandt import KannalaBrandt


@dataclass(eq=False)
class Place:
    """Where the derivatives are written to; the views of its parts are made once, for all steps of the solver.

    Attributes:
        by_coefficient: `(P, V, k, 2, N)`.
        by_point: `(P, V, 3, 2, N)`.
        rows: each of the coefficients' `(P, V, 2, N)`.
        by_axis: each of the point's `(P, V, 2, N)`.
        by_xy: of the point's, those by x and y `(P, V, 2, 2, N)`.
        straight: of these, that of the first component by x and of the second by y `(P, V, 2, N)`.
    """

    by_coefficient: Tensor
    by_point: Tensor
    rows: tuple[Tensor, ...] = field(init=False, repr=False)
    by_axis: tuple[Tensor, ...] = field(init=False, repr=False)
    by_xy: Tensor = field(init=False, repr=False)
    straight: Tensor = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.rows, self.by_axis = self.by_coefficient.unbind(2), self.by_point.unbind(2)
        self.by_xy = self.by_point[:, :, :2]
        self.straight = self.by_xy.diagonal(dim1=2, dim2=3).movedim(-1, 2)


def pinhole(coefficients: Tensor, f: Tensor, X_cam: Tensor, place: Place) -> Tensor:  # noqa: ARG001
    """No lens: `(x, y) / z`."""
    inverse_depth = X_cam[:, :, 2:].reciprocal()
    xy, scale = X_cam[:, :, :2] * inverse_depth, f * inverse_depth
    place.by_xy.zero_()
    place.straight.copy_(scale)
    torch.mul(xy, -scale, out=place.by_axis[2])
    return xy


def brown_conrady(coefficients: Tensor, f: Tensor, X_cam: Tensor, place: Place) -> Tensor:
    """Brown-Conrady with 4, 5, 8, 12 or 14 coefficients `(P, k)`; for the equations see `lens.brown_equations`.

    With few views the time is that of the calls, so that there are as few as will do: what is one number for a point
    is `(P, V, 1, N)` throughout.
    """
    count, rows, k = coefficients.shape[-1], place.rows, coefficients[..., None, None, None].unbind(1)
    inverse_depth = X_cam[:, :, 2:].reciprocal()
    xy = X_cam[:, :, :2] * inverse_depth
    x, y = xy.split(1, dim=2)
    s = torch.addcmul(x.square(), y, y)

    # The radial factor g and its slope by s; the decentring and the prism; the distorted point.
    g, slope = _one_plus(s, [k[0], k[1], *k[4:5]])
    inverse = None
    if count >= 8:
        below, below_slope = _one_plus(s, k[5:8])
        inverse = below.reciprocal_()
        g *= inverse
        slope.addcmul_(g, below_slope, value=-1)
        slope *= inverse
    tangential = coefficients[:, None, 2:4, None].flip(2)  # p2, p1
    toward = 2 * tangential
    factor = torch.addcmul(g, toward[:, :, :1], x).addcmul_(toward[:, :, 1:], y)
    sideways, steep = tangential, toward
    if count >= 12:
        prism = coefficients[:, None, 8:12, None]
        along, steeper = prism[:, :, 0::2], prism[:, :, 1::2]
        sideways = torch.addcmul(tangential + along, steeper, s)
        steep = torch.addcmul(2 * sideways, steeper, s, value=2)
    distorted = (xy * factor).addcmul_(s, sideways)
    turn = None
    if count == 14:
        distorted, turn = _tilt(coefficients[:, 12:], f, distorted, rows[12:])

    # Radial: rows k1, k2, k3 are x s, x s^2, x s^3 over the denominator; k4, k5, k6 those times -g.
    scaled = f * xy if turn is None else torch.addcmul(turn[0] * x, turn[1], y)
    torch.mul(scaled if inverse is None else scaled * inverse, s, out=rows[0])
    torch.mul(rows[0], s, out=rows[1])
    if count >= 5:
        torch.mul(rows[1], s, out=rows[4])
    if count >= 8:
        minus_g = -g
        for power, row in ((0, 5), (1, 6), (4, 7)):
            torch.mul(rows[power], minus_g, out=rows[row])

    # Tangential: p1 gives (2 x y, s + 2 y^2), p2 gives (s + 2 x^2, 2 x y). The prism gives s and s^2 to one of the two.
    twice = 2 * scaled
    for row, by, component in ((2, y, 1), (3, x, 0)):
        torch.mul(twice, by, out=rows[row])
        if turn is None:
            rows[row][:, :, component : component + 1].addcmul_(f[:, :, component : component + 1], s)
        else:
            rows[row].addcmul_(turn[component], s)
    if count >= 12:
        for row, component in ((8, 0), (10, 1)):
            if turn is None:
                torch.mul(s, f[:, :, component : component + 1], out=rows[row][:, :, component : component + 1])
                rows[row][:, :, 1 - component].zero_()
            else:
                torch.mul(turn[component], s, out=rows[row])
            torch.mul(rows[row], s, out=rows[row + 1])

    # d(x', y') = factor dxy + xy (2 g' xy + (2 p2, 2 p1)) . dxy + steep xy . dxy, as (P, V, by x and y, x' and y', N)
    near = f * inverse_depth if turn is None else inverse_depth
    torch.mul(torch.addcmul(toward, xy, slope, value=2).unsqueeze(3), (xy * near).unsqueeze(2), out=place.by_xy)
    place.by_xy.addcmul_(xy.unsqueeze(3), (steep * near).unsqueeze(2))
    place.straight.addcmul_(factor, near)
    if turn is not None:
        one, two = (column.unsqueeze(2) for column in turn)
        place.by_xy.copy_(torch.addcmul(one * place.by_xy[:, :, :, :1], two, place.by_xy[:, :, :, 1:]))
    by_x, by_y, by_z = place.by_axis
    torch.mul(by_x, -x, out=by_z)
    by_z.addcmul_(by_y, y, value=-1)
    return distorted


def fisheye(coefficients: Tensor, f: Tensor, X_cam: Tensor, place: Place) -> Tensor:
    """Kannala-Brandt with 4 coefficients `(P, 4)`; for the equations see `lens.kannala_brandt`."""
    k = [column[:, None, None] for column in coefficients.unbind(-1)]
    xy, z = X_cam[:, :, :2], X_cam[:, :, 2]
    side = torch.hypot(*xy.unbind(2))
    apart = side > 0
    safe = torch.where(apart, side, 1.0)
    unit = xy / safe.unsqueeze(2)
    length_squared = side.square() + z.square()
    theta = torch.atan2(side, z)
    square = theta.square()
    profile = _polynomial(square, k)
    slope = _polynomial(square, [odd * column for odd, column in zip((3, 5, 7, 9), k, strict=True)])
    theta_d = torch.addcmul(theta, profile * square, theta)
    slope = 1 + slope * square

    scaled, power = f * unit, theta
    for row in place.rows:
        power = power * square
        torch.mul(scaled, power.unsqueeze(2), out=row)
    # Tangential magnification theta_d / side, radial magnification from the slope.
    across = torch.where(apart, theta_d / safe, z.reciprocal())
    along = slope * z / length_squared
    torch.mul(scaled.unsqueeze(2), (unit * (along - across).unsqueeze(2)).unsqueeze(3), out=place.by_xy)
    place.straight.addcmul_(f, across.unsqueeze(2))
    torch.mul(scaled, (-side * slope / length_squared).unsqueeze(2), out=place.by_axis[2])
    return unit * theta_d.unsqueeze(2)


def _polynomial(s: Tensor, columns: list[Tensor]) -> Tensor:
    """`c_0 + c_1 s + ...` for at least two coefficients, by Horner's rule."""
    value = torch.addcmul(columns[-2], columns[-1], s)
    for column in reversed(columns[:-2]):
        value = torch.addcmul(column, value, s)
    return value


def _one_plus(s: Tensor, columns: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """`1 + c_0 s + c_1 s^2 + ...` for at least two coefficients, and its derivative by s, by Horner's rule."""
    value, slope = torch.addcmul(columns[-2], columns[-1], s), columns[-1]
    for column in reversed(columns[:-2]):
        value, slope = torch.addcmul(column, value, s), torch.addcmul(value, slope, s)
    return (value * s).add_(1.0), torch.addcmul(value, slope, s)


def _tilt(tau: Tensor, f: Tensor, xy: Tensor, rows: Sequence[Tensor]) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The point after the tilt `(P, V, 2, N)`, and f times its derivatives by x and by y before it, as much each.

    Those by the angles `(P, 2)` are written to their rows. The tilt is the homography `M (x, y, 1)`.
    """
    sine = tau.sin()
    (a, b), (c, d), (minus_c, minus_d) = (part.unbind(-1) for part in (tau.cos(), sine, -sine))  # of tau_x, of tau_y
    ab, cd, zero = a * b, c * d, torch.zeros_like(a)
    minus_ab, minus_ad, minus_bc, minus_cd = -ab, a * minus_d, b * minus_c, c * minus_d
    M = [a, zero, zero, minus_cd, b, zero, d, minus_bc, ab]
    by_tau_x = [minus_c, zero, zero, minus_ad, zero, zero, zero, minus_ab, minus_bc]
    by_tau_y = [zero, zero, zero, minus_bc, minus_d, zero, b, cd, minus_ad]
    M = torch.stack([*M, *by_tau_x, *by_tau_y], dim=-1).unflatten(-1, (1, 9, 3))
    points = M[..., :2] @ xy + M[..., 2:]
    X, X_by_x, X_by_y = points.unflatten(2, (3, 3)).unbind(2)
    inverse = X[:, :, 2:].reciprocal()
    tilted, scale = X[:, :, :2] * inverse, f * inverse
    for row, moved in zip(rows, (X_by_x, X_by_y), strict=True):
        torch.mul(torch.addcmul(moved[:, :, :2], tilted, moved[:, :, 2:], value=-1), scale, out=row)
    M = M[:, :, :3, :2].unsqueeze(-1)
    turn = torch.addcmul(M[:, :, :2], tilted.unsqueeze(3), M[:, :, 2:], value=-1).mul_(scale.unsqueeze(3))
    return tilted, turn.unbind(3)


DERIVATIVES = {None: pinhole, BrownConrady: brown_conrady, KannalaBrandt: fisheye}
"""The function for each class of lenses."""
