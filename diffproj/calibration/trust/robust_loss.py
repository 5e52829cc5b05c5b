"""How uncertain a pose is under a robust loss, where few corners tell it and some of these are wrong.

Among many corners a wrong one is a small part of what is pooled over all (`uncertainty.py`). In a view of few it is
not: the pose lacks it, as if it had not been seen, and the pull that the loss lets through goes into the pose. So such
a corner counts by its own score and derivative, the others by what is pooled; in the signs of `uncertainty.py`, with
sums over the corners of a view:

    W = a sum (1 - m) w J^T J        + sum m w (rho' J^T J + 2 rho'' (J^T e) (J^T e)^T)
    M = k^2 q sum (1 - m) w J^T J    + sum m (w rho')^2 (J^T e) (J^T e)^T
    covariance of the pose alone = phi W^-1 M W^-1

where m is near 1 for what the loss hardly counts and noise does not explain, else near 0; a, k and q are means over
corners that count by `1 - m`, with `2 m` degrees of freedom fewer; and q is the view's own where its corners err
clearly more than the others' (`noisy_views.py`).
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.least_squares.eliminated import local_inverse
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.trust.corner_scores import CornerScores
from diffproj.calibration.trust.discounted import beyond_noise
from diffproj.calibration.trust.noise import Noise, with_known
from diffproj.calibration.trust.noisy_views import noise_factor

NOISE = 3.0
"""Deviations of the noise at which a corner that the loss hardly counts may as well be wrong as be noise."""


def with_own_scores(covariance: Covariance, found: Fit, phi: Tensor, known: Noise | None) -> Covariance:
    """The covariance with poses as uncertain as the corners say that the loss discounts.

    Args:
        covariance: of the pooled scores.
        found: the fit, with a robust loss and the image objective.
        phi: its dispersion `(P,)`.
        known: the noise that a calibration before had.
    """
    corners = CornerScores(found)
    used = found.task.used.to(corners.squared)
    beyond = (beyond_noise(found, corners) / NOISE**2).square()
    own = (1 - corners.slope).square() * used * (1 - 1 / (1 + beyond))
    freedom = found.degrees_of_freedom() - 2 * (corners.counted * own).sum((-2, -1))
    means = corners.moments(corners.counted * (1 - own), freedom)
    variance = with_known(Noise(means.variance, freedom), known, found).variance
    rows, pulls = corners.rows[:, :, -POSE:].flatten(-2), corners.pulls[:, :, -POSE:]
    w, slope, bend = corners.weight, corners.slope, corners.bend

    def gram(each: Tensor) -> Tensor:
        return (rows * each.unsqueeze(2).repeat(1, 1, 1, 2)) @ rows.mT

    def pulled(each: Tensor) -> Tensor:
        return (pulls * each.unsqueeze(2)) @ pulls.mT

    # What a located view's corners scatter more than its calibration's, `mismatch` tells, and `measure` counts.
    of_view = torch.ones_like(used[:, :, 0]) if known is not None else noise_factor(found, means.noise, own)
    pooled = gram(w * (used - own))
    # A redescending score's slope along the residual is below 0, which would make the pose surer than without it.
    along = (2 * bend).maximum(-slope / corners.squared.clamp(min=torch.finfo(slope.dtype).tiny))
    slope_of_all, noise, phi = (z[:, None, None, None] for z in (means.slope, means.slope.square() * variance, phi))
    W = slope_of_all * pooled + gram(own * w * slope) + pulled(own * w * along)
    M = noise * of_view[..., None, None] * pooled + pulled(own * (w * slope).square())
    inverse, unknown = local_inverse(W)
    alone = phi * inverse @ M @ inverse
    sound = ~unknown & (freedom >= 1).unsqueeze(-1)
    return replace(covariance, _alone=torch.where(sound[..., None, None], (alone + alone.mT) / 2, covariance._alone))
