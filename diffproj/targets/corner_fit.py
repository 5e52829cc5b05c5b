"""Where four squares meet, to a hundredth of a pixel: a model of the blurred corner, fitted to the grey values."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

SMALLEST, LARGEST = 3.5, 12.0
"""Limits in px of the radius of the disc whose pixels are fitted: fewer pixels say too little; farther ones see the
lens bend the edges."""

STEPS = 12
"""Most steps of the fit."""

BLOCK = 60
"""Corners fitted at a time."""

CLOSE = 5e-3
"""Steps in px below which the fit has settled."""

_UNKNOWNS = 9
_ROOT_HALF = 0.5**0.5
_SLOPE = (2 / torch.pi) ** 0.5


class Fitted(NamedTuple):
    """Fitted corners.

    Attributes:
        corners: `(N, 2)` px.
        misfit: `(N,)`, root mean square of what the model leaves over, relative to half the step from dark to light.
        contrast: `(N,)`, half the step from dark to light; positive where the two edges' sides, both to the left or
            both to the right, are light.
        sigma: `(N,)` px, standard deviation of a coordinate as the grey values' scatter implies it.
    """

    corners: Float[np.ndarray, "n 2"]
    misfit: Float[np.ndarray, " n"]
    contrast: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]


def fit_corners(
    image: Shaped[np.ndarray, "h w"],
    corners: Float[np.ndarray, "n 2"],
    angles: Float[np.ndarray, "n 2"],
    spacing: Float[np.ndarray, " n"],
    reach: float,
) -> Fitted:
    """Fit each corner's neighbourhood by two straight edges that cross.

    The grey value is `a + b erf(d1 / (sqrt(2) s)) erf(d2 / (sqrt(2) s)) + g . x`, `d1` and `d2` the signed distances to
    the edges, `s` the blur and `g` a gradient of the light. All pixels of a disc count, those near its rim less. This
    is the maximum-likelihood estimate under equal noise, and by symmetry it has no bias where the edges are oblique.

    Args:
        image: `(H, W)`, uint8 or float32.
        corners: `(N, 2)` px, within a pixel or two of the truth.
        angles: `(N, 2)`, directions of the two edges in radians.
        spacing: `(N,)`, distance to the nearest neighbour in px.
        reach: radius of the disc relative to that distance.

    Returns:
        The corners. One whose fit fails stays where it was, with an infinite misfit.
    """
    radius = np.clip(reach * spacing, SMALLEST, LARGEST)
    blocks = [slice(k, k + BLOCK) for k in range(0, len(corners), BLOCK)]
    parts = [_fit_block(image, corners[k], angles[k], spacing[k], radius[k]) for k in blocks]
    return Fitted(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _fit_block(
    image: Shaped[np.ndarray, "h w"],
    corners: Float[np.ndarray, "n 2"],
    angles: Float[np.ndarray, "n 2"],
    spacing: Float[np.ndarray, " n"],
    radius: Float[np.ndarray, " n"],
) -> Fitted:
    """`fit_corners` for as many corners as the processor's cache holds, by Levenberg and Marquardt's method."""
    grey, weight, x, y, base = _patches(image, corners, radius)
    blur = (0.08 * spacing).clip(0.7, 3.0)[:, None]
    start = np.concatenate([corners - base, angles, np.zeros((len(corners), 4)), blur], axis=1)
    unknowns = torch.from_numpy(start.astype(np.float32))
    unknowns[:, 4:6] = _first_light(unknowns, grey, weight, x, y)
    damping = torch.full((len(corners), 1), 1e-3, dtype=unknowns.dtype, device="cpu")
    error, slopes = _residuals(unknowns, grey, x, y)
    cost = (weight * error * error).sum(-1)
    for _ in range(STEPS):
        weighted = slopes * weight.unsqueeze(1)
        normal, gradient = weighted @ slopes.mT, (weighted @ error.unsqueeze(-1)).squeeze(-1)
        damped = normal + torch.diag_embed(damping * normal.diagonal(dim1=-2, dim2=-1) + 1e-6)
        step = torch.linalg.solve_ex(damped.double(), gradient.double())[0].float().nan_to_num()
        proposed = unknowns + step
        proposed[:, 8].clamp_(0.3, 8.0)
        new_error, new_slopes = _residuals(proposed, grey, x, y)
        new_cost = (weight * new_error * new_error).sum(-1)
        better = new_cost < cost
        if bool(better.all()):
            unknowns, error, slopes, cost = proposed, new_error, new_slopes, new_cost
        else:
            unknowns = torch.where(better[:, None], proposed, unknowns)
            error = torch.where(better[:, None], new_error, error)
            slopes = torch.where(better[:, None, None], new_slopes, slopes)
            cost = torch.where(better, new_cost, cost)
        damping = torch.where(better[:, None], damping * 0.1, damping * 10).clamp(1e-7, 1e6)
        # A start at the very place says nothing yet about the blur, which decides how well the model fits.
        if bool((step[:, :2].abs().amax(-1) < CLOSE).all()) and bool((step[:, 8].abs() < 0.05).all()):
            break
    return _judged(unknowns, cost, slopes, weight, corners, base, radius)


def _patches(
    image: Shaped[np.ndarray, "h w"], corners: Float[np.ndarray, "n 2"], radius: Float[np.ndarray, " n"]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Int[np.ndarray, "n 2"]]:
    """Grey values, weights and places `(N, P)` around each corner, and the pixels `(N, 2)` that places count from."""
    side = int(np.ceil(radius.max()))
    place = np.arange(-side, side + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(place, place))
    near = x * x + y * y <= (side + 0.5) ** 2
    x, y = x[near], y[near]
    base = np.rint(corners).astype(int)
    u, v = base[:, :1] + x, base[:, 1:] + y
    height, width = image.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    grey = torch.from_numpy(image[v.clip(0, height - 1), u.clip(0, width - 1)].astype(np.float32))
    x, y = (torch.from_numpy(axis.astype(np.float32)).unsqueeze(0) for axis in (x, y))
    offset = torch.from_numpy(corners - base).to(torch.float32)
    square = (x - offset[:, :1]) ** 2 + (y - offset[:, 1:]) ** 2
    square /= torch.from_numpy(radius[:, None].astype(np.float32)) ** 2
    weight = torch.where(torch.from_numpy(inside) & (square < 1), torch.exp(-square), 0.0)
    return grey, weight, x, y, base


def _first_light(unknowns: Tensor, grey: Tensor, weight: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """The mean grey value and the signed contrast `(N, 2)` that suit the first edges."""
    total = weight.sum(-1, keepdim=True).clamp_min(1e-6)
    mean = (weight * grey).sum(-1, keepdim=True) / total
    first, second, *_ = _edges(unknowns, x, y)
    sign = first * second
    contrast = (weight * sign * (grey - mean)).sum(-1, keepdim=True)
    return torch.cat([mean, contrast / (weight * sign * sign).sum(-1, keepdim=True).clamp_min(1e-6)], dim=-1)


def _edges(unknowns: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    """Both edges' profiles from -1 to 1, distances to them, places along them, and the blur; each `(N, P)`."""
    u, v, first, second, *_, blur = unknowns.unsqueeze(-1).unbind(1)
    x, y = x - u, y - v
    parts = []
    for angle in (first, second):
        cosine, sine = angle.cos(), angle.sin()
        parts.append((cosine * y - sine * x, cosine * x + sine * y, cosine, sine))
    (d1, l1, c1, s1), (d2, l2, c2, s2) = parts
    return (
        torch.erf(d1 * (_ROOT_HALF / blur)),
        torch.erf(d2 * (_ROOT_HALF / blur)),
        d1,
        d2,
        l1,
        l2,
        c1,
        s1,
        c2,
        s2,
        x,
        y,
    )


def _residuals(unknowns: Tensor, grey: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Seen minus modelled grey values `(N, P)`, and the model's derivatives by its unknowns `(N, 9, P)`."""
    e1, e2, d1, d2, l1, l2, c1, s1, c2, s2, x, y = _edges(unknowns, x, y)
    *_, level, contrast, along_x, along_y, blur = unknowns.unsqueeze(-1).unbind(1)
    both = e1 * e2
    error = grey - (level + contrast * both + along_x * x + along_y * y)
    k = contrast * (_SLOPE / blur)
    # Bounded exponents: denormal numbers are slow.
    by_d1 = k * torch.exp((-0.5 * (d1 / blur) ** 2).clamp_min(-30.0)) * e2
    by_d2 = k * torch.exp((-0.5 * (d2 / blur) ** 2).clamp_min(-30.0)) * e1
    slopes = (
        by_d1 * s1 + by_d2 * s2 - along_x,
        -by_d1 * c1 - by_d2 * c2 - along_y,
        -by_d1 * l1,
        -by_d2 * l2,
        torch.ones_like(both),
        both,
        x,
        y,
        -(by_d1 * d1 + by_d2 * d2) / blur,
    )
    return error, torch.stack(slopes, dim=1)


def _judged(
    unknowns: Tensor,
    cost: Tensor,
    slopes: Tensor,
    weight: Tensor,
    corners: Float[np.ndarray, "n 2"],
    base: Int[np.ndarray, "n 2"],
    radius: Float[np.ndarray, " n"],
) -> Fitted:
    """The fitted corners in px, how well they fit, and how far they may be off."""
    moved = base + unknowns[:, :2].double().numpy()
    rms = (cost / weight.sum(-1).clamp_min(1e-6)).sqrt()
    contrast = unknowns[:, 5].abs()
    misfit = (rms / contrast.clamp_min(1e-3)).double().numpy()
    # The estimate weighs pixels by w, their noise is alike: its covariance is a sandwich.
    weighted = slopes * weight.unsqueeze(1)
    bread = torch.linalg.pinv((weighted @ slopes.mT).double(), hermitian=True)
    spread = bread @ (weighted @ weighted.mT).double() @ bread
    sigma = rms.double() * (spread[:, 0, 0] + spread[:, 1, 1]).clamp_min(0).mul(0.5).sqrt()
    failed = ~np.isfinite(moved).all(axis=-1)
    failed |= np.linalg.norm(np.nan_to_num(moved) - corners, axis=-1) > 0.7 * radius
    moved = np.where(failed[:, None], corners, moved)
    return Fitted(moved, np.where(failed, np.inf, misfit), unknowns[:, 5].double().numpy(), sigma.numpy())
