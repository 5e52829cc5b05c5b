"""Forward lens equations with their derivatives in closed form, written into the rows of a panel.

For the solver's inner loop: points in the camera frame are `(P, V, 3, N)`, with one lens and one pair of focal lengths
`f (P, 1, 2, 1)` for each of P problems. Each function writes the derivatives of `f` times the distorted point, by the
coefficients and by the point in the camera frame, to a `Place`, and returns the distorted point `(P, V, 2, N)` on the
normalised plane. The focal lengths are multiplied in where there are fewest numbers.

The lens's domain is not checked: intermediate lenses of the solver may have a fold within the image. The equations are
those of `diffproj.lens`; the tests compare the two.
"""

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
    """Brown-Conrady with 4, 5, 8, 12 or 14 coefficients `(P, k)`; for the equations see `lens.brown_equations`."""
    count, rows, k = coefficients.shape[-1], place.rows, coefficients[..., None, None].unbind(1)
    tilted = count == 14
    scale = torch.ones_like(f) if tilted else f  # what follows a tilt multiplies the focal lengths in
    inverse_depth = X_cam[:, :, 2:].reciprocal()
    xy = X_cam[:, :, :2] * inverse_depth
    x, y = xy.unbind(2)
    s = torch.addcmul(x.square(), y, y)
    s_row, scaled, one = s.unsqueeze(2), scale * xy, torch.ones_like(s[:1, :1, :1])

    # Radial: rows k1, k2, k3 are x s, x s^2, x s^3 over the denominator; k4, k5, k6 those times -g. Slopes are doubled.
    above = [k[0], k[1], *k[4:5]]
    growth, slope = _polynomial(s, above), _polynomial(s, [2 * (power + 1) * a for power, a in enumerate(above)])
    g = torch.addcmul(one, growth, s)
    first = scaled
    if count >= 8:
        below = list(k[5:8])
        inverse = torch.addcmul(one, _polynomial(s, below), s).reciprocal_()
        below_slope = _polynomial(s, [2 * (power + 1) * b for power, b in enumerate(below)])
        g *= inverse
        slope.addcmul_(g, below_slope, value=-1)
        slope *= inverse
        first = scaled * inverse.unsqueeze(2)
    torch.mul(first, s_row, out=rows[0])
    torch.mul(rows[0], s_row, out=rows[1])
    if count >= 5:
        torch.mul(rows[1], s_row, out=rows[4])
    if count >= 8:
        minus_g = -g.unsqueeze(2)
        for power, row in ((0, 5), (1, 6), (4, 7)):
            torch.mul(rows[power], minus_g, out=rows[row])

    # Tangential: p1 gives (2 x y, s + 2 y^2), p2 gives (s + 2 x^2, 2 x y).
    twice = 2 * xy
    for row, by, component in ((2, 1, 1), (3, 0, 0)):
        torch.mul(scaled, twice[:, :, by : by + 1], out=rows[row])
        rows[row][:, :, component].addcmul_(scale[:, :, component], s)
    tangential = coefficients[:, None, 2:4, None].flip(2)  # p2, p1
    toward = 2 * tangential
    factor = torch.addcmul(g, toward[:, :, 0], x).addcmul_(toward[:, :, 1], y)
    sideways, steep = tangential, toward
    if count >= 12:
        prism = coefficients[:, None, 8:12, None]
        along, steeper = prism[:, :, 0::2], prism[:, :, 1::2]
        sideways = torch.addcmul(tangential + along, steeper, s_row)
        steep = torch.addcmul(2 * sideways, 2 * steeper, s_row)
        for row, (component, power) in enumerate(((0, s), (0, s * s), (1, s), (1, s * s)), start=8):
            torch.mul(power, scale[:, :, component], out=rows[row][:, :, component])
            rows[row][:, :, 1 - component].zero_()
    distorted = (xy * factor.unsqueeze(2)).addcmul_(s_row, sideways)

    # d(x', y') = factor dxy + xy (2 g' xy + (2 p2, 2 p1)) . dxy + steep xy . dxy, as (P, V, by x and y, x' and y', N)
    near = scale * inverse_depth
    torch.mul(torch.addcmul(toward, xy, slope.unsqueeze(2)).unsqueeze(3), (xy * near).unsqueeze(2), out=place.by_xy)
    place.by_xy.addcmul_(xy.unsqueeze(3), (steep * near).unsqueeze(2))
    place.straight.addcmul_(factor.unsqueeze(2), near)
    if tilted:
        distorted = _tilt(k[12], k[13], f, distorted, place)
    by_x, by_y, by_z = place.by_axis
    torch.mul(by_x, -x.unsqueeze(2), out=by_z)
    by_z.addcmul_(by_y, y.unsqueeze(2), value=-1)
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


def _tilt(tau_x: Tensor, tau_y: Tensor, f: Tensor, xy: Tensor, place: Place) -> Tensor:
    """Apply the tilt to the point, and by the chain rule, and times f, to its derivatives."""
    x, y = xy.unbind(2)
    cos_x, sin_x, cos_y, sin_y = tau_x.cos(), tau_x.sin(), tau_y.cos(), tau_y.sin()
    inverse = (sin_y * x - cos_y * sin_x * y + cos_x * cos_y).reciprocal()
    X, Y = cos_x * x * inverse, (cos_y * y - sin_x * sin_y * x) * inverse
    f_x, f_y = f.unbind(2)
    across, along = f_x * inverse, f_y * inverse
    one = ((cos_x - X * sin_y) * across).unsqueeze(2), (X * cos_y * sin_x * across).unsqueeze(2)
    two = (-(sin_x + Y) * sin_y * along).unsqueeze(2), ((1 + Y * sin_x) * cos_y * along).unsqueeze(2)
    for vectors in (place.by_coefficient[:, :, :12], place.by_xy):
        u, v = vectors.unbind(3)
        turned = (u * one[0]).addcmul_(v, one[1])
        v.mul_(two[1]).addcmul_(u, two[0])
        u.copy_(turned)
    rows = place.rows
    fall = -cos_y * (cos_x * y + sin_x)  # dW / dtau_x
    rows[12][:, :, 0] = (-sin_x * x - X * fall) * across
    rows[12][:, :, 1] = (-cos_x * sin_y * x - Y * fall) * along
    fall = cos_y * x + sin_y * (sin_x * y - cos_x)  # dW / dtau_y
    rows[13][:, :, 0] = -X * fall * across
    rows[13][:, :, 1] = (-sin_y * y - sin_x * cos_y * x - Y * fall) * along
    return torch.stack([X, Y], dim=2)


DERIVATIVES = {None: pinhole, BrownConrady: brown_conrady, KannalaBrandt: fisheye}
"""The function for each class of lenses."""
