"""Focal lengths or principal points that differ from view to view, and what that does to those that are found.

A camera that focuses anew for each photograph changes its focal length by one or two per cent as it does. One whose
lens or sensor moves against the hand's tremor shifts its principal point, by up to two per cent of the focal length,
and a recording that is steadied afterwards is cropped in every frame elsewhere. A shutter that reads row after row of a
moving image, or a detector misled by a slanted board, looks like either. Each view then wants intrinsics of its own.
Its pose takes nearly all of that, so that the residuals hardly grow. But the views that tell the focal length are the
few that are tilted most, and the one that is found is off by as much as theirs are.

How much the views contradict each other about everything says too little of that, for it is an average over all
directions of the parameters, and of views that fit the more the more they tell. So such intrinsics have a variance of
their own, told by the method of moments. In units in which the normal matrix is 1 (`dispersion.py`), with b_1 ... b_k
the directions in which they move - both focal lengths by the same part of theirs, or the principal point by as much in
x as in y - view v pulls at them by b_i^T u_v, and

    mean of (b_i^T u_v)^2 = phi b_i^T K_v b_i + tau^2 sum over w, j of (b_i^T G_vw b_j)^2
    G_vw                  = S_v (where v = w) - S_v S_w

tells tau^2, in which each view and direction counts by the inverse of b_i^T K_v b_i. Nothing is told that independent
corners would do by chance; what is told counts more where few views tell it, as dispersion does. The shared parameters
vary by

    tau^2 sum over v, i of (S_v b_i) (S_v b_i)^T

besides. Poses do not: that of a view fits the intrinsics that are found, not those that the view had. Of principal
points this is told and not added: the dispersion holds about as much of it already, for more views tell them.
"""

from collections.abc import Callable, Sequence
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

FEWEST, FEWEST_KNOWN = 3, 5
"""Views from which on they are compared; and from which on it counts beside a noise that was given. With noise alone, 2
to 4 % of sets of three or four views would get focal lengths whose deviations are more than twice as large."""
NOTHING = 1e-12
"""Part of what the view that tells most does below which a view tells nothing of them."""
LEAST_SPARE = 0.5
"""Degrees of freedom that two views or fewer which tell it count as."""
CHANCE = 1.5
"""Deviations of chance that count as nothing; half of what is beyond counts at one more. Corners with noise alone get
deviations that are .3 % (20 views) to 2 % (8) larger in the mean by it, and would get 5 to 8 % larger ones with 0."""
CLEAR = 4.0
"""Deviations of chance from which on the views may be said to differ in it."""
FOCAL_ALONE, POINT_ALONE = 4.5, 3.0
"""And how many times more they must contradict each other about it than about everything. Errors that are smooth over a
board look like another perspective: in one of ten sets of views of .1 to .3 px such, by up to four times for focal
lengths in few views, and by 2.9 for principal points (200 sets each of 8, 20 and 40 views)."""


class Own(NamedTuple):
    """By how much some intrinsics differ from view to view, of P cameras.

    Attributes:
        variance: tau^2, beyond the dispersion `(P,)`: of a focal length relative to itself, of a coordinate of the
            principal point in px^2.
        spread: its root beyond what views contradict each other about everything `(P,)`.
        more: what that adds to the covariance of the free shared parameters `(P, q, q)`.
        ratio: how many times more views contradict each other about it than about everything `(P,)`.
        deviations: how improbable that is by chance, as deviations of a normal variable `(P,)`.
        saved: the part of the sum of squares that goes where each view has its own `(P,)`.
    """

    variance: Tensor
    spread: Tensor
    more: Tensor
    ratio: Tensor
    deviations: Tensor
    saved: Tensor


class OwnIntrinsics(NamedTuple):
    """Focal lengths and principal points that differ from view to view; 0 where they are held."""

    focal: Own
    point: Own

    @property
    def focal_told(self) -> Tensor:
        """Where it is clear that focal lengths differ, and not much else does `(P,)`."""
        return (self.focal.ratio > FOCAL_ALONE) & (self.focal.deviations > CLEAR)

    @property
    def point_told(self) -> Tensor:
        """Where it is clear that principal points do, and neither focal lengths nor much else `(P,)`."""
        return ~self.focal_told & (self.point.ratio > POINT_ALONE) & (self.point.deviations > CLEAR)


def with_own_focal(whole: Covariance, found: Fit, pulls: Pulls | None) -> Covariance:
    """The covariance with the variance that focal lengths get where they differ from view to view.

    Args:
        whole: without it.
        found: the fit.
        pulls: those of its views, if they tell anything.
    """
    own = _own(found, whole.dispersion.detach(), pulls, (_focal,))
    if own is None:
        return whole
    more, basis = own[0].more, found.task.basis
    if found.knows_noise:
        few = found.task.used.any(-1).sum(-1) < FEWEST_KNOWN
        more = more.masked_fill(few[:, None, None], 0.0)
    if not bool((more != 0).any()):
        return whole
    more = more if basis is None else basis @ more @ basis.mT
    known = ~(whole.undetermined.unsqueeze(-1) | whole.undetermined.unsqueeze(-2))
    return replace(whole, shared=whole.shared + torch.where(known, more, 0.0))


def own_intrinsics(found: Fit, phi: Tensor, pulls: Pulls | None) -> OwnIntrinsics | None:
    """By how much intrinsics differ; `None` where the views are too few, or the target's points are free.

    Args:
        found: the fit.
        phi: its dispersion `(P,)`.
        pulls: those of its views, if they tell anything.
    """
    own = _own(found, phi, pulls, (_focal, _point))
    return None if own is None else OwnIntrinsics(*own)


def _own(
    found: Fit, phi: Tensor, pulls: Pulls | None, directions: Sequence[Callable[[Fit], Tensor]]
) -> list[Own] | None:
    """The same of some intrinsics, which move in these directions."""
    if pulls is None or found.task.used.shape[1] < FEWEST:
        return None
    with torch.inference_mode():
        task, everything, squares = found.task, contradiction(*pulls), 2 * found.solution.cost.detach()
        same = None if task.shares is None else alike(task.points, task.pixels, task.used).to(phi)
        own = [_judged(_moments(pulls, along(found), same), everything, phi, squares) for along in directions]
    return [Own(*(part.clone() for part in told)) for told in own]


def _focal(found: Fit) -> Tensor:
    """The direction `(P, 1, q)` in which both focal lengths grow alike."""
    shared = found.solution.shared.detach()
    both = torch.nn.functional.pad(shared[:, :2], (0, shared.shape[-1] - 2))
    return _free(both.unsqueeze(1), found.task.basis)


def _point(found: Fit) -> Tensor:
    """The directions `(P, 2, q)` in which the principal point moves by a pixel in x and in y."""
    shared = found.solution.shared.detach()
    axes = torch.eye(shared.shape[-1], dtype=shared.dtype, device=shared.device)[2:4]
    return _free(axes.expand(len(shared), -1, -1), found.task.basis)


def _free(along: Tensor, basis: Tensor | None) -> Tensor:
    """Directions of the shared parameters `(P, k, s)` by the free ones `(P, k, q)`; 0 where one of them is held."""
    if basis is None:
        return along
    free = along @ torch.linalg.pinv(basis).mT
    missed = (free @ basis.mT - along).norm(dim=-1)
    return torch.where((missed <= 1e-6 * along.norm(dim=-1)).all(-1)[:, None, None], free, 0.0)


class _Moments(NamedTuple):
    """What the views pull at k directions, in the mean over these and over the views of each camera `(P,)`.

    Attributes:
        mean: the square of a view's pull, over that of independent corners.
        grown: by how much that grows with the variance of the views' own intrinsics.
        views: how many there are; copies count as one.
        spare: how many pulls tell it, less one for each direction: views tell it unequally (Satterthwaite 1946).
        moves: how the shared parameters follow each view's own `(P, V, q, k)`.
        share: how much each counts `(P, V, k)`.
        saved: what goes of the sum of squares where each view has its own.
    """

    mean: Tensor
    grown: Tensor
    views: Tensor
    spare: Tensor
    moves: Tensor
    share: Tensor
    saved: Tensor


def _moments(pulls: Pulls, along: Tensor, same: Tensor | None) -> _Moments:
    own, W = in_own_units(pulls)
    b = W.mT @ pulls.total @ along.mT  # W b = along
    pull, Sb = own.u @ b, own.S @ b.unsqueeze(1)  # (P, V, k), (P, V, q, k)
    expected = torch.stack([_of_noise(own, b[..., i], pull[..., i], same) for i in range(b.shape[-1])], dim=-1)
    tells = (expected > NOTHING * expected.amax(1, keepdim=True)) & (own.share > 0).unsqueeze(-1)
    share = torch.where(tells, own.share.unsqueeze(-1), 0.0)
    told, expected = torch.where(tells, expected, 0.0), torch.where(tells, expected, 1.0)
    # (b_i G_vw b_j)^2 over all w and j: copies of a view have its intrinsics, so that together they count as one.
    curve, size = b.mT.unsqueeze(1) @ Sb, Sb.mT @ Sb
    moved = (share.unsqueeze(-2) * Sb).transpose(1, 2).flatten(-2) @ Sb.transpose(1, 2).flatten(-2).mT
    across = ((moved.unsqueeze(1) @ Sb) * Sb).sum(-2)
    squares = (curve.square() - 2 * curve * size).sum(-1) + across
    pulls_told = share.sum((1, 2))
    mean, grown = ((share * part / expected).sum((1, 2)) / pulls_told.clamp(min=1) for part in (pull.square(), squares))
    telling = (share * told).sum(1).square() / (share * told.square()).sum(1).clamp(min=1e-300)
    spare = (telling - 1).clamp(min=LEAST_SPARE).sum(-1)
    gain = (pull.unsqueeze(-2) @ torch.linalg.pinv(curve, hermitian=True) @ pull.unsqueeze(-1)).flatten(1)
    saved = (share.amin(-1) * gain).sum(1)
    return _Moments(mean, grown, pulls_told / b.shape[-1], spare, W.unsqueeze(1) @ Sb, share, saved)


def _judged(moments: _Moments, everything: Contradiction, phi: Tensor, squares: Tensor) -> Own:
    """What is believed of the moments: the covariance holds phi already, and what is said goes by everything else."""
    mean, grown, views, spare, moves, share, saved = moments
    known = (grown > 0) & (views > FEWEST - 0.5)
    grown = torch.where(known, grown, 1.0)
    excess = (mean / phi - 1).clamp(min=0).nan_to_num(0.0)
    beyond = (excess / (2 / spare).sqrt() - CHANCE).clamp(min=0).square()
    excess = excess * beyond / (1 + beyond)
    variance = torch.where(known, excess * phi / grown, 0.0) * (1 + FEW_VIEWS * share.shape[-1] / spare.clamp(min=1))
    each = moves.transpose(1, 2).flatten(-2)
    more = variance[:, None, None] * (each * share.flatten(1).unsqueeze(1)) @ each.mT
    usual = everything.phi.clamp(min=1)
    ratio = torch.where(known, mean / usual, 0.0).nan_to_num(0.0)
    spread = ((mean - usual).clamp(min=0) / grown).sqrt()
    deviations = f_deviations(ratio, spare, everything.spare.clamp(min=5))
    return Own(variance, spread, more, ratio, deviations, saved / squares.clamp(min=1e-300))


def _of_noise(own: Pulls, b: Tensor, pull: Tensor, same: Tensor | None) -> Tensor:
    """The variance `(P, V)` that independent corners give pulls `(P, V)` along a direction `(P, q)`."""
    copied = None if same is None else _copied(pull, _variances(own.K, b), own.share, same)
    return _variances(left_of_noise(own, copied), b)


def _copied(pull: Tensor, variance: Tensor, share: Tensor, same: Tensor) -> Tensor:
    """How much of a view's noise all views alike have `(P, V)`: 1 for copies, its share for frames of a video.

    Which they are is seen by how far the pulls of views that are alike lie apart.
    """
    middle = (same @ pull.unsqueeze(-1)).squeeze(-1) / same.sum(-1).clamp(min=1)
    apart = (share * (pull - middle).square()).sum(-1) / (share * (1 - share) * variance).sum(-1).clamp(min=1e-300)
    return 1 - apart.clamp(max=1).unsqueeze(-1) * (1 - share)


def _variances(K: Tensor, b: Tensor) -> Tensor:
    """Variances `(P, V)` along a direction `(P, q)` of covariances `(P, V, q, q)`."""
    return torch.einsum("pi,pvij,pj->pv", b, K, b).clamp(min=0)
