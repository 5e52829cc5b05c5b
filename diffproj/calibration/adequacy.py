"""What is to be known of a calibration that converged, and how far its model may be off before it counts as none."""

import torch
from torch import Tensor

from diffproj.calibration.fit import Fit
from diffproj.calibration.leftover import Effect, Leftover, leftover
from diffproj.calibration.solver import Status
from diffproj.calibration.task import Task
from diffproj.lens.models import MODELS

SIGNIFICANT = 6.0
"""Standard deviations from which on an effect is none of chance."""
RADIAL_SHARE, SMOOTH_SHARE, SHAPE_SHARE = 0.05, 0.15, 0.15
"""Part of the residuals' sum of squares that an effect must explain to be worth a word. (The board of the bundled views
passes for 1 % along the radius and up to 10 % over the image, as far as its own shape is known.)"""
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


def remarks(found: Fit, status: Tensor) -> tuple[str, ...]:
    """The remarks on each of P cameras, in one text; empty where there are none, or it did not converge."""
    task = found.task
    converged = status == Status.CONVERGED
    held = torch.zeros_like(converged)
    if task.prior is not None and task.prior.known is not None:
        held = (task.prior.precision != task.prior.known).any(-1).any(-1)
    texts: list[list[str]] = [[] for _ in status]
    for p in (converged & held).nonzero().flatten().tolist():
        texts[p].append("k4, k5 and k6 are drawn towards 0, for without that the lens folds inside the image")
    sigma = found.pixel_sigma().detach()
    which = (converged & (sigma > EXACT_PX) & (not poses_only(task))).nonzero().flatten()
    if len(which):
        left = leftover(found, which, SIGNIFICANT)
        for i, p in enumerate(which.tolist()):
            texts[p].extend(filter(None, [_left_over(task, left, i, p, float(sigma[p]))]))
    return tuple("; ".join(text) for text in texts)


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


def other_lens(task: Task, p: int, radial: bool) -> str:
    """The remedy for what the lens of a camera leaves over, along the radius or not."""
    model = MODELS[task.lens]
    held = task.basis is not None and not bool(task.basis[p, 4 : 4 + model.count].any())
    if model.count and held:
        return "let the lens's coefficients free"
    if not radial and model.count and model.perspective:
        better = {"brown12": "'brown14'", "brown14": "'fisheye'"}.get(task.lens, "'brown12'")
        better += "" if task.skew else ", or skew=True"
    elif model.count <= 5 and model.perspective:
        better = {0: "'brown5'", 4: "'brown5', 'brown8'"}.get(model.count, "'brown8'") + " or 'fisheye'"
    else:
        better = "'fisheye'" if model.perspective else "'brown5' or 'brown8'"
    return f"try distortion={better} ('auto' compares the lenses)"


def _left_over(task: Task, left: Leftover, i: int, p: int, sigma: float) -> str:
    """The sentence on the residuals of camera `p`, number `i` of those that were tested; empty where they are noise."""

    def counts(effect: Effect, share: float) -> bool:
        return float(effect.deviations[i]) > SIGNIFICANT and float(effect.least_share[i]) > share

    for radial, effect, share in ((True, left.radial, RADIAL_SHARE), (False, left.smooth, SMOOTH_SHARE)):
        if counts(effect, share):
            where = "with the distance from the principal point" if radial else "over the image"
            part = f"{100 * float(effect.share[i]):.0f} % of their sum of squares"
            remedy = other_lens(task, p, radial)
            return f"the residuals {LENS_WORDS} {where}, as through another lens ({part}): {remedy}"
    if int(task.used[p].any(-1).sum()) >= SHAPE_VIEWS and counts(left.shape, SHAPE_SHARE):
        if counts(left.bow, BOW_PART * float(left.shape.share[i])):
            return "the residuals repeat on the board, as if it were bent: take bow=True"
        return (
            f"the residuals repeat on the board, whose corners lie {float(left.moved[i]):.2g} world units (RMS) "
            "off the target's: a flatter or better print would tell more"
        )
    if sigma > NOISY_PX:
        return (
            f"the corners scatter by {sigma:.1f} px in each coordinate, in sharp photographs by 0.1 to 0.3: "
            "look for blur and for wrong corners"
        )
    return ""
