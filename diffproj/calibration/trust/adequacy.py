"""How far the model of a calibration may be off before it counts as none, and which model would be better."""

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.trust.leftover import Effect, Leftover, leftover
from diffproj.lens.models import MODELS

SIGNIFICANT = 6.0
"""Standard deviations from which on an effect is none of chance."""
RADIAL_SHARE, SMOOTH_SHARE, SHAPE_SHARE = 0.05, 0.15, 0.15
"""Part of the residuals' sum of squares that an effect must explain to be worth a word. (The board of the bundled views
passes for 1 % along the radius and up to 10 % over the image, as far as its own shape is known.)"""
PRINT_SHARE = 0.08
"""The same of a print that is wider than high, or slanted. A stretch by 0.5 %, which puts focal lengths off by several
deviations, explains 0.13 to 0.26 in simulated corners with a noise of 0.15 px, one by 0.2 % some 0.07."""
SKEW_PART = 0.5
"""Part of what a smooth field explains from which on skew, if it explains as much, is the word for it."""
SHAPE_VIEWS = 4
"""Views below which what repeats on the board is not told from what repeats in the image."""
BOW_PART = 0.5
"""Part of what the board's shape explains from which on its bow is the word for it."""
EXACT_PX = 1e-3
"""Residuals below which nothing is looked for."""
NOISY_PX = 1.0
"""Standard deviation of a corner's coordinate above which it is not what a detector finds in sharp photographs."""
GRAVE_PX = 2.0
GRAVE_SHARE = 0.5
"""Standard deviation of a coordinate, and part of the sum of squares that a better lens would explain, above which a
fit is no calibration: its error bars, which take the model for right, would say nothing."""
LENS_WORDS = "change smoothly"
"""What is said of residuals that another lens would explain."""


def gravely_inadequate(found: Fit) -> Tensor:
    """Whether the lens is so far from the camera's that its deviations mean nothing `(P,)`."""
    sigma = found.pixel_sigma().detach()
    grave = (sigma > GRAVE_PX) & (not poses_only(found.task))
    which = grave.nonzero().flatten()
    if len(which) == 0:
        return grave
    smooth = leftover(found, which, SIGNIFICANT).smooth
    return grave.index_put((which,), (smooth.share > GRAVE_SHARE) & (smooth.deviations > SIGNIFICANT))


def poses_only(task: Task) -> bool:
    """Whether intrinsics and lens are all held."""
    return task.basis is not None and task.basis.shape[-1] == 0


def counts(effect: Effect, i: int, share: float) -> bool:
    """Whether an effect on camera `i` is none of chance, and explains more than a part of the sum of squares."""
    return float(effect.deviations[i]) > SIGNIFICANT and float(effect.least_share[i]) > share


def wants_skew(task: Task, left: Leftover, i: int) -> bool:
    """Whether skew, which is held, is the word for most of what the residuals of camera `i` leave over."""
    least = max(SMOOTH_SHARE, SKEW_PART * float(left.smooth.least_share[i]))
    return not task.skew and counts(left.skew, i, least)


def grave_remedy(found: Fit, p: int) -> str:
    """What residuals are like that are far too large for a calibration, and the remedy."""
    left = leftover(found, torch.tensor([p], device=found.task.used.device), SIGNIFICANT)
    if wants_skew(found.task, left, 0):
        return "as through a K with skew: take skew=True"
    return f"as through another lens: {other_lens(found.task, p, radial=True)}"


def other_lens(task: Task, p: int, radial: bool) -> str:
    """The remedy for what the lens of a camera leaves over, along the radius or not."""
    model = MODELS[task.lens]
    held = task.basis is not None and not bool(task.basis[p, 4 : 4 + model.count].any())
    if model.count and held:
        return "let the lens's coefficients free"
    if not radial and model.count and model.perspective:
        better = {"brown12": "'brown14'", "brown14": "'fisheye'"}.get(task.lens, "'brown12'")
    elif model.count <= 5 and model.perspective:
        better = {0: "'brown5'", 4: "'brown5', 'brown8'"}.get(model.count, "'brown8'") + " or 'fisheye'"
    else:
        better = "'fisheye'" if model.perspective else "'brown5' or 'brown8'"
    return f"try distortion={better} ('auto' compares the lenses)"
