"""Errors that all corners of a view share: how large they are for each camera of a rig, and what they do to its places.

A camera that is late sees a hand-held board where it has moved and turned to; a stabilised lens moves the whole image.
All corners of the view are off together then. On its own such a camera takes that for another pose of the board. In a
rig the cameras share the pose and contradict each other: by little in the residuals, of which each takes its part, but
by much in the places, for no number of corners averages it out.

There are two kinds k: shifts, along u and along v, and turns of the target about its middle. With r the residuals of a
view v, W their weights, and B_k the moves of its corners,

    q_vk = B_k^T W r      mean of |q_vk|^2 = s_c^2 trace G_vk,vk + sum over u, l of t_l(u)^2 |G_vk,ul|^2
    T_vk = B_k^T W J_v    G_vk,ul = B_k^T W B_l (where v = u) - T_vk H^-1 T_ul^T

tells the variance t_k(c)^2 of the moves in the views of each camera (the method of moments); the noise s_c^2 is that of
the corners about what they have in common. Two cameras tell the sum of theirs alone, which is shared out evenly. It is
believed as far as it stands out of chance, counts more where few moments tell it, as dispersion does, and joins the
covariance of the scores:

    M = sum over v of s_c^2 J_v^T W J_v + sum over k of t_k(c)^2 T_vk^T T_vk
"""

from collections.abc import Callable, Sequence
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
from diffproj.calibration.trust.dispersion import FEW_VIEWS

STEPS = 200
"""Multiplications until variances that cannot be negative have settled."""
CHANCE = 2.0
"""Deviations of chance that count as nothing; half of what is beyond counts at one more."""
OF_KIND, KINDS = (0, 0, 1, 1, 1), 2
"""Of which kind each of the moves is: shifts along u and v; turns of the target about its middle."""
LEAST_SPARE = 0.25
"""Part of a camera's degrees of freedom that has to be left within its views for the noise to be told by these."""
CLEAR = 6.0
"""Deviations of chance from which on a remark may say so: of 200 rigs with noise alone, the furthest is 5.2 off."""
MOST = 0.6
"""Part of the variance of a place from which on it does."""
NEGLIGIBLE_PX = 1e-4
"""A move that is none, if anything is to be said."""
TINY = torch.finfo(torch.float64).tiny


class CommonErrors(NamedTuple):
    """What the corners of each view have in common.

    Attributes:
        variance: of moves of a camera's views, per coordinate of a corner, by shifts and by turns `(C, 2)`, in px^2.
        beyond: how far those of a kind stand out of chance, in the deviations of that.
        scores: what it adds to the covariance of the scores, by moment.
        shared: and to the covariance of the shared unknowns `(s, s)`.
    """

    variance: Tensor
    beyond: float
    scores: Scores
    shared: Tensor

    def remark(self, names: tuple[str, ...], places: Sequence[int], covariance: Tensor) -> str:
        """A remark on cameras whose views are off, where that makes up most of what is not known of a place; else ''.

        Whether that is clear of chance it does not ask: `beyond` says so, without a covariance.

        Args:
            names: of the cameras.
            places: where their places stand among the shared unknowns.
            covariance: of all of these `(s, s)`, whatever it is from.
        """
        rows = list(places)
        of_common, of_all = (part.diagonal()[rows] for part in (self.shared, covariance))
        known = of_all.isfinite() & (of_all > 0)
        variance = 2 * self.variance.sum(-1)  # of a distance
        if float(variance.amax()) < NEGLIGIBLE_PX**2:
            return ""
        if not bool((of_common[known] > MOST * of_all[known]).any()):
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
            f"{off}, all corners of a view together, and otherwise at each moment: did the target move, and were the "
            "photographs of a moment not taken at once, or does a lens move (stabilisation)? The deviations hold it; "
            "let the target rest while it is photographed to lower them"
        )


class Moves(NamedTuple):
    """What b moves of all corners of a view do to the scores, by moment and camera; 0 where there is no view.

    Attributes:
        shared, local: `B^T W J` by the shared unknowns `(M, C, b, s)` and by the moment's pose `(M, C, b, 6)`.
        pull: `B^T W r` `(M, C, b)`.
        weight: `B^T W B` `(M, C, b, b)`.
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
        variance: of the score of a residual component of weight 1, over the bend, for each camera `(C,)`: of the
            residual itself without a loss. In these units the mean of |q|^2 is s^2 tr G with a loss, too.
        freedom: the degrees of freedom that it is from `(C,)`.
        bend: the mean slope of a robust loss's score `(C,)`, 1 without a loss.
    """
    C, basis = len(found.views.names), found.basis
    moves = moves_of(found, bend, len(OF_KIND), lambda group, panel: _moved(group, panel, C))
    left, inverse_S, inverse_W = without_poses(found, bend, moves)
    # G is of views of one moment, but for what the shared unknowns do, which is of all moments.
    G = -torch.einsum("mcai,mij,mdbj->mcadb", moves.local, inverse_W, moves.local)
    c = torch.arange(len(found.views.names), device=G.device)
    G[:, c, :, c] += moves.weight.transpose(0, 1)
    by_shared = torch.einsum("mcai,ij,mdbj->mcadb", left, inverse_S, left)
    own = (G - by_shared)[:, c, :, c].transpose(0, 1)  # G_vv (M, C, 5, 5)
    kinds = torch.zeros(len(OF_KIND), KINDS, dtype=G.dtype, device=G.device)
    kinds[range(len(OF_KIND)), OF_KIND] = 1.0
    squares = torch.einsum("mcadb,ak,bl->ckdl", G.square() - 2 * G * by_shared, kinds, kinds)
    across = inverse_S @ torch.einsum("mcai,mcaj,ak->ckij", left, left, kinds)
    squares = (squares + torch.einsum("ckij,dlji->ckdl", across, across)).clamp(min=0)
    there = moves.weight.diagonal(dim1=-2, dim2=-1)[..., 0] > 0  # (M, C)
    noise = _noise_within(moves, own, variance, freedom)
    pull = torch.einsum("mca,ak->ck", moves.pull.square(), kinds)
    excess = pull - noise.unsqueeze(-1) * torch.einsum("mcaa,ak->ck", own, kinds)
    told = _not_negative(squares.flatten(0, 1).flatten(-2), excess.flatten()).unflatten(0, excess.shape)
    # How far each kind stands out of chance, without what others cause of its pull.
    by_kind = squares.diagonal(dim1=1, dim2=3)  # (C, C, K)
    alone = excess - torch.einsum("ckdl,dl->ck", squares, told) + torch.einsum("cdk,dk->ck", by_kind, told)
    chance = (2 * noise[:, None, None] * noise[:, None] * by_kind).sum((0, 1))
    beyond = alone.sum(0) / chance.clamp(min=TINY).sqrt()
    over = (beyond - CHANCE).clamp(min=0).square()
    told = told * over / (1 + over)
    moments = (there.sum(-1) > 1).sum()
    told = told * (1 + FEW_VIEWS / (moments - 1).clamp(min=1).to(told))
    if not bool((told > 0).any()):
        return None
    deviation = (told @ kinds.mT).sqrt().unsqueeze(-1)  # (C, 5, 1)
    follow = (left * deviation).flatten(0, 2) @ inverse_S
    follow = follow if basis is None else follow @ basis[0].mT
    shared, local = ((part * deviation).flatten(1, 2).unsqueeze(0) for part in (moves.shared, moves.local))
    scores = Scores(shared.mT @ shared, shared.mT @ local, local.mT @ local)
    return CommonErrors(told, float(beyond.amax()), scores, follow.mT @ follow)


def _noise_within(moves: Moves, own: Tensor, variance: Tensor, freedom: Tensor) -> Tensor:
    """The variance of the corners about what they have in common in their view, for each camera `(C,)`."""
    inverse = torch.linalg.pinv(moves.weight, hermitian=True)
    of_moves = torch.einsum("mca,mcab,mcb->c", moves.pull, inverse, moves.pull)
    spare = freedom - torch.einsum("mcab,mcba->c", inverse, own)
    within = (variance * freedom - of_moves).clamp(min=0) / spare.clamp(min=TINY)
    return torch.where(spare > LEAST_SPARE * freedom, within, variance).nan_to_num(0.0)


def _not_negative(A: Tensor, b: Tensor) -> Tensor:
    """The x of at least 0 with the least |A x - b|, A of positive numbers, that is nearest to equal ones."""
    goal = (A.mT @ b).clamp(min=0)
    x = (b.sum() / A.sum().clamp(min=TINY)).clamp(min=0).repeat(len(b))
    for _ in range(STEPS):
        x = x * goal / (A.mT @ (A @ x)).clamp(min=TINY)
    return x


def moves_of(found: RigFit, bend: Tensor, count: int, moved: Callable[[Group, Tensor], Tensor]) -> Moves:
    """What moves do, of the views of all cameras.

    Args:
        found: the fit.
        bend: the mean slope of a robust loss's score `(C,)`, 1 without a loss.
        count: how many moves there are.
        moved: how they move the corners of a group's views on the image `(n, count, 2, N)`, from its panel.
    """
    M, C, s = found.problem.moments, len(found.views.names), found.parameters.size
    new = found.shared.new_zeros
    moves = Moves(new(M, C, count, s), new(M, C, count, POSE), new(M, C, count), new(M, C, count, count))
    for group in found.problem.groups:
        panel = found.problem.panel(group, found.shared, found.local)
        weight = group.used.to(panel)
        weight = weight if group.weights is None else weight * group.weights
        pull = weight
        if found.loss is not None:
            pull = weight * slope_and_bend(found.loss, panel[:, -1].square().sum(1))[0]
            weight = weight * bend[group.camera].unsqueeze(-1)
        where, B = (group.moment, group.camera), moved(group, panel)
        moves.shared[where], moves.local[where] = _derivatives(found, group, panel, B * weight[:, None, None])
        moves.pull[where] = torch.einsum("nbap,nap,np->nb", B, panel[:, -1], pull)
        moves.weight[where] = torch.einsum("nbap,ncap,np->nbc", B, B, weight)
    return moves


def without_poses(found: RigFit, bend: Tensor, moves: Moves) -> tuple[Tensor, Tensor, Tensor]:
    """What moves do to the scores by the free shared unknowns with the moment's pose eliminated `(M, C, b, q)`.

    With it the inverses of the normal matrix of these unknowns `(q, q)`, and of the poses' blocks `(M, 6, 6)`.
    """
    H, basis = found.curvature(bend), found.basis
    S, F, inverse_W, _ = reduced(H, basis, None)
    free, size = moves.shared, H.U.diagonal(dim1=-2, dim2=-1)
    if basis is not None:
        free, size = free @ basis[0], (basis.mT @ H.U @ basis).diagonal(dim1=-2, dim2=-1)
    return free - moves.local @ F[0].mT.unsqueeze(1), inverse(S, size)[0][0], inverse_W[0]


def _moved(group: Group, panel: Tensor, cameras: int) -> Tensor:
    """How corners move on the image `(n, 5, 2, N)`: shifts along u and v; turns of the target about its middle.

    All turns together move the corners of a camera by as much as shifts by a pixel along u and v do, in the mean.
    """
    k = group.size
    shift = torch.eye(2, dtype=panel.dtype, device=panel.device)[:, :, None].expand(len(panel), 2, 2, panel.shape[-1])
    turn, used, new = panel[:, k : k + 3], group.used.to(panel), panel.new_zeros(cameras)
    squares = (turn.square().sum((1, 2)) * used).sum(-1)
    mean = new.index_add(0, group.camera, squares) / new.index_add(0, group.camera, used.sum(-1)).clamp(min=1)
    return torch.cat([shift, turn * (2 / mean.clamp(min=TINY)).sqrt()[group.camera, None, None, None]], dim=1)


def _derivatives(found: RigFit, group: Group, panel: Tensor, B: Tensor) -> tuple[Tensor, Tensor]:
    """The sums over the corners of each view `(n, b, s)` and `(n, b, 6)`, with weighted moves."""
    problem, parameters, k = found.problem, found.parameters, group.size
    sums = torch.einsum("nkap,nbap->nbk", panel[:, :-1], B)
    by_pose = sums[..., k:] @ problem.composition(group, found.shared, found.local)  # the camera's, the moment's
    own = torch.cat([sums[..., :k], by_pose[..., :POSE]], dim=-1)
    shared = own.new_zeros(*own.shape[:2], parameters.size + POSE)
    shared.scatter_(2, group.columns.unsqueeze(1).expand(-1, own.shape[1], -1), own)
    shared = shared[..., : parameters.size]  # behind them stands the first camera's pose, which is none
    if parameters.points:
        R, _ = problem.view_poses(group, found.shared, found.local)
        by_point = by_displacement(panel[:, None, -4:-1], R.unsqueeze(1))[:, 0]  # (n, 3, 2, N)
        shared[..., parameters.few :] = torch.einsum("njap,nbap->nbpj", by_point, B).flatten(-2)
    return shared, by_pose[..., POSE:]
