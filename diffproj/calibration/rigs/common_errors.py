"""Errors that all corners of a view share: how large they are for each camera of a rig, and what they do to its places.

A camera that is late sees a hand-held board where it has moved to; a stabilised lens moves the whole image. All corners
of the view are off together then. On its own such a camera takes that for another pose of the board. In a rig the
cameras share the pose and contradict each other: by little in the residuals, of which each takes its part, but by much
in the places, for no number of corners averages it out.

With r the residuals of a view v, W their weights, and B what moves all its corners alike, along u and along v,

    q_v = B^T W r        mean of |q_v|^2 = s_c^2 trace G_vv + sum_u t_c(u)^2 |G_vu|^2
    T_v = B^T W J_v      G_vu = B^T W B (where v = u) - T_v H^-1 T_u^T

tell the variance t_c^2 of the shifts of each camera's views (the method of moments); the noise s_c^2 is that of the
corners about their mean in the view. Two cameras tell the sum of theirs alone, which is shared out evenly. It is
believed as far as it stands out of chance, and joins the covariance of the scores:

    M = sum_v s_c^2 J_v^T W J_v + t_c^2 T_v^T T_v
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.least_squares.eliminated import inverse, reduced
from diffproj.calibration.least_squares.losses import slope_and_bend
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.problem.shape import by_displacement
from diffproj.calibration.results.covariance import Scores
from diffproj.calibration.rigs.fit import RigFit
from diffproj.calibration.rigs.problem import Group

STEPS = 200
"""Multiplications until variances that cannot be negative have settled."""
CHANCE = 1.5
"""Deviations of chance that count as nothing; half of what is beyond counts at one more."""
LEAST_SPARE = 0.25
"""Part of a camera's degrees of freedom that has to be left within its views for the noise to be told by these."""
CLEAR = 5.0
"""Deviations of chance from which on a remark may say so: of 260 rigs with noise alone, the furthest is 4.4 off."""
MOST = 0.6
"""Part of the variance of a place from which on it does."""
NEGLIGIBLE_PX = 1e-4
"""A shift that is none, if anything is to be said."""
TINY = torch.finfo(torch.float64).tiny


class CommonErrors(NamedTuple):
    """What the corners of each view have in common.

    Attributes:
        variance: of the shift of a camera's views along u, and along v `(C,)`, in px^2.
        beyond: how far it stands out of chance, in the deviations of that.
        scores: what it adds to the covariance of the scores, by moment.
        shared: and to the covariance of the shared unknowns `(s, s)`.
    """

    variance: Tensor
    beyond: float
    scores: Scores
    shared: Tensor

    def remark(self, names: tuple[str, ...], places: Sequence[int], covariance: Tensor) -> str:
        """A remark on cameras whose views are off, where that makes up most of what is not known of a place; else ''.

        Args:
            names: of the cameras.
            places: where their places stand among the shared unknowns.
            covariance: of all of these `(s, s)`, whatever it is from.
        """
        rows = list(places)
        of_shifts, of_all = (part.diagonal()[rows] for part in (self.shared, covariance))
        known = of_all.isfinite() & (of_all > 0)
        variance = 2 * self.variance  # of a distance
        if self.beyond < CLEAR or float(variance.amax()) < NEGLIGIBLE_PX**2:
            return ""
        if not bool((of_shifts[known] > MOST * of_all[known]).any()):
            return ""
        ones = [i for i, one in enumerate(variance) if one > variance.amax() / 4]
        px = [f"{float(one.sqrt()):.2f} px" for one in variance]
        if len(names) == 2:
            off = f"{' and '.join(names)} see the target {float(variance.sum().sqrt()):.2f} px apart"
        elif len(ones) == 1:
            off = f"{names[ones[0]]} sees the target {px[ones[0]]} from where the other cameras do"
        else:
            off = f"{', '.join(f'{names[i]} by {px[i]}' for i in ones)} see the target off from where other cameras do"
        return (
            f"{off}, all corners of a view alike and differently at each moment: did the target move, and were the "
            "photographs of a moment not taken at once, or does a lens move (stabilisation)? The deviations hold it; "
            "let the target rest while it is photographed to lower them"
        )


class Shifts(NamedTuple):
    """What shifts of the views along u and along v do to the scores, by moment and camera; 0 where there is no view.

    Attributes:
        shared, local: `B^T W J` by the shared unknowns `(M, C, 2, s)` and by the moment's pose `(M, C, 2, 6)`.
        pull: `B^T W r` `(M, C, 2)`.
        weight: `B^T W B`, a multiple of the identity `(M, C)`.
    """

    shared: Tensor
    local: Tensor
    pull: Tensor
    weight: Tensor


@torch.no_grad()
def common_errors(found: RigFit, variance: Tensor, freedom: Tensor, bend: Tensor) -> CommonErrors | None:
    """What the corners of each view have in common; `None` where that is no more than chance.

    Args:
        found: the fit.
        variance: of a residual component of weight 1, for each camera `(C,)`.
        freedom: the degrees of freedom that it is from `(C,)`.
        bend: the mean slope of a robust loss's score `(C,)`, 1 without a loss.
    """
    shifts, H, basis = _shifts(found, bend), found.curvature(bend), found.basis
    S, F, inverse_W, _ = reduced(H, basis, None)
    free, size = shifts.shared, H.U.diagonal(dim1=-2, dim2=-1)
    if basis is not None:
        free, size = free @ basis[0], (basis.mT @ H.U @ basis).diagonal(dim1=-2, dim2=-1)
    inverse_S = inverse(S, size)[0][0]
    left = free - shifts.local @ F[0].mT.unsqueeze(1)  # (M, C, 2, q): with the moment's pose eliminated
    # G is of views of one moment, but for what the shared unknowns do, which is of all moments.
    G = -torch.einsum("mcai,mij,mdbj->mcadb", shifts.local, inverse_W[0], shifts.local)
    c = torch.arange(len(found.views.names), device=G.device)
    for axis in range(2):
        G[:, c, axis, c, axis] += shifts.weight
    by_shared = torch.einsum("mcai,ij,mdbj->mcadb", left, inverse_S, left)
    across = inverse_S @ torch.einsum("mcai,mcaj->cij", left, left)
    squares = (G.square() - 2 * G * by_shared).sum((0, 2, 4)) + torch.einsum("cij,dji->cd", across, across)
    squares = squares.clamp(min=0)
    own = (G - by_shared)[:, c, :, c].diagonal(dim1=-2, dim2=-1).sum(-1).mT  # trace of G_vv (M, C)
    pull = shifts.pull.square().sum(-1)
    of_means, lost = (
        torch.where(shifts.weight > 0, x / shifts.weight.clamp(min=TINY), 0.0).sum(0) for x in (pull, own)
    )
    spare = freedom - lost
    within = (variance * freedom - of_means).clamp(min=0) / spare.clamp(min=TINY)
    noise = torch.where(spare > LEAST_SPARE * freedom, within, variance).nan_to_num(0.0)
    excess = pull.sum(0) - noise * own.sum(0)
    chance = 2 * noise.unsqueeze(-1) * noise * squares
    beyond = float(excess.sum() / chance.sum().clamp(min=TINY).sqrt())
    if not beyond > CHANCE:
        return None
    believed = (beyond - CHANCE) ** 2 / (1 + (beyond - CHANCE) ** 2)
    found_one = believed * _not_negative(squares, excess)
    follow = (left * found_one.sqrt()[:, None, None]).flatten(0, 2) @ inverse_S  # (2 C M, q)
    follow = follow if basis is None else follow @ basis[0].mT
    return CommonErrors(found_one, beyond, _scores(shifts, found_one), follow.mT @ follow)


def _not_negative(A: Tensor, b: Tensor) -> Tensor:
    """The x of at least 0 with the least |A x - b|, A of positive numbers, that is nearest to equal ones."""
    goal = (A.mT @ b).clamp(min=0)
    x = (b.sum() / A.sum().clamp(min=TINY)).clamp(min=0).repeat(len(b))
    for _ in range(STEPS):
        x = x * goal / (A.mT @ (A @ x)).clamp(min=TINY)
    return x


def _shifts(found: RigFit, bend: Tensor) -> Shifts:
    """What shifts do, of the views of all cameras."""
    M, C, s = found.problem.moments, len(found.views.names), found.parameters.size
    new = found.shared.new_zeros
    shifts = Shifts(new(M, C, 2, s), new(M, C, 2, POSE), new(M, C, 2), new(M, C))
    for group in found.problem.groups:
        panel = found.problem.panel(group, found.shared, found.local)
        weight = group.used.to(panel)
        weight = weight if group.weights is None else weight * group.weights
        pull = weight
        if found.loss is not None:
            pull = weight * slope_and_bend(found.loss, panel[:, -1].square().sum(1))[0]
            weight = weight * bend[group.camera].unsqueeze(-1)
        where = group.moment, group.camera
        shifts.shared[where], shifts.local[where] = _derivatives(found, group, panel, weight)
        shifts.pull[where] = torch.einsum("nap,np->na", panel[:, -1], pull)
        shifts.weight[where] = weight.sum(-1)
    return shifts


def _derivatives(found: RigFit, group: Group, panel: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """The sums over the corners of each view `(n, 2, s)` and `(n, 2, 6)`."""
    problem, parameters, k = found.problem, found.parameters, group.size
    sums = torch.einsum("nkap,np->nak", panel[:, :-1], weight)
    by_pose = sums[..., k:] @ problem.composition(group, found.shared, found.local)  # the camera's, the moment's
    own = torch.cat([sums[..., :k], by_pose[..., :POSE]], dim=-1)
    shared = own.new_zeros(len(own), 2, parameters.size + POSE)
    shared.scatter_(2, group.columns.unsqueeze(1).expand(-1, 2, -1), own)
    shared = shared[..., : parameters.size]  # behind them stands the first camera's pose, which is none
    if parameters.points:
        R, _ = problem.view_poses(group, found.shared, found.local)
        by_point = by_displacement(panel[:, None, -4:-1], R.unsqueeze(1))[:, 0]  # (n, 3, 2, N)
        shared[..., parameters.few :] = torch.einsum("njap,np->napj", by_point, weight).flatten(-2)
    return shared, by_pose[..., POSE:]


def _scores(shifts: Shifts, variance: Tensor) -> Scores:
    """What shifts of such variances `(C,)` add to the covariance of the scores."""
    deviation = variance.sqrt()[:, None, None]
    shared, local = ((part * deviation).flatten(1, 2).unsqueeze(0) for part in (shifts.shared, shifts.local))
    return Scores(shared.mT @ shared, shared.mT @ local, local.mT @ local)
