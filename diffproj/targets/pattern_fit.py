"""Corners of a known print to a hundredth of a pixel: the print around each, blurred, fitted to the grey values.

Beside a board's corner lie markers, whose edges would draw aside an estimate that knows of two crossing edges alone.
Here the whole neighbourhood is known, so that it helps instead, and a corner of another number does not fit.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from diffproj.targets.artwork import Artwork
from diffproj.targets.corner_fit import Fitted

SMALLEST, LARGEST = 4.0, 12.0
"""Limits in px of the radius of the disc whose pixels are fitted."""

STEPS = 15
"""Most steps of the fit."""

BEYOND = 6.0
"""Distance in px from the disc up to which lines of the print matter: of large tags most do not."""

BLOCK = 40
"""Corners fitted at a time."""

HELD = 1e-3
"""How much relative changes of the map are held, relative to places in px."""

CLOSE = 3e-3
"""Steps in px below which the fit has settled."""

_ROOT_HALF = 0.5**0.5
_DENSITY = (2 * np.pi) ** -0.5
_FAR = 1e4


class Patches(NamedTuple):
    """The print around corners: lines relative to the corner in world units, and the cells between them.

    Attributes:
        x, y: `(N, k)`, `(N, m)`, lines; far away where there are fewer.
        dark: `(N, m + 1, k + 1)`, 1 for black, as steps from cell to cell: the first cell, those along x, those along
            y, and what both say together. The outer cells go on for ever.
    """

    x: Float[Tensor, "n k"]
    y: Float[Tensor, "n m"]
    dark: Float[Tensor, "n m1 k1"]

    def only(self, which: slice | Tensor) -> "Patches":
        """Some of them."""
        return Patches(self.x[which], self.y[which], self.dark[which])

    def within(self, reach: Float[Tensor, "n 2"]) -> "Patches":
        """The same with lines along x and y only up to those distances; beyond, the nearest cells go on for ever."""
        x, dark = _without_far(self.x, self.dark.mT, reach[:, :1])
        y, dark = _without_far(self.y, dark.mT, reach[:, 1:])
        return Patches(x, y, dark)


def _without_far(lines: Tensor, steps: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
    """Lines `(N, k)` up to a distance `(N, 1)`, and the steps `(N, k + 1, *)` at them; far ones are always passed."""
    near = lines.abs() < reach
    most = max(1, int(near.sum(-1).max()))
    passed = (~near & (lines < 0)).to(steps).unsqueeze(-1)
    first = steps[:, :1] + (passed * steps[:, 1:]).sum(1, keepdim=True)
    order = (~near).to(torch.uint8).argsort(dim=-1, stable=True)[:, :most]
    kept, there = lines.gather(1, order), near.gather(1, order)
    steps = steps[:, 1:].gather(1, order.unsqueeze(-1).expand(-1, -1, steps.shape[-1])) * there.unsqueeze(-1)
    return torch.where(there, kept, _FAR), torch.cat([first, steps], dim=1)


def patches_of(art: Artwork, corners: Float[np.ndarray, "n 2"], reach: float) -> Patches:
    """The print within a square around each corner."""
    padded = np.pad(art.dark, 1).astype(np.float32)
    cut = [
        [np.flatnonzero(np.abs(lines - place) < reach) for place in corners[:, axis]]
        for axis, lines in enumerate((art.x, art.y))
    ]
    k, m = (max(len(part) for part in parts) for parts in cut)
    n = len(corners)
    x, y = np.full((n, k), _FAR), np.full((n, m), _FAR)
    dark = np.zeros((n, m + 1, k + 1), dtype=np.float32)
    for i, (columns, rows) in enumerate(zip(*cut, strict=True)):
        x[i, : len(columns)] = (art.x[columns] - corners[i, 0]) / reach
        y[i, : len(rows)] = (art.y[rows] - corners[i, 1]) / reach
        c, r = (_cells(part) for part in (columns, rows))
        dark[i, : len(r), : len(c)] = padded[np.ix_(r, c)]
    x, y = (torch.from_numpy(lines * np.where(lines == _FAR, 1, reach)).float() for lines in (x, y))
    steps = np.diff(np.diff(dark, axis=1, prepend=0), axis=2, prepend=0).astype(np.float32)
    # Lines that are far away part nothing.
    steps[:, 1:][y.numpy() == _FAR] = 0
    steps[:, :, 1:] *= (x.numpy() != _FAR)[:, None]
    return Patches(x, y, torch.from_numpy(steps))


def _cells(lines: np.ndarray) -> np.ndarray:
    """The padded numbers of the cells that lines part: those before each, and the one after the last."""
    return np.append(lines, lines[-1] + 1) if len(lines) else np.zeros(1, dtype=int)


class _Part(NamedTuple):
    """Corners that have not settled."""

    patches: Patches
    grey: Tensor
    weight: Tensor

    def only(self, which: Tensor) -> "_Part":
        return _Part(self.patches.only(which), self.grey[which], self.weight[which])


def fit_patches(
    image: Shaped[np.ndarray, "h w"],
    corners: Float[np.ndarray, "n 2"],
    jacobians: Float[np.ndarray, "n 2 2"],
    patches: Patches,
    radius: Float[np.ndarray, " n"],
) -> Fitted:
    """Fit the print around each corner: its place, an affine map, the blur, black, white and a gradient of the light.

    Args:
        image: `(H, W)`, uint8 or float32.
        corners: `(N, 2)` px, to about a tenth of a square.
        jacobians: `(N, 2, 2)`, px along u and v for world units along x and y.
        patches: what is printed there.
        radius: `(N,)` px of the disc whose pixels are fitted.

    Returns:
        The corners; `contrast` is negative where black is darker than white, as it should be. One whose fit fails stays
        where it was, with an infinite misfit.
    """
    parts = [
        _fit_block(image, corners[k], jacobians[k], patches.only(k), radius[k])
        for k in (slice(first, first + BLOCK) for first in range(0, len(corners), BLOCK))
    ]
    return Fitted(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _fit_block(
    image: Shaped[np.ndarray, "h w"],
    corners: Float[np.ndarray, "n 2"],
    jacobians: Float[np.ndarray, "n 2 2"],
    patches: Patches,
    radius: Float[np.ndarray, " n"],
) -> Fitted:
    """`fit_patches` for some corners, by Levenberg and Marquardt's method."""
    base = np.rint(corners).astype(int)
    grey, weight, place = _pixels(image, base, corners - base, radius)
    inverse = np.linalg.inv(jacobians)
    per_px = torch.from_numpy(np.linalg.norm(inverse, axis=-1)).float()
    patches = patches.within(per_px * torch.from_numpy(radius + BEYOND).float().unsqueeze(-1))
    start = np.concatenate([corners - base, inverse.reshape(-1, 4), np.full((len(corners), 1), 0.8)], axis=1)
    shape = torch.from_numpy(start).float()
    light = _first_light(shape, patches, grey, weight, place)
    unknowns = torch.cat([shape, light], dim=1)
    solved = unknowns.clone()
    damping = torch.full((len(corners), 1), 1e-3, dtype=torch.float32, device="cpu")
    active = torch.arange(len(corners), device="cpu")
    part = _Part(patches, grey, weight)
    error, slopes = _residuals(unknowns, patches, grey, place)
    cost = (weight * error * error).sum(-1)
    every_cost, every_slope = cost.clone(), slopes.clone()
    for _ in range(STEPS):
        weighted = slopes * part.weight.unsqueeze(1)
        normal, gradient = (weighted @ slopes.mT).double(), (weighted @ error.unsqueeze(-1)).squeeze(-1).double()
        diagonal, known = normal.diagonal(dim1=-2, dim2=-1), _held(unknowns, normal)
        scale = (diagonal + known).clamp_min(1e-12).rsqrt()
        scaled = (normal + torch.diag_embed(known)) * scale.unsqueeze(-1) * scale.unsqueeze(-2)
        scaled = scaled + torch.diag_embed(damping.double().expand_as(scale))
        step = (torch.linalg.solve_ex(scaled, gradient * scale)[0] * scale).float().nan_to_num()
        proposed = unknowns + step
        proposed[:, 6].clamp_(0.3, 8.0)
        new_error, new_slopes = _residuals(proposed, part.patches, part.grey, place)
        new_cost = (part.weight * new_error * new_error).sum(-1)
        better = new_cost < cost
        unknowns = torch.where(better[:, None], proposed, unknowns)
        error = torch.where(better[:, None], new_error, error)
        slopes = torch.where(better[:, None, None], new_slopes, slopes)
        cost = torch.where(better, new_cost, cost)
        damping = torch.where(better[:, None], damping * 0.1, damping * 10).clamp(1e-7, 1e6)
        solved[active], every_cost[active], every_slope[active] = unknowns, cost, slopes
        going = (step[:, :2].abs().amax(-1) >= CLOSE) | (step[:, 6].abs() >= 0.05)
        if not bool(going.any()):
            break
        if float(going.float().mean()) < 0.7:
            active, unknowns, error, slopes = active[going], unknowns[going], error[going], slopes[going]
            cost, damping, part = cost[going], damping[going], part.only(going)
    return _judged(solved, every_cost, every_slope, weight, corners, base, radius)


def _held(unknowns: Tensor, normal: Tensor) -> Tensor:
    """What holds the map near its start `(N, 11)`: a trace of what holds the place.

    Where two lines alone are near, how far apart others are is not seen at all.
    """
    place = normal.diagonal(dim1=-2, dim2=-1)[:, :2].mean(-1, keepdim=True)
    square = unknowns[:, 2:6].double().reshape(-1, 2, 2).square().sum(-1).repeat_interleave(2, dim=1)
    held = torch.zeros_like(normal[..., 0])
    held[:, 2:6] = HELD * place / square.clamp_min(1e-30)
    return held


def _pixels(
    image: Shaped[np.ndarray, "h w"],
    base: Shaped[np.ndarray, "n 2"],
    offset: Float[np.ndarray, "n 2"],
    radius: Float[np.ndarray, " n"],
) -> tuple[Tensor, Tensor, Tensor]:
    """Grey values and weights `(N, P)` around each corner, and the pixels' places relative to `base` `(P, 2)`."""
    side = int(np.ceil(radius.max()))
    axis = np.arange(-side, side + 1)
    x, y = (part.ravel() for part in np.meshgrid(axis, axis))
    near = x * x + y * y <= (side + 0.5) ** 2
    x, y = x[near], y[near]
    u, v = base[:, :1] + x, base[:, 1:] + y
    height, width = image.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    grey = torch.from_numpy(image[v.clip(0, height - 1), u.clip(0, width - 1)].astype(np.float32))
    square = ((x - offset[:, :1]) ** 2 + (y - offset[:, 1:]) ** 2) / radius[:, None] ** 2
    weight = torch.from_numpy(np.where(inside & (square < 1), np.exp(-square), 0.0).astype(np.float32))
    return grey, weight, torch.from_numpy(np.stack([x, y], axis=-1).astype(np.float32))


def _first_light(shape: Tensor, patches: Patches, grey: Tensor, weight: Tensor, place: Tensor) -> Tensor:
    """White, the step to black, and no gradient `(N, 4)`, as they suit the print in its first place."""
    dark, *_ = _print(shape, patches, place)
    total = weight.sum(-1, keepdim=True).clamp_min(1e-6)
    mean, share = ((weight * part).sum(-1, keepdim=True) / total for part in (grey, dark))
    off = dark - share
    step = (weight * off * (grey - mean)).sum(-1, keepdim=True)
    step = step / (weight * off * off).sum(-1, keepdim=True).clamp_min(1e-3)
    return torch.cat([mean - step * share, step, torch.zeros_like(mean), torch.zeros_like(mean)], dim=-1)


def _print(shape: Tensor, patches: Patches, place: Tensor) -> tuple[Tensor, ...]:
    """The blurred print `(N, P)`, its derivatives by both distances, and those times the distances; and more."""
    offset = place.unsqueeze(0) - shape[:, None, :2]
    rows = shape[:, 2:6].reshape(-1, 2, 2)
    blur = shape[:, 6, None, None]
    parts = []
    for axis, lines in enumerate((patches.x, patches.y)):
        row = rows[:, axis]
        length = row.norm(dim=-1)[:, None, None]
        scaled = (((offset @ row.unsqueeze(-1)) - lines[:, None, :]) / (length * blur)).clamp(-8, 8)
        step = 0.5 + 0.5 * torch.erf(scaled * _ROOT_HALF)
        density = torch.exp(-0.5 * scaled * scaled) * (_DENSITY / blur)
        parts.append((step, density, density * scaled * blur, row, length.squeeze(-1)))
    (across, slope_x, moment_x, row_x, length_x), (down, slope_y, moment_y, row_y, length_y) = parts
    by_row = down @ patches.dark[:, 1:] + patches.dark[:, :1]
    dark = by_row[..., 0] + (by_row[..., 1:] * across).sum(-1)
    slope_x, moment_x = ((by_row[..., 1:] * part).sum(-1) for part in (slope_x, moment_x))
    by_slope, by_moment = (part @ patches.dark[:, 1:] for part in (slope_y, moment_y))
    slope_y, moment_y = (part[..., 0] + (part[..., 1:] * across).sum(-1) for part in (by_slope, by_moment))
    return dark, slope_x, slope_y, moment_x, moment_y, offset, row_x, row_y, length_x, length_y


def _residuals(unknowns: Tensor, patches: Patches, grey: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Seen minus modelled grey values `(N, P)`, and the model's derivatives by its unknowns `(N, 11, P)`."""
    dark, slope_x, slope_y, moment_x, moment_y, offset, row_x, row_y, length_x, length_y = _print(
        unknowns, patches, place
    )
    blur = unknowns[:, 6, None]
    white, step, along_u, along_v = unknowns[:, 7:, None].unbind(1)
    u, v = offset.unbind(-1)
    error = grey - (white + step * dark + along_u * u + along_v * v)
    slope_x, slope_y, moment_x, moment_y = (step * part for part in (slope_x, slope_y, moment_x, moment_y))
    x, y = row_x / length_x, row_y / length_y
    slopes = (
        -(x[:, :1] * slope_x + y[:, :1] * slope_y) - along_u,
        -(x[:, 1:] * slope_x + y[:, 1:] * slope_y) - along_v,
        (u * slope_x - x[:, :1] * moment_x) / length_x,
        (v * slope_x - x[:, 1:] * moment_x) / length_x,
        (u * slope_y - y[:, :1] * moment_y) / length_y,
        (v * slope_y - y[:, 1:] * moment_y) / length_y,
        -(moment_x + moment_y) / blur,
        torch.ones_like(dark),
        dark,
        u,
        v,
    )
    return error, torch.stack(slopes, dim=1)


def _judged(
    unknowns: Tensor,
    cost: Tensor,
    slopes: Tensor,
    weight: Tensor,
    corners: Float[np.ndarray, "n 2"],
    base: Shaped[np.ndarray, "n 2"],
    radius: Float[np.ndarray, " n"],
) -> Fitted:
    """The fitted corners in px, how well they fit, and how far they may be off."""
    moved = base + unknowns[:, :2].double().numpy()
    rms = (cost / weight.sum(-1).clamp_min(1e-6)).sqrt()
    half = 0.5 * unknowns[:, 8]
    misfit = (rms / half.abs().clamp_min(1e-3)).double().numpy()
    weighted = slopes * weight.unsqueeze(1)
    normal = (weighted @ slopes.mT).double()
    scale = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
    bread = torch.linalg.pinv(normal * scale.unsqueeze(-1) * scale.unsqueeze(-2), hermitian=True)
    bread = bread * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    spread = bread @ (weighted @ weighted.mT).double() @ bread
    sigma = rms.double() * (spread[:, 0, 0] + spread[:, 1, 1]).clamp_min(0).mul(0.5).sqrt()
    failed = ~np.isfinite(moved).all(axis=-1)
    failed |= np.linalg.norm(np.nan_to_num(moved) - corners, axis=-1) > 0.7 * radius
    moved = np.where(failed[:, None], corners, moved)
    misfit, contrast, blur = np.where(failed, np.inf, misfit), half.double().numpy(), unknowns[:, 6].double().numpy()
    return Fitted(moved, misfit, contrast, sigma.numpy(), blur)
