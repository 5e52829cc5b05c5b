"""How much more the views contradict each other than independent corners would: the dispersion of a calibration.

The residuals tell the noise of a corner. That is the whole error only where corners err independently. A board that is
not flat, a corner detector misled by blur or a lens that the model does not reach give errors that go together within a
view, and they shift the parameters far more than their share in the residuals says: on real photographs, two to three
times as much.

Each view says for itself where it wants the shared parameters: with its pose eliminated, its pull is u_v, and under
independent corners the covariance of the pull is K_v. Over all views

    phi = sum u_v^T K_v^+ u_v / (sum rank K_v - free parameters)

is 1 if corners err independently (the analysis of variance: between views over within views), and the factor by which
the variances of the parameters are too small if not. It is an average over all directions of the parameters, and views
may contradict each other more on some than on others: errors that are smooth over a board look like another
perspective, and pull at the focal lengths and the principal point more than at the lens. These are asked for
themselves, too. Each view moves them by d_v = S^-1 u_v, S the sum of the views' normal matrices, and

    psi = mean over these parameters of  sum d_v^2 / its expectation if corners err independently

raises phi where that stands out of chance, by as much as psi / phi does so, too.

What the result exceeds 1 by is taken for what it is where it stands out of chance, and shrunk where it does not; and it
counts more where few views tell it: on random subsets of real sets of views, errors then are what they are said to be.

Where the points of the target are free they follow what the views want, and these pull less. What is compared then is
how far each view moves the focal lengths and the principal point, to first order, with how far it would if corners
erred independently: with w_v the derivative of such a parameter by the residuals r_v of a view, and M_v what the fit of
everything leaves of independent errors there,

    phi = mean over the parameters of  sum (w_v^T r_v)^2 / (s^2 sum w_v^T M_v w_v)
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.eliminated import local_inverse, reduced
from diffproj.calibration.least_squares.losses import slope_and_bend
from diffproj.calibration.problem.parametrisation import INTRINSICS
from diffproj.calibration.problem.shape import by_displacement

FEW_VIEWS = 2.0
"""The excess counts `1 + FEW_VIEWS / (views - 1)` fold."""
FEW_VIEWS_OF_A_SHAPE = 6.0
"""The same where the target's points are free: what these take from few views is not seen in their residuals. Of
surveyed landmarks it is, which stay near where they were surveyed."""
BELIEF = 4.0
"""Degrees of freedom below which phi counts little: what one or two of them say is mostly chance."""
FAR_VIEWS = 2.0
"""How many times larger the variance of such ratios is than for independent corners: a few views err most."""
STANDS_OUT = 5.0
"""Deviations of phi for independent corners, beyond 1, at which half of what psi tells counts."""
SINGULAR = 1e-9
"""Eigenvalue of K_v, relative to the largest, below which the view says nothing in this direction."""


def dispersion(found: Fit, pulls: "Pulls | None" = None) -> Tensor:
    """The factor `(P,)`, at least 1, on the covariance that independent corners would give.

    1 where it is not known: with one view, or where no shared parameter is free.

    Args:
        found: the fit.
        pulls: those of its views, where they are known already.
    """
    task, solution = found.task, found.solution
    shared, local = solution.shared.detach(), tuple(z.detach() for z in solution.local)
    if not _views_tell(task):
        return torch.ones_like(shared[:, 0])
    few_views = FEW_VIEWS_OF_A_SHAPE if task.free and not task.surveyed else FEW_VIEWS
    with torch.inference_mode():
        pulls = pulls_of(found) if pulls is None else pulls
        if pulls is None:
            factor = believed(_moved_intrinsics(found, shared, local), few_views)
        else:
            told = contradiction(*pulls)
            if task.basis is None or bool((task.basis[:, : len(INTRINSICS)] != 0).any()):
                told = _more(told, _of_intrinsics(pulls, task.basis))
            factor = believed(told, few_views)
    return factor.clone()


class Contradiction(NamedTuple):
    """How much views contradict each other: phi `(P,)`, its degrees of freedom, and how many views say something."""

    phi: Tensor
    spare: Tensor
    views: Tensor


def believed(found: Contradiction, few_views: float = FEW_VIEWS) -> Tensor:
    """The factor on the covariance that phi is taken for; larger where there are few views."""
    phi, spare, views = found
    excess = (phi - 1).clamp(min=0) * spare.square() / (spare.square() + BELIEF**2)
    excess = excess.pow(3) / (excess.square() + 2 / spare)  # 2 / spare: phi's own variance for independent corners
    factor = 1 + excess * (1 + few_views / (views - 1).clamp(min=1))
    return torch.where((spare >= 1) & factor.isfinite(), factor, 1.0)


class Pulls(NamedTuple):
    """Where V views of P cameras, whose poses are eliminated, want q shared parameters.

    Attributes:
        u: their pulls `(P, V, q)`.
        S: their part of the normal matrix `(P, V, q, q)`.
        K: the covariance of their pulls if corners err independently `(P, V, q, q)`.
        share: how much each counts `(P, V)`.
        total: the normal matrix `(P, q, q)`, with a prior's.
        pull: the sum of the pulls `(P, q)`, with a prior's.
    """

    u: Tensor
    S: Tensor
    K: Tensor
    share: Tensor
    total: Tensor
    pull: Tensor


def _views_tell(task: Task) -> bool:
    """Whether some views could contradict each other."""
    return (task.basis is None or task.basis.shape[-1] > 0) and task.used.shape[1] > 1


@torch.inference_mode()
def pulls_of(found: Fit) -> Pulls | None:
    """Those of all views; `None` where they tell nothing, or the target's points are free."""
    task, solution = found.task, found.solution
    if task.free or not _views_tell(task):
        return None
    shared, local = solution.shared.detach(), tuple(z.detach() for z in solution.local)
    rows, residual, pull_weight, variance = _weighted(task, shared, local, found.degrees_of_freedom())
    s = shared.shape[-1]
    if task.basis is not None:
        rows = torch.cat([torch.einsum("psq,pvskn->pvqkn", task.basis, rows[:, :, :s]), rows[:, :, s:]], dim=2)
        s = task.basis.shape[-1]

    def products(weight: Tensor, columns: Tensor) -> Tensor:
        return (rows * weight[:, :, None, None]).flatten(-2) @ columns.flatten(-2).mT

    N = products(pull_weight, torch.cat([rows, residual.unsqueeze(2)], dim=2))
    K = products(variance, rows)
    F = N[..., :s, s:-1] @ local_inverse(N[..., s:, s:-1])[0]  # E_v W_v^-1: eliminates the pose
    u = N[..., :s, -1] - (F @ N[..., s:, -1:]).squeeze(-1)
    S = N[..., :s, :s] - F @ N[..., s:, :s]
    leaning = F @ K[..., s:, :s]
    K = K[..., :s, :s] - leaning - leaning.mT + F @ K[..., s:, s:] @ F.mT
    sound = task.used.any(-1) & K.isfinite().all(-1).all(-1) & u.isfinite().all(-1)
    u = torch.where(sound.unsqueeze(-1), u, 0.0)
    S, K = (torch.where(sound[..., None, None], M, 0.0) for M in (S, K))

    share = torch.ones_like(u[..., 0]) if task.shares is None else task.shares

    # Where the minimum is another's, the plane objective's say, the pulls do not sum to 0: they are taken from where
    # they do. A prior's pull is among them, and what it determines costs no degree of freedom.
    data = (share[..., None, None] * S).sum(1)
    total, pull = data, (share.unsqueeze(-1) * u).sum(1)
    if task.prior is not None:
        Q, off = task.prior.precision, (task.prior.precision @ (shared - task.prior.mean).unsqueeze(-1)).squeeze(-1)
        T = torch.eye(len(Q[0]), dtype=Q.dtype, device=Q.device) if task.basis is None else task.basis
        total, pull = total + T.mT @ Q @ T, pull + (T.mT @ off.unsqueeze(-1)).squeeze(-1)
    return Pulls(u, S, K, share, total, pull)


def contradiction(u: Tensor, S: Tensor, K: Tensor, share: Tensor, total: Tensor, pull: Tensor) -> Contradiction:
    """How much views contradict each other on all parameters together; the arguments are those of `Pulls`."""
    data = (share[..., None, None] * S).sum(1)
    inverse = torch.linalg.pinv(total, hermitian=True)
    u = u - (S @ (inverse @ pull.unsqueeze(-1)).unsqueeze(1)).squeeze(-1)
    spent = (inverse * data.mT).sum((-2, -1))

    scale = K.diagonal(dim1=-2, dim2=-1).sum(1, keepdim=True).clamp(min=1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(K * scale.unsqueeze(-1) * scale.unsqueeze(-2))
    told = values > SINGULAR * values[..., -1:].clamp(min=1e-300)
    along = (vectors.mT @ (u * scale).unsqueeze(-1)).squeeze(-1)
    squares = torch.where(told, along.square() / torch.where(told, values, 1.0), 0.0).sum(-1)
    squares, told = (share * squares).sum(-1), share.unsqueeze(-1) * told
    spare = (told.sum((-2, -1)) - spent).clamp(min=1e-9)
    return Contradiction(squares / spare, spare, told.amax(-1).sum(-1))


def _more(told: Contradiction, of_intrinsics: Contradiction) -> Contradiction:
    """What all parameters tell, and more where these stand out of chance and the intrinsics alone tell clearly more."""
    beyond = (told.phi - 1).clamp(min=0).square()
    excess = (of_intrinsics.phi / told.phi.clamp(min=1) - 1).clamp(min=0)
    by_chance = FAR_VIEWS * (2 / of_intrinsics.spare + 2 / told.spare)
    more = excess.pow(3) / (excess.square() + by_chance) * beyond / (beyond + STANDS_OUT**2 * 2 / told.spare)
    return told._replace(phi=told.phi * (1 + more))


def _of_intrinsics(pulls: Pulls, basis: Tensor | None) -> Contradiction:
    """How much views contradict each other on the focal lengths and the principal point, whatever a prior says."""
    u, S, _, share = pulls[:4]
    total, pull = (share[..., None, None] * S).sum(1), (share.unsqueeze(-1) * u).sum(1)
    own, W = in_own_units(pulls._replace(total=total, pull=pull))
    u, K = own.u, left_of_noise(own)
    moves = (W if basis is None else basis @ W)[:, : len(INTRINSICS)].unsqueeze(1)
    moved = (share.unsqueeze(-1) * (moves @ u.unsqueeze(-1)).squeeze(-1).square()).sum(1)
    of_view = share.unsqueeze(-1) * ((moves @ K) * moves).sum(-1).clamp(min=0)
    expected, free = of_view.sum(1), (of_view > 0).any(1)
    phi = torch.where(free, moved / torch.where(free, expected, 1.0), 0.0).sum(-1) / free.sum(-1).clamp(min=1)
    # Views tell these parameters unequally: the fewer do, the more is chance (Satterthwaite 1946).
    alike = torch.where(share > 0, 1 / share, 0.0).unsqueeze(-1)
    equal = torch.where(free, expected.square() / (alike * of_view.square()).sum(1).clamp(min=1e-300), torch.inf)
    spare = _directions(basis) * (equal.amin(-1) - 1)
    return Contradiction(phi, torch.where(free.any(-1), spare, 0.0).clamp(min=1e-9), equal.amin(-1))


def in_own_units(pulls: Pulls) -> tuple[Pulls, Tensor]:
    """The pulls about their common minimum, in units in which the normal matrix is 1.

    With them those units `W (P, q, q)`, `W^T total W = 1`; directions that nothing tells are 0.
    """
    u, S, K, share, total, pull = pulls
    scale = total.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    values, vectors = torch.linalg.eigh((total * scale.unsqueeze(-1) * scale.unsqueeze(-2)).nan_to_num(0.0, 0.0, 0.0))
    known = values > SINGULAR * values[:, -1:].clamp(min=1e-300)
    roots = torch.where(known, torch.where(known, values, 1.0).rsqrt(), 0.0)
    W = scale.unsqueeze(-1) * vectors * roots.unsqueeze(-2)
    across = W.mT.unsqueeze(1)
    S, K = across @ S @ W.unsqueeze(1), across @ K @ W.unsqueeze(1)
    u = (across @ u.unsqueeze(-1)).squeeze(-1) - (S @ (W.mT @ pull.unsqueeze(-1)).unsqueeze(1)).squeeze(-1)
    return Pulls(u, S, K, share, W.mT @ total @ W, torch.zeros_like(pull)), W


def left_of_noise(own: Pulls, copied: Tensor | None = None) -> Tensor:
    """The covariance `(P, V, q, q)` that pulls in their own units have after the fit if corners err independently.

    Args:
        own: the pulls.
        copied: how much of a view's noise all views that are alike have `(P, V)`, from 1, where they are copies, to its
            share, where each has a noise of its own; 1 if left out.
    """
    S, K = own.S, own.K
    copied = torch.ones_like(own.share) if copied is None else copied
    of_all = ((own.share * copied)[..., None, None] * K).sum(1, keepdim=True)
    return K - copied[..., None, None] * (K @ S + S @ K) + S @ of_all @ S


def _moved_intrinsics(found: Fit, shared: Tensor, local: tuple[Tensor, ...]) -> Contradiction:
    """Phi `(P,)` where points are free, its degrees of freedom, and how many views say something."""
    task, few = found.task, found.task.parameters.few
    share = torch.ones_like(local[1][..., 0]) if task.shares is None else task.shares
    rows, residual, slope, variance = _weighted(task, shared, local, found.degrees_of_freedom())
    weight = torch.ones_like(slope) if task.weights is None else task.weights
    inverse_weight = torch.where(weight > 0, 1 / torch.where(weight > 0, weight, 1.0), 0.0)
    level = (variance * inverse_weight).amax((1, 2))
    root = weight.sqrt()[:, :, None]
    residual, rows = residual * (slope * inverse_weight).unsqueeze(2) * root, rows * root.unsqueeze(3)
    by_point = by_displacement(rows[:, :, -3:], local[0])
    # How a parameter follows each residual: a row of the inverse of the normal matrix, times the derivatives.
    S = reduced(found.solution.equations, task.basis, task.shares)[0].detach()
    basis = task.basis
    columns = torch.eye(shared.shape[-1], dtype=S.dtype, device=S.device)[:, : len(INTRINSICS)].expand(len(S), -1, -1)
    columns = columns if basis is None else basis.mT @ columns
    scale = S.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt().unsqueeze(-1)
    inverse = torch.linalg.pinv((S * scale * scale.mT).nan_to_num(0.0, 0.0, 0.0), hermitian=True) * scale * scale.mT
    follow = inverse @ columns
    follow = follow if basis is None else basis @ follow  # (P, s, 4)
    moves = follow[:, few:].unflatten(1, (-1, 3))
    w = torch.einsum("psi,pvskn->pvikn", follow[:, :few], rows[:, :, :few])
    w = w + torch.einsum("pnji,pvjkn->pvikn", moves, by_point)
    pose = rows[:, :, few:].flatten(-2)
    inverse_W = local_inverse(pose @ pose.mT)[0]
    flat = w.flatten(-2)
    flat = flat - flat @ pose.mT @ inverse_W @ pose
    w = flat.unflatten(-1, w.shape[-2:])
    pull = (flat @ residual.flatten(-2).unsqueeze(-1)).squeeze(-1)
    told = torch.einsum("pvikn,pvskn->pvis", w, rows[:, :, :few])
    told = torch.cat([told, torch.einsum("pvikn,pvjkn->pvinj", w, by_point).flatten(-2)], dim=-1)
    told = told if basis is None else told @ basis.unsqueeze(1)
    expected = flat.square().sum(-1) - ((told @ inverse.unsqueeze(1)) * told).sum(-1)
    squares = (share.unsqueeze(-1) * pull.square()).sum(1)
    expected = level.unsqueeze(-1) * (share.unsqueeze(-1) * expected.clamp(min=0)).sum(1)
    free = (follow[:, : len(INTRINSICS)].diagonal(dim1=-2, dim2=-1) > 0) & (expected > 0)
    ratio = torch.where(free, squares / torch.where(free, expected, 1.0), 0.0)
    views = task.used.any(-1).sum(-1)
    phi = ratio.sum(-1) / free.sum(-1).clamp(min=1)
    counted = (share * task.used.any(-1)).sum(-1)
    return Contradiction(phi, torch.where(free.any(-1), _directions(basis) * (counted - 1), 0.0), views)


def _directions(basis: Tensor | None) -> Tensor | int:
    """In how many directions `(P,)` focal lengths and principal point move that differ: they tell two at most."""
    if basis is None:
        return 2
    return (basis[:, : len(INTRINSICS)] != 0).any(1).sum(-1).clamp(max=2)


def _weighted(
    task: Task, shared: Tensor, local: tuple[Tensor, ...], redundant: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What the pulls are made of.

    Returns:
        Derivatives `(P, V, s + 6, 2, N)` and residuals `(P, V, 2, N)` on the image, in pixels; and for each corner
        `(P, V, N)` its weight in the pull of its view, and the variance of its part of it.
    """
    panel = replace(task, objective="image").problem.linearise(shared, local)
    rows, residual = panel[:, :, :-1], panel[:, :, -1]
    weight = torch.ones_like(residual[:, :, 0])
    if task.weights is not None and task.objective == "image":
        weight = task.weights
    slope = weight
    if task.loss is not None:
        squared = residual.square().sum(2)
        if task.objective == "plane":
            squared = task.problem.linearise(shared, local)[:, :, -1].square().sum(2)
        slope = weight * slope_and_bend(task.loss, squared)[0]
    pulls = torch.where(weight > 0, slope.square() / torch.where(weight > 0, weight, 1.0), 0.0)
    pulls = pulls if task.shares is None else pulls * task.shares.unsqueeze(-1)
    level = (pulls * residual.square().sum(2)).sum((-2, -1)) / redundant.clamp(min=1)
    return rows, residual, slope, weight * level[:, None, None]
