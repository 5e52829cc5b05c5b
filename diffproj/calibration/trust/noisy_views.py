"""By how much the corners of a view err more than the others': what the deviations of its own pose are multiplied by.

The noise of a corner is pooled over all views, for of a few corners it is hardly known. But one photograph may be
blurred, or the board have moved in it: then its pose is known less well than that noise says. With `s_v^2` the variance
of a view's own residuals, and `m_v` its degrees of freedom, the variance of its pose is as many times larger as

    s_v^2 / s^2     where it stands out of its own chance, sqrt(2 / m_v), and no larger where it does not

and with a robust loss the same of the sandwich, `q_v / a_v^2`. Where corners are left out as outliers those that are
left may be the ones that happen to agree: where these scatter evenly up to the limit, or are the fewer, the median of
all residuals, of those left out, too, tells the noise. A pose counts in the camera as the solver weighted it; that the
camera's deviations hold, the dispersion between the views sees to.
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.least_squares.losses import slope_and_bend
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.left_out import mostly_left_out

CHANCE = 3.0
"""Deviations of chance that count as nothing, for one of many views has them; half of the excess counts at one more."""
FLAT = 0.3
"""Mean square of the residuals that are left, in times the largest, from which on they scatter evenly up to the limit:
0.5 if they are spread evenly over a disc, 0.16 if they are normal and the limit is 3.5 deviations."""
TO_DEVIATION = 1.4826
"""Deviation of a normal variable in medians of its absolute value."""


def widened_poses(covariance: Covariance, found: Fit, variance: Tensor) -> Covariance:
    """The covariance with the poses of noisy views as uncertain as their own corners say.

    Args:
        covariance: for the pooled noise.
        found: the fit.
        variance: the pooled variance `(P,)`: of a residual component of weight 1; of a robust loss the sandwich's; of
            the plane objective that of a coordinate in px^2.
    """
    with torch.no_grad():
        factor = noise_factor(found, variance.detach())
    if bool((factor == 1).all()):
        return covariance
    return replace(covariance, _alone=covariance._alone * factor[..., None, None])


def noise_factor(found: Fit, variance: Tensor, without: Tensor | None = None) -> Tensor:
    """The factor on the variance of each view's pose `(P, V)`, at least 1.

    Args:
        found: the fit.
        variance: as in `widened_poses`.
        without: which part of each corner is not counted, for it counts elsewhere `(P, V, N)`.
    """
    task = found.task
    seen = replace(task, objective="image", used=task.used | found.rejected)
    local = tuple(z.detach() for z in found.solution.local)
    residual = seen.problem.linearise(found.solution.shared.detach(), local)[:, :, -1]
    weight = torch.ones_like(residual[:, :, 0])
    if task.weights is not None and task.objective == "image":
        weight = task.weights
    squared = residual.square().sum(2)
    used = task.used & squared.isfinite()
    squared = torch.where(used, squared, 0.0)
    counted = used.to(squared) if without is None else used * (1 - without)
    count = counted.sum(-1)
    parameters = len(task.names) if task.basis is None else task.basis.shape[-1]
    spare = 2 * count - (POSE - task.pose_known) - parameters * count / count.sum(-1, keepdim=True).clamp(min=1)
    pooled = variance.unsqueeze(-1)
    known = (spare >= 1) & (pooled > 0)
    ratio = _squares(found, weight, squared, counted) / spare.clamp(min=1) / pooled
    excess, believed = beyond_chance(torch.where(known, ratio, 1.0), spare)
    if not bool(found.rejected.any()):
        return 1 + excess * believed
    # What is behind the camera is as far off as can be.
    size = (weight.sqrt().unsqueeze(2) * residual).abs().nan_to_num(torch.inf)
    size = torch.where(seen.used.unsqueeze(2), size, torch.nan).flatten(-2)
    of_all = (TO_DEVIATION * size.nanmedian(-1).values).square() / pooled - 1
    of_all = torch.where(of_all.isfinite() & (pooled > 0), of_all, 0.0).maximum(excess)
    lost = mostly_left_out(task.used, found.rejected)
    furthest = (weight * squared).amax(-1)
    cut_off = found.rejected.any(-1) & ((weight * squared).sum(-1) > FLAT * furthest * count)
    return 1 + torch.where(lost, of_all, torch.where(cut_off, of_all, excess) * believed)


def beyond_chance(ratio: Tensor, spare: Tensor) -> tuple[Tensor, Tensor]:
    """By how much ratios to the pooled variance exceed 1, and how much of that is believed, from 0 to 1.

    Each is of residuals with so many degrees of freedom, of which there is at least one where it counts.
    """
    excess = torch.where((spare >= 1) & ratio.isfinite(), ratio - 1, 0.0).clamp(min=0)
    beyond = (excess / (2 / spare.clamp(min=1)).sqrt() - CHANCE).clamp(min=0).square()
    return excess, beyond / (1 + beyond)


def _squares(found: Fit, weight: Tensor, squared: Tensor, counted: Tensor) -> Tensor:
    """The sum of squares of each view `(P, V)`; with a robust loss, of the scores over their mean slope."""
    loss = found.task.loss
    if loss is None:
        return (weight * squared * counted).sum(-1)
    slope, bend = slope_and_bend(loss, squared)
    mean = ((slope + bend * squared) * counted).sum(-1) / counted.sum(-1).clamp(min=1)
    return (weight * slope.square() * squared * counted).sum(-1) / mean.clamp(min=1e-3).square()
