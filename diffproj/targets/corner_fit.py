"""Where four squares meet, to a hundredth of a pixel: a model of the blurred corner, fitted to the grey values."""

import functools
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int, Shaped
from torch import Tensor

SMALLEST, LARGEST = 3.5, 12.0
"""Limits in px of the radius of the disc whose pixels are fitted: fewer pixels say too little; farther ones see the
lens bend the edges."""

STEPS = 12
"""Most steps of the fit; three are usual."""

BLOCK = 60
"""Corners fitted at a time: as many as the processor's cache holds."""

BLUR, SHARPEST, BLURRIEST = 1.0, 0.3, 8.0
"""Standard deviation in px of the blur that the fit starts with, and its limits."""

CLOSE, CLOSE_BLUR = 0.04, 0.1
"""Steps in px of place and blur after which the fit has settled: the next would be some ten times smaller."""

MANY = 0.6
"""Share of corners that still move from which all of them do: less to be copied."""

FARTHEST = np.array([1.5, 1.5, 0.3, 0.3, 3.0])
"""Longest step of place in px, directions in radians, and blur in px."""

DAMPING = 1e-3
"""Share of their diagonal that is added to the equations of the edges."""

_EDGES, _CONTRAST, _LEVEL, _GREY = 5, 5, 6, 9
"""Rows of a corner's table: first the five derivatives of the model by the edges' place, directions and blur, but for a
factor; then what the contrast, the level and the two components of the light's gradient multiply; at last the grey
values. All of them times the root of each pixel's weight, which is what the level multiplies."""

_DAMPED = np.ones((10, 10)) + np.diag([DAMPING] * 5 + [0.0] * 5)
_RIDGE = 1e-6 * np.eye(10)
_ROOT_HALF = 0.5**0.5
_SLOPE = (2 / np.pi) ** 0.5
_LACKING = np.array([1.0, 1.0, 1.0, 1.0, -(2**0.5)])


class Fitted(NamedTuple):
    """Fitted corners.

    Attributes:
        corners: `(N, 2)` px.
        misfit: `(N,)`, root mean square of what the model leaves over, relative to half the step from dark to light.
        contrast: `(N,)`, half the step from dark to light; positive where the two edges' sides, both to the left or
            both to the right, are light.
        sigma: `(N,)` px, standard deviation of a coordinate as the grey values' scatter implies it.
        blur: `(N,)` px, standard deviation of the blur.
    """

    corners: Float[np.ndarray, "n 2"]
    misfit: Float[np.ndarray, " n"]
    contrast: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    blur: Float[np.ndarray, " n"]


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
    parts = [_fit_block(image, corners[k], angles[k], radius[k]) for k in blocks]
    return Fitted(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _fit_block(
    image: Shaped[np.ndarray, "h w"],
    corners: Float[np.ndarray, "n 2"],
    angles: Float[np.ndarray, "n 2"],
    radius: Float[np.ndarray, " n"],
) -> Fitted:
    """`fit_corners` by Gauss and Newton's method. A corner that has settled leaves the work.

    The grey values are linear in the light, and in the edges' step times the contrast: one solution gives both. Half of
    the pixels are enough for the first step.
    """
    table, places, base = _patches(image, corners, radius)
    edges = np.concatenate([corners - base, angles, np.full((len(corners), 1), BLUR)], axis=1)
    products = np.zeros((len(corners), _GREY + 1, _GREY + 1))
    solution, factor, moving = np.zeros((len(corners), _GREY)), np.ones(len(corners)), np.arange(len(corners))
    for step in range(STEPS):
        pixels = slice(0, len(places[0]) // 2 if step == 0 else None)
        if len(moving) > MANY * len(corners):
            moving = np.arange(len(corners))
            part = table[..., pixels]
            _fill(part, edges, places[:, pixels])
        else:
            part = table[torch.from_numpy(moving)]
            _fill(part, edges[moving], places)
            table[torch.from_numpy(moving)] = part
        products[moving] = (part @ part.mT).numpy()
        damped = products[moving] * _DAMPED + _RIDGE
        found = np.linalg.solve(damped[:, :_GREY, :_GREY], damped[:, :_GREY, _GREY:])[..., 0]
        blur, contrast = edges[moving, 4], found[:, _CONTRAST]
        factor[moving] = np.where(np.abs(contrast) > 1e-3, contrast, 1e-3) * (_SLOPE / blur)
        solution[moving] = found
        move = np.clip(found[:, :_EDGES] / (factor[moving, None] * _LACKING), -FARTHEST, FARTHEST)
        edges[moving] += move
        edges[moving, 4] = np.clip(edges[moving, 4], np.maximum(blur / 2, SHARPEST), np.minimum(blur * 2, BLURRIEST))
        # A start at the very place says nothing yet about the blur, which decides how well the model fits.
        going = (np.abs(move[:, :2]).max(axis=1) > CLOSE) | (np.abs(move[:, 4]) > CLOSE_BLUR)
        moving = moving[going] if step else moving
        if not len(moving):
            break
    misfit, sigma = _judged(table, products, solution, factor)
    moved = base + edges[:, :2]
    failed = ~np.isfinite(misfit) | ~(np.linalg.norm(moved - corners, axis=-1) <= 0.7 * radius)
    moved = np.where(failed[:, None], corners, moved)
    return Fitted(moved, np.where(failed, np.inf, misfit), solution[:, _CONTRAST], sigma, edges[:, 4])


def _judged(
    table: Float32[Tensor, "n 10 p"],
    products: Float64[np.ndarray, "n 10 10"],
    solution: Float64[np.ndarray, "n 9"],
    factor: Float64[np.ndarray, " n"],
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """How well the corners fit, relative to their contrast, and their standard deviation in px."""
    weight, model = table[:, _LEVEL], table[:, :_GREY]
    # What a corner's two coordinates take from each pixel: the first two rows of the inverse, times the model.
    normal = products[:, :_GREY, :_GREY] + _RIDGE[:_GREY, :_GREY]
    inverse = np.linalg.solve(normal, np.broadcast_to(np.eye(_GREY, 2), (len(normal), _GREY, 2))).swapaxes(1, 2)
    rows = torch.from_numpy(np.concatenate([inverse, solution[:, None]], axis=1).astype(np.float32)) @ model
    # With the last step, which was small, as the linear model sees it.
    error = (table[:, _GREY] - rows[:, 2]).norm(dim=-1).numpy().astype(np.float64)
    variance = error**2 / np.maximum(products[:, _LEVEL, _LEVEL], 1e-6)
    # The estimate weighs pixels by w, their noise is alike.
    spread = rows[:, :2].mul_(weight.unsqueeze(1)).norm(dim=(1, 2)).numpy().astype(np.float64)
    contrast = np.maximum(np.abs(solution[:, _CONTRAST]), 1e-3)
    sigma = np.sqrt(variance / 2) * spread / np.abs(factor)
    return np.sqrt(variance) / contrast, np.where(np.isfinite(sigma), sigma, np.inf)


def _patches(
    image: Shaped[np.ndarray, "h w"], corners: Float[np.ndarray, "n 2"], radius: Float[np.ndarray, " n"]
) -> tuple[Float32[Tensor, "n 10 p"], Float32[Tensor, "3 p"], Int[np.ndarray, "n 2"]]:
    """Tables whose rows for the edges are still empty, the places x, y, 1 of pixels, and the pixels they count from."""
    reach = int(np.ceil(radius.max()))
    x, y, places = _disc(reach)
    base = np.rint(corners).astype(int)
    height, width = image.shape
    offset = (corners - base).astype(np.float32)
    square = (places[0] - offset[:, :1]) ** 2
    square += (places[1] - offset[:, 1:]) ** 2
    square /= radius[:, None].astype(np.float32) ** 2
    within = square < 1
    if bool((base >= reach).all() and (base < np.array([width, height]) - reach).all()):
        grey = image.reshape(-1).take((base[:, :1] + width * base[:, 1:]) + (x + width * y)).astype(np.float32)
    else:
        u, v = base[:, :1] + x, base[:, 1:] + y
        within &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
        grey = image[v.clip(0, height - 1), u.clip(0, width - 1)].astype(np.float32)
    square *= -0.5
    weight = np.exp(square, out=square)
    weight *= within
    table = np.empty((len(corners), _GREY + 1, len(x)), np.float32)
    table[:, _LEVEL] = weight
    np.multiply(weight[:, None], places[:2], out=table[:, _LEVEL + 1 : _GREY])
    grey -= grey.mean(axis=1, keepdims=True)
    np.multiply(weight, grey, out=table[:, _GREY])
    return torch.from_numpy(table), torch.from_numpy(places), base


@functools.lru_cache(maxsize=32)
def _disc(radius: int) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"], Float32[np.ndarray, "3 p"]]:
    """Places x, y of a disc's pixels, and x, y, 1; the first half of them are the dark squares of a chessboard."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-radius, radius + 1), np.arange(-radius, radius + 1)))
    near = x * x + y * y <= (radius + 0.5) ** 2
    order = np.flatnonzero(near)
    order = order[np.argsort((x + y)[order] % 2, kind="stable")]
    x, y = x[order], y[order]
    return x, y, np.stack([x, y, np.ones(len(x))]).astype(np.float32)


def _fill(table: Float32[Tensor, "n 10 p"], edges: Float64[np.ndarray, "n 5"], places: Float32[Tensor, "3 p"]) -> None:
    """Write the rows of the table that depend on the edges; those of their derivatives lack a factor.

    The factor is the contrast times `sqrt(2 / pi)` over the blur, and for the blur that times the last of `_LACKING`.
    """
    cosine, sine = np.cos(edges[:, 2:4]), np.sin(edges[:, 2:4])
    lines = np.empty((len(edges), 4, 3))
    lines[:, :2, 0], lines[:, :2, 1], lines[:, 2:, 0], lines[:, 2:, 1] = -sine, cosine, -cosine, -sine
    lines[..., 2] = -(lines[..., :2] @ edges[:, :2, None])[..., 0]
    turns = torch.from_numpy(np.stack([sine, -cosine], axis=1).astype(np.float32))
    lines[:, :2] *= _ROOT_HALF / edges[:, 4, None, None]
    both = torch.from_numpy(lines.astype(np.float32)) @ places
    off, back = both[:, :2], both[:, 2:]
    off.clamp_(-5.5, 5.5)  # beyond, profiles are flat, and denormal numbers slow
    slope = off.square().neg_().exp_()
    first, second = torch.erf(off).unbind(1)
    weight, contrast, blur = table[:, _LEVEL], table[:, _CONTRAST], table[:, _EDGES - 1]
    torch.mul(first, second, out=contrast).mul_(weight)
    slope[:, 0].mul_(second.mul_(weight))
    slope[:, 1].mul_(first.mul_(weight))
    table[:, :2] = turns @ slope
    torch.mul(slope, back, out=table[:, 2:4])
    torch.add(*slope.mul_(off).unbind(1), out=blur)
