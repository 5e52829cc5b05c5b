"""Focal lengths that differ from view to view, and what that does to the one that is found.

A camera that focuses anew for each photograph changes its focal length by one or two per cent as it does; a shutter
that reads row after row of a moving image, or a detector misled by a slanted board, looks as if it had. Each view then
wants a focal length of its own. Its pose takes nearly all of that, so that the residuals hardly grow. But the views
that tell the focal length are the few that are tilted most, and the one that is found is off by as much as theirs are.

How much the views contradict each other about everything says too little of that, for it is an average over all
directions of the parameters, and of views that fit the more the more they tell. So the focal length's own variance is
told by the method of moments. In units in which the normal matrix is 1 (`dispersion.py`), with b the direction in which
both focal lengths grow by a part of theirs, view v pulls at them by b^T u_v, and

    mean of (b^T u_v)^2 = phi b^T K_v b + tau^2 sum over w of G_vw^2
    G_vw                = b^T S_v b (where v = w) - b^T S_v S_w b

tells tau^2, in which each view counts by the inverse of b^T K_v b. Nothing is told that independent corners would do by
chance; what is told counts more where few views tell it, as dispersion does. The shared parameters vary by

    tau^2 sum over v of (S_v b) (S_v b)^T

besides. Poses do not: that of a view fits the focal length that is found, not the one that the view had.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.distinct import alike
from diffproj.calibration.trust.dispersion import (
    FEW_VIEWS,
    Contradiction,
    Pulls,
    contradiction,
    in_own_units,
    left_of_noise,
)
from diffproj.calibration.trust.leftover import f_deviations

FEWEST = 3
"""Views from which on they are compared."""
NOTHING = 1e-12
"""Part of what the view that tells most does below which a view tells nothing of the focal length."""
LEAST_SPARE = 0.5
"""Degrees of freedom that two views or fewer which tell it count as."""
CHANCE = 1.5
"""Deviations of chance that count as nothing; half of what is beyond counts at one more. Corners with noise alone get
deviations that are .3 % (20 views) to 2 % (8) larger in the mean by it, and would get 5 to 8 % larger ones with 0."""
CLEAR = 4.0
"""Deviations of chance from which on the views may be said to differ in it."""
ALONE = 4.5
"""And how many times more they must contradict each other about it than about everything. Errors that are smooth over a
board are, in one of ten sets of views, by up to four times: they look like another perspective."""


class OwnFocal(NamedTuple):
    """By how much the focal lengths of P cameras' views differ.

    Attributes:
        variance: tau^2, of a focal length relative to itself, beyond the dispersion `(P,)`.
        spread: its root beyond what views contradict each other about everything `(P,)`.
        more: what that adds to the covariance of the free shared parameters `(P, q, q)`.
        ratio: how many times more views contradict each other about it than about everything `(P,)`.
        deviations: how improbable that is by chance, as deviations of a normal variable `(P,)`.
    """

    variance: Tensor
    spread: Tensor
    more: Tensor
    ratio: Tensor
    deviations: Tensor

    @property
    def told(self) -> Tensor:
        """Where it is clear that focal lengths differ, and not much else does `(P,)`."""
        return (self.ratio > ALONE) & (self.deviations > CLEAR)


def with_own_focal(whole: Covariance, found: Fit, pulls: Pulls | None) -> Covariance:
    """The covariance with the variance that focal lengths get where they differ from view to view.

    Args:
        whole: without it.
        found: the fit, of which nobody said how large its noise is.
        pulls: those of its views, if they tell anything.
    """
    own = own_focal(found, whole.dispersion.detach(), pulls)
    if own is None or not bool((own.variance > 0).any()):
        return whole
    more, basis = own.more, found.task.basis
    more = more if basis is None else basis @ more @ basis.mT
    known = ~(whole.undetermined.unsqueeze(-1) | whole.undetermined.unsqueeze(-2))
    return replace(whole, shared=whole.shared + torch.where(known, more, 0.0))


def own_focal(found: Fit, phi: Tensor, pulls: Pulls | None) -> OwnFocal | None:
    """By how much focal lengths differ; `None` where they are held, or the target's points are free.

    Args:
        found: the fit.
        phi: its dispersion `(P,)`.
        pulls: those of its views, if they tell anything.
    """
    if pulls is None or found.task.used.shape[1] < FEWEST:
        return None
    with torch.inference_mode():
        along = _along(found)
        if not bool((along != 0).any()):
            return None
        task = found.task
        same = None if task.shares is None else alike(task.points, task.pixels, task.used).to(along)
        told = _judged(_moments(pulls, along, same), contradiction(*pulls), phi)
    return OwnFocal(*(part.clone() for part in told))


def _along(found: Fit) -> Tensor:
    """The direction of the free shared parameters `(P, q)` in which both focal lengths grow alike; 0 if they cannot."""
    shared, basis = found.solution.shared.detach(), found.task.basis
    both = torch.nn.functional.pad(shared[:, :2], (0, shared.shape[-1] - 2))
    if basis is None:
        return both
    along = torch.linalg.pinv(basis) @ both.unsqueeze(-1)
    missed = (basis @ along).squeeze(-1) - both
    free = missed.norm(dim=-1) <= 1e-6 * both.norm(dim=-1)
    return torch.where(free.unsqueeze(-1), along.squeeze(-1), 0.0)


class _Moments(NamedTuple):
    """What the views pull at the focal length, in the mean over the views of each camera `(P,)`.

    Attributes:
        mean: the square of a view's pull, over that of independent corners.
        grown: by how much that grows with the variance of the views' own focal lengths.
        views: how many there are; copies count as one.
        spare: in how many of these the focal length is told, less one: they tell it unequally (Satterthwaite 1946).
        moves: how the shared parameters follow each view's own `(P, V, q)`.
        share: how much each view counts `(P, V)`.
    """

    mean: Tensor
    grown: Tensor
    views: Tensor
    spare: Tensor
    moves: Tensor
    share: Tensor


def _moments(pulls: Pulls, along: Tensor, same: Tensor | None) -> _Moments:
    own, W = in_own_units(pulls)
    b = W.mT @ pulls.total @ along.unsqueeze(-1)  # W b = along
    pull, Sb = (own.u @ b).squeeze(-1), (own.S @ b.unsqueeze(1)).squeeze(-1)  # (P, V), (P, V, q)
    copied = None if same is None else _copied(pull, _variances(own.K, b), own.share, same)
    expected = _variances(left_of_noise(own, copied), b)
    tells = (expected > NOTHING * expected.amax(1, keepdim=True)) & (own.share > 0)
    share, expected = torch.where(tells, own.share, 0.0), torch.where(tells, expected, 1.0)
    # G_vw^2 over all w: copies of a view have its focal length, so that together they count as one.
    curve, size = (Sb @ b).squeeze(-1), Sb.square().sum(-1)
    across = (Sb @ (Sb.mT @ (share.unsqueeze(-1) * Sb)) * Sb).sum(-1)
    squares = curve.square() - 2 * curve * size + across
    views, told = share.sum(1), torch.where(tells, expected, 0.0)
    mean, grown = ((share * part / expected).sum(1) / views.clamp(min=1) for part in (pull.square(), squares))
    telling = (share * told).sum(1).square() / (share * told.square()).sum(1).clamp(min=1e-300)
    return _Moments(mean, grown, views, (telling - 1).clamp(min=LEAST_SPARE), Sb @ W.mT, share)


def _judged(moments: _Moments, everything: Contradiction, phi: Tensor) -> OwnFocal:
    """What is believed of the moments: the covariance holds phi already, and what is said goes by everything else."""
    mean, grown, views, spare, moves, share = moments
    known = (grown > 0) & (views > FEWEST - 0.5)
    grown = torch.where(known, grown, 1.0)
    excess = (mean / phi - 1).clamp(min=0).nan_to_num(0.0)
    beyond = (excess / (2 / spare).sqrt() - CHANCE).clamp(min=0).square()
    excess = excess * beyond / (1 + beyond)
    variance = torch.where(known, excess * phi / grown, 0.0) * (1 + FEW_VIEWS / spare.clamp(min=1))
    more = variance[:, None, None] * (moves * share.unsqueeze(-1)).mT @ moves
    usual = everything.phi.clamp(min=1)
    ratio = torch.where(known, mean / usual, 0.0).nan_to_num(0.0)
    spread = ((mean - usual).clamp(min=0) / grown).sqrt()
    return OwnFocal(variance, spread, more, ratio, f_deviations(ratio, spare, everything.spare.clamp(min=5)))


def _copied(pull: Tensor, variance: Tensor, share: Tensor, same: Tensor) -> Tensor:
    """How much of a view's noise all views alike have `(P, V)`: 1 for copies, its share for frames of a video.

    Which they are is seen by how far the pulls of views that are alike lie apart.
    """
    middle = (same @ pull.unsqueeze(-1)).squeeze(-1) / same.sum(-1).clamp(min=1)
    apart = (share * (pull - middle).square()).sum(-1) / (share * (1 - share) * variance).sum(-1).clamp(min=1e-300)
    return 1 - apart.clamp(max=1).unsqueeze(-1) * (1 - share)


def _variances(K: Tensor, b: Tensor) -> Tensor:
    """Variances `(P, V)` along a direction `(P, q, 1)` of covariances `(P, V, q, q)`."""
    return (b.mT.unsqueeze(1) @ K @ b.unsqueeze(1)).flatten(1).clamp(min=0)
