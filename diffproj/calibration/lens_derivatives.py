"""Forward lens equations with their derivatives in closed form, written into the rows of a panel.

For the solver's inner loop: points in the camera frame are `(P, V, 3, N)`, with one lens for each of P problems. Each
function writes the derivatives of the distorted point by the coefficients and by the point in the camera frame into
the caller's tensors, `(P, V, k, 2, N)` and `(P, V, 3, 2, N)`, and returns the distorted point `(P, V, 2, N)` on the
normalised plane.

The lens's domain is not checked: intermediate lenses of the solver may have a fold within the image. The equations are
those of `diffproj.lens`; the tests compare the two.
"""

import torch
from torch import Tensor

from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.kannala_brandt import KannalaBrandt


def pinhole(coefficients: Tensor, X_cam: Tensor, by_coefficient: Tensor, by_point: Tensor) -> Tensor:  # noqa: ARG001
    """No lens: `(x, y) / z`."""
    inverse_depth = X_cam[:, :, 2].reciprocal()
    xy = X_cam[:, :, :2] * inverse_depth.unsqueeze(2)
    by_point.zero_()
    by_point[:, :, 0, 0] = inverse_depth
    by_point[:, :, 1, 1] = inverse_depth
    torch.mul(xy, -inverse_depth.unsqueeze(2), out=by_point[:, :, 2])
    return xy


def brown_conrady(coefficients: Tensor, X_cam: Tensor, by_coefficient: Tensor, by_point: Tensor) -> Tensor:
    """Brown-Conrady with 4, 5, 8, 12 or 14 coefficients `(P, k)`; for the equations see `lens.brown_equations`."""
    count = coefficients.shape[-1]
    k = [column[:, None, None] for column in coefficients.unbind(-1)]
    inverse_depth = X_cam[:, :, 2].reciprocal()
    xy = X_cam[:, :, :2] * inverse_depth.unsqueeze(2)
    x, y = xy.unbind(2)
    product, s = x * y, xy.square().sum(2)

    # Radial: rows k1, k2, k3 are x s, x s^2, x s^3 over the denominator; k4, k5, k6 those times -g.
    above = [k[0], k[1], *k[4:5]]
    growth, slope = _polynomial(s, above), _polynomial(s, [(power + 1) * a for power, a in enumerate(above)])
    g = torch.addcmul(torch.ones_like(s), growth, s)
    rows = by_coefficient
    s_row = s.unsqueeze(2)
    first = xy
    if count >= 8:
        below = k[5:8]
        inverse = torch.addcmul(torch.ones_like(s), _polynomial(s, below), s).reciprocal()
        below_slope = _polynomial(s, [(power + 1) * b for power, b in enumerate(below)])
        g = g * inverse
        slope = (slope - g * below_slope) * inverse
        first = xy * inverse.unsqueeze(2)
    torch.mul(first, s_row, out=rows[:, :, 0])
    torch.mul(rows[:, :, 0], s_row, out=rows[:, :, 1])
    if count >= 5:
        torch.mul(rows[:, :, 1], s_row, out=rows[:, :, 4])
    if count >= 8:
        minus_g = -g.unsqueeze(2)
        for power, row in ((0, 5), (1, 6), (4, 7)):
            torch.mul(rows[:, :, power], minus_g, out=rows[:, :, row])

    # Tangential: p1 gives (2 x y, s + 2 y^2), p2 gives (s + 2 x^2, 2 x y).
    twice = 2 * product
    rows[:, :, 2, 0] = twice
    torch.add(s, y.square(), alpha=2, out=rows[:, :, 2, 1])
    torch.add(s, x.square(), alpha=2, out=rows[:, :, 3, 0])
    rows[:, :, 3, 1] = twice
    p1, p2 = k[2], k[3]
    factor = g + 2 * (p1 * y + p2 * x)
    distorted = xy * factor.unsqueeze(2)
    sideways = torch.stack([p2, p1], dim=2)
    steep = 2 * sideways
    if count >= 12:
        prism = torch.stack([k[8], k[10]], dim=2), torch.stack([k[9], k[11]], dim=2)
        sideways = sideways + prism[0] + prism[1] * s_row
        steep = 2 * sideways + 2 * prism[1] * s_row
        for row, (component, power) in enumerate(((0, s), (0, s * s), (1, s), (1, s * s)), start=8):
            rows[:, :, row, component] = power
            rows[:, :, row, 1 - component] = 0.0
    distorted = torch.addcmul(distorted, s_row, sideways)

    # d(x', y') = factor dxy + xy (2 g' xy + (2 p2, 2 p1)) . dxy + steep xy . dxy, as (P, V, by x and y, x' and y', N)
    toward = torch.addcmul(2 * torch.stack([p2, p1], dim=2), xy, 2 * slope.unsqueeze(2))
    by_xy = torch.addcmul(toward.unsqueeze(3) * xy.unsqueeze(2), xy.unsqueeze(3), steep.unsqueeze(2))
    by_xy.diagonal(dim1=2, dim2=3).add_(factor.unsqueeze(-1))
    if count == 14:
        distorted, by_xy = _tilt(k[12], k[13], distorted, by_xy, rows)
    by_xy *= inverse_depth[:, :, None, None]
    by_point[:, :, :2] = by_xy
    torch.sum(by_xy * xy.unsqueeze(3), dim=2, out=by_point[:, :, 2])
    by_point[:, :, 2].neg_()
    return distorted


def fisheye(coefficients: Tensor, X_cam: Tensor, by_coefficient: Tensor, by_point: Tensor) -> Tensor:
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

    power = theta
    for row in range(4):
        power = power * square
        torch.mul(unit, power.unsqueeze(2), out=by_coefficient[:, :, row])
    # Tangential magnification theta_d / side, radial magnification from the slope.
    across = torch.where(apart, theta_d / safe, z.reciprocal())
    along = slope * z / length_squared
    torch.mul(unit, (unit[:, :, 0] * (along - across)).unsqueeze(2), out=by_point[:, :, 0])
    torch.mul(unit, (unit[:, :, 1] * (along - across)).unsqueeze(2), out=by_point[:, :, 1])
    by_point[:, :, 0, 0] += across
    by_point[:, :, 1, 1] += across
    torch.mul(unit, (-side * slope / length_squared).unsqueeze(2), out=by_point[:, :, 2])
    return unit * theta_d.unsqueeze(2)


def _polynomial(s: Tensor, columns: list[Tensor]) -> Tensor:
    """`c_0 + c_1 s + ...` for at least two coefficients, by Horner's rule."""
    value = torch.addcmul(columns[-2], columns[-1], s)
    for column in reversed(columns[:-2]):
        value = torch.addcmul(column, value, s)
    return value


def _tilt(tau_x: Tensor, tau_y: Tensor, xy: Tensor, by_xy: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Apply the tilt to the point, and by the chain rule to its derivatives `by_xy (P, V, 2, 2, N)` and `rows`."""
    x, y = xy.unbind(2)
    cos_x, sin_x, cos_y, sin_y = tau_x.cos(), tau_x.sin(), tau_y.cos(), tau_y.sin()
    inverse = (sin_y * x - cos_y * sin_x * y + cos_x * cos_y).reciprocal()
    X, Y = cos_x * x * inverse, (cos_y * y - sin_x * sin_y * x) * inverse
    one = [((cos_x - X * sin_y) * inverse).unsqueeze(2), (X * cos_y * sin_x * inverse).unsqueeze(2)]
    two = [(-(sin_x + Y) * sin_y * inverse).unsqueeze(2), ((1 + Y * sin_x) * cos_y * inverse).unsqueeze(2)]

    def onward(vectors: Tensor) -> Tensor:
        u, v = vectors.unbind(-2)
        return torch.stack([one[0] * u + one[1] * v, two[0] * u + two[1] * v], dim=-2)

    rows[:, :, :12] = onward(rows[:, :, :12])
    fall = -cos_y * (cos_x * y + sin_x)  # dW / dtau_x
    rows[:, :, 12, 0] = (-sin_x * x - X * fall) * inverse
    rows[:, :, 12, 1] = (-cos_x * sin_y * x - Y * fall) * inverse
    fall = cos_y * x + sin_y * (sin_x * y - cos_x)  # dW / dtau_y
    rows[:, :, 13, 0] = -X * fall * inverse
    rows[:, :, 13, 1] = (-sin_y * y - sin_x * cos_y * x - Y * fall) * inverse
    return torch.stack([X, Y], dim=2), onward(by_xy)


DERIVATIVES = {None: pinhole, BrownConrady: brown_conrady, KannalaBrandt: fisheye}
"""The function for each class of lenses."""
