"""Dark discs in a photograph: candidates by their outlines, and their centres to a hundredth of a pixel."""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

SMALLEST = 2.0
"""Least semi-minor axis in px of a candidate."""

FLATTEST = 0.2
"""Least ratio of its axes."""

FAINTEST, BESIDE = 4.0, 2.0
"""Grey values by which a candidate must be darker inside than around it, and how far around, in px."""

STEPS = 12
"""Most steps of the fit."""

CLOSE = 3e-3
"""Steps in px below which the fit has settled."""

WIDE, FAR = 1.3, 3.0
"""How far beyond the ellipse pixels are fitted: relative to its size, and at least so many px."""

BRIGHTEST = 255.0
"""Grey value that a sensor does not exceed: glare is cut off there, and at 0 where the image is inverted."""

CUT_OFF = 0.03
"""How much the model counts where it exceeds what is cut off: nothing else would hold it where all pixels are."""

SHADE, SHADE_SPREAD, SCATTER = -0.5, 0.5, 0.03
"""By how much weaker light's gradient is expected in the dark, relative to that around it, give or take: a shadow is
weaker there as all light is (-0.9), and glare is not (0). Where the light is even, nothing else tells. The grey values'
scatter that this is weighed against, relative to half the step from dark to light."""

_ANGLES = np.arange(16) * (2 * np.pi / 16)


class Ellipses(NamedTuple):
    """Ellipses in an image.

    Attributes:
        centres: `(N, 2)` px.
        axes: `(N, 2, 2)`, symmetric: the matrix that takes offsets from the centre, in px, to the unit disc.
    """

    centres: Float[np.ndarray, "n 2"]
    axes: Float[np.ndarray, "n 2 2"]

    def only(self, which: Shaped[np.ndarray, " k"]) -> "Ellipses":
        """Some of them."""
        return Ellipses(self.centres[which], self.axes[which])


class FittedEllipses(NamedTuple):
    """Fitted ellipses.

    Attributes:
        ellipses: in px.
        misfit: `(N,)`, root mean square of what the model leaves over, relative to half the step from dark to light.
        contrast: `(N,)`, half the step from light to dark; positive for dark ellipses.
        sigma: `(N,)` px, standard deviation of a coordinate as the grey values' scatter implies it.
        cut: `(N,)`, share of the pixels that are as bright as a sensor can tell.
    """

    ellipses: Ellipses
    misfit: Float[np.ndarray, " n"]
    contrast: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    cut: Float[np.ndarray, " n"]


def dark_ellipses(grey: UInt8[np.ndarray, "h w"]) -> Ellipses:
    """Dark regions of the shape of an ellipse, where the image is darker than its surroundings, at several scales."""
    found: list[tuple[np.ndarray, np.ndarray]] = []
    longest = max(grey.shape)
    smooth = cv2.GaussianBlur(grey, (0, 0), 0.8)
    for window in (longest // 40, longest // 16, longest // 6):
        window = max(window, 7) | 1
        dark = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window, 8)
        contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        found += [one for contour in contours if (one := _ellipse(contour)) is not None]
    if not found:
        return Ellipses(np.zeros((0, 2)), np.zeros((0, 2, 2)))
    ellipses = Ellipses(*(np.stack(part) for part in zip(*found, strict=True)))
    ellipses = ellipses.only(np.flatnonzero(_darkness(smooth, ellipses) > FAINTEST))
    return ellipses.only(_distinct(ellipses))


def _darkness(grey: UInt8[np.ndarray, "h w"], ellipses: Ellipses) -> Float[np.ndarray, " n"]:
    """By how much each ellipse is darker inside than around it: an outline may be that of a halo around white paper."""
    around = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
    across = np.linalg.inv(ellipses.axes) @ around
    minor = np.linalg.norm(across, axis=1).min(axis=-1)[:, None, None]
    mean = []
    for reach in (0.5, 1 + BESIDE / minor):
        u, v = np.rint(ellipses.centres[..., None] + reach * across).astype(int).swapaxes(0, 1)
        mean.append(grey[v.clip(0, grey.shape[0] - 1), u.clip(0, grey.shape[1] - 1)].mean(axis=-1))
    return mean[1] - mean[0]


def _ellipse(contour: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The ellipse of the same moments as an outline's, where that is one."""
    if len(contour) < 10:
        return None
    moments = cv2.moments(contour)
    area = moments["m00"]
    if area < np.pi * SMALLEST**2 / 2:
        return None
    centre = np.array([moments["m10"], moments["m01"]]) / area
    spread = np.array([[moments["mu20"], moments["mu11"]], [moments["mu11"], moments["mu02"]]]) / area
    values, vectors = np.linalg.eigh(4 * spread)
    if values[0] < (SMALLEST - 0.5) ** 2 or values[0] < FLATTEST**2 * values[1]:
        return None
    # The region of an ellipse has the area of its moments' ellipse, and its outline is at one radius.
    if not 0.93 < area / (np.pi * np.sqrt(values.prod())) < 1.07:
        return None
    axes = vectors @ np.diag(values**-0.5) @ vectors.T
    radius = np.linalg.norm((contour.reshape(-1, 2) - centre) @ axes, axis=-1)
    if np.abs(radius - 1).max() > 0.12 + 1.0 / np.sqrt(values[0]):
        return None
    # The outline runs through the outermost dark pixels' centres, half a pixel inside the edge.
    grown = vectors @ np.diag(1 / (np.sqrt(values) + 0.5)) @ vectors.T
    return centre, grown


def _distinct(ellipses: Ellipses) -> np.ndarray:
    """The numbers of those that are not at the place of a larger one."""
    order = np.argsort(np.linalg.det(ellipses.axes))
    kept: list[int] = []
    for k in order:
        offset = (ellipses.centres[kept] - ellipses.centres[k])[:, :, None]
        if not kept or np.linalg.norm(ellipses.axes[kept] @ offset, axis=1).min() > 0.8:
            kept.append(int(k))
    return np.array(kept, dtype=int)


def fit_ellipses(image: Shaped[np.ndarray, "h w"], start: Ellipses, room: Float[np.ndarray, " n"]) -> FittedEllipses:
    """Fit each dark ellipse with its blur and a gradient of the light.

    The grey value is `a + g . x + (b + k g . x) Phi(d / s)`, `d` the distance from the ellipse, positive inside, `s`
    the blur, and `k` how the light's gradient differs inside; cut off where a sensor saturates. By symmetry, neither
    blur nor curvature moves the centre.

    Args:
        image: `(H, W)`, uint8 or float32.
        start: ellipses to within a pixel or two.
        room: `(N,)` px from each centre within which no other dark thing is.
    """
    count = len(start.centres)
    major = 1 / np.linalg.eigvalsh(start.axes)[:, 0]
    limit = np.minimum(np.maximum(WIDE * major, major + FAR), np.maximum(room, major + 1))
    side = int(np.ceil(limit.max()))
    axis = np.arange(-side, side + 1)
    x, y = (part.ravel() for part in np.meshgrid(axis, axis))
    base = np.rint(start.centres).astype(int)
    u, v = base[:, :1] + x, base[:, 1:] + y
    height, width = image.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    near = np.hypot(x - (start.centres - base)[:, :1], y - (start.centres - base)[:, 1:]) <= limit[:, None]
    grey = torch.from_numpy(image[v.clip(0, height - 1), u.clip(0, width - 1)].astype(np.float64))
    weight = torch.from_numpy((inside & near).astype(np.float64))
    place = torch.from_numpy(np.stack([x, y]).astype(np.float64))
    total = weight.sum(-1).clamp_min(1)
    a, b, c = start.axes[:, 0, 0], start.axes[:, 0, 1], start.axes[:, 1, 1]
    shape = np.column_stack([start.centres - base, a, b, c, np.full(count, 0.8)])
    light = np.column_stack([np.zeros((count, 4)), np.full(count, SHADE)])
    unknowns = torch.from_numpy(np.column_stack([shape, light]))
    dark, _ = _modelled(unknowns, place)
    mean, share = (weight * grey).sum(-1) / total, (weight * dark).sum(-1) / total
    off = weight * (dark - share[:, None])
    step = (off * (grey - mean[:, None])).sum(-1) / (off * dark).sum(-1).clamp_min(1e-3)
    unknowns[:, 6], unknowns[:, 7] = mean - step * share, step
    held = (0.5 * SCATTER / SHADE_SPREAD * step).square()
    damping = torch.full((count, 1), 1e-3, dtype=torch.float64, device="cpu")
    error, slopes = _residuals(unknowns, grey, place)
    cost = (weight * error * error).sum(-1) + held * (unknowns[:, 10] - SHADE).square()
    for _ in range(STEPS):
        weighted = slopes * weight.unsqueeze(1)
        normal, gradient = weighted @ slopes.mT, (weighted @ error.unsqueeze(-1)).squeeze(-1)
        normal[:, 10, 10] += held
        gradient[:, 10] -= held * (unknowns[:, 10] - SHADE)
        scale = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
        scaled = normal * scale.unsqueeze(-1) * scale.unsqueeze(-2) + torch.diag_embed(damping.expand_as(scale))
        moved = (torch.linalg.solve_ex(scaled, gradient * scale)[0] * scale).nan_to_num()
        proposed = unknowns + moved
        proposed[:, 5].clamp_(0.3, 8.0)
        new_error, new_slopes = _residuals(proposed, grey, place)
        new_cost = (weight * new_error * new_error).sum(-1) + held * (proposed[:, 10] - SHADE).square()
        better = new_cost < cost
        unknowns = torch.where(better[:, None], proposed, unknowns)
        error, cost = torch.where(better[:, None], new_error, error), torch.where(better, new_cost, cost)
        slopes = torch.where(better[:, None, None], new_slopes, slopes)
        damping = torch.where(better[:, None], damping * 0.1, damping * 10).clamp(1e-9, 1e6)
        if bool((moved[:, :2].abs().amax(-1) < CLOSE).all()) and bool((moved[:, 5].abs() < 0.05).all()):
            break
    cut = (weight * ((grey >= BRIGHTEST) | (grey <= 0))).sum(-1) / total
    return _judged(unknowns, (weight * error * error).sum(-1), slopes, weight, held, base)._replace(cut=cut.numpy())


def _modelled(unknowns: Tensor, place: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
    """How dark each pixel is `(N, P)`, and what its derivatives need."""
    u, v, a, b, c, blur = unknowns[:, :6, None].unbind(1)
    x, y = place[0] - u, place[1] - v
    q, r = a * x + b * y, b * x + c * y
    radius = torch.hypot(q, r).clamp_min(0.05)
    # The gradient of the radius: by it, differences of the radius become distances.
    along_u, along_v = (a * q + b * r) / radius, (b * q + c * r) / radius
    steep = torch.hypot(along_u, along_v).clamp_min(1e-9)
    distance = ((1 - radius) / steep / blur).clamp(-8, 8)
    dark = 0.5 + 0.5 * torch.erf(distance * 0.5**0.5)
    return dark, (x, y, q, r, radius, along_u, along_v, steep, distance, blur)


def _residuals(unknowns: Tensor, grey: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Seen minus modelled grey values `(N, P)`, and the model's derivatives by its unknowns `(N, 11, P)`.

    The edge's slope of the radius is held where derivatives are taken, which changes no minimum worth a word.
    """
    dark, (x, y, q, r, radius, along_u, along_v, steep, distance, blur) = _modelled(unknowns, place)
    white, step, light_u, light_v, shade = unknowns[:, 6:, None].unbind(1)
    light, share = light_u * x + light_v * y, 1 + shade * dark
    model = white + step * dark + light * share
    # What is cut off says little more than that the light is at least so strong.
    cut = ((grey >= BRIGHTEST) & (model > BRIGHTEST)) | ((grey <= 0) & (model < 0))
    counts = torch.where(cut, CUT_OFF, 1.0)
    error = (grey - model) * counts
    slope = (step + shade * light) * torch.exp(-0.5 * distance * distance) * ((2 * torch.pi) ** -0.5 / blur) / steep
    slopes = (
        slope * along_u - light_u * share,
        slope * along_v - light_v * share,
        -slope * q * x / radius,
        -slope * (q * y + r * x) / radius,
        -slope * r * y / radius,
        -slope * steep * distance,
        torch.ones_like(dark),
        dark,
        x * share,
        y * share,
        light * dark,
    )
    return error, torch.stack(slopes, dim=1) * counts.unsqueeze(1)


def _judged(
    unknowns: Tensor, cost: Tensor, slopes: Tensor, weight: Tensor, held: Tensor, base: Shaped[np.ndarray, "n 2"]
) -> FittedEllipses:
    """The fitted ellipses in px, how well they fit, and how far their centres may be off."""
    centres = base + unknowns[:, :2].numpy()
    a, b, c = unknowns[:, 2:5].numpy().T
    axes = np.stack([np.stack([a, b], -1), np.stack([b, c], -1)], -2)
    half = -0.5 * unknowns[:, 7].numpy()
    rms = (cost / weight.sum(-1).clamp_min(1)).sqrt().numpy()
    misfit = rms / np.maximum(np.abs(half), 1e-3)
    weighted = slopes * weight.unsqueeze(1)
    normal = weighted @ slopes.mT
    normal[:, 10, 10] += held
    scale = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
    inverse = torch.linalg.pinv(normal * scale.unsqueeze(-1) * scale.unsqueeze(-2), hermitian=True)
    spread = (inverse * scale.unsqueeze(-1) * scale.unsqueeze(-2)).diagonal(dim1=-2, dim2=-1)[:, :2].mean(-1)
    sigma = rms * spread.clamp_min(0).sqrt().numpy()
    failed = ~(np.isfinite(centres).all(-1) & np.isfinite(axes).all((-1, -2)) & (np.linalg.det(axes) > 0))
    return FittedEllipses(Ellipses(centres, axes), np.where(failed, np.inf, misfit), half, sigma, np.zeros(len(half)))
