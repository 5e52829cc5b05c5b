"""Which views to turn over together, where perspective hardly tells their two poses apart.

Through a long lens nearly every view fits about as well in its other pose, and better once the focal length has moved
to suit it; and several views turned over at once may end lower where none does alone. With the pose of a view
eliminated its cost is nearly quadratic in the shared parameters: a bowl for each of its poses. The lowest place of a
sum of bowls has a closed form, so that many choices of poses are compared without running the solver: each view turned
over alone, and those that are lower in their other pose a little way along the directions in which the parameters are
known least. From each choice, parameters and poses are improved in turn, by the bowls; the few that promise most are
handed on.
"""

import torch
from torch import Tensor

from diffproj.calibration.fitting.bowls import Bowls, bowls, of_prior
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.fitting.two_poses import mean_squares, near_rivals, view_costs
from diffproj.calibration.least_squares.solver import Solution
from diffproj.calibration.problem.parametrisation import Pose

HANDED_ON = 3
"""Choices of poses of a camera that are handed on."""
PROMISING = 3.0
"""Residual variances by which a choice may cost more, by the bowls, than the present one, for these are no bowls."""
SOFT_DIRECTIONS, FAR_ALONG = 3, (-2.0, -1.0, 1.0, 2.0)
"""Directions in which the parameters are known least, and how many deviations along them poses are chosen."""
ALONE = 64
"""Views of a camera of which each is turned over alone."""
TURNS = 6
"""How often parameters and poses are improved in turn."""


def choices(task: Task, solution: Solution) -> tuple[Tensor, Pose]:
    """Cameras `(n,)` in their order, some more than once, and poses `(n, V, ...)` from which each may end lower."""
    p, v, other = near_rivals(task, solution)
    rival = torch.zeros_like(task.used[..., 0])
    if len(p) == 0:
        return p, tuple(z[:0] for z in solution.local)
    rival[p, v] = True
    turned = tuple(z.index_put((p, v), new) for z, new in zip(solution.local, other, strict=True))
    here, there = (bowls(task, solution.shared, poses) for poses in (solution.local, turned))
    rival &= there.c.isfinite() & here.c.isfinite()
    there = Bowls(
        *(
            torch.where(rival.reshape(*rival.shape, *(1,) * (a.ndim - 2)), a, b)
            for a, b in zip(there, here, strict=True)
        )
    )
    pulled = of_prior(task, solution.shared)

    used = task.used.any(-1)
    variance = torch.where(used, mean_squares(task, view_costs(task, solution.shared, solution.local)), torch.nan)
    variance = variance.nanmedian(-1).values

    every = _alone(rival, there.c - here.c)
    along = _soft(here, pulled, variance)
    chosen = torch.cat([torch.zeros_like(every[:1]), every, _lower(here, there, along) & rival])
    costs, x = _lowest(here, there, pulled, chosen)
    for _ in range(TURNS):
        again = _lower(here, there, x) & rival
        cost, x = _lowest(here, there, pulled, again)
        chosen, costs = torch.cat([chosen, again]), torch.cat([costs, cost])
    limit = costs[0] + PROMISING * variance
    rows, poses = [], []
    open_ = chosen.any(-1) & (costs <= limit)
    for _ in range(HANDED_ON):
        best = torch.where(open_, costs, torch.inf).argmin(0)
        number = torch.arange(len(best), device=best.device)
        one, some = chosen[best, number], open_[best, number]
        rows.append(some.nonzero().flatten())
        mask = one[some]
        poses.append(
            tuple(
                torch.where(mask.reshape(*mask.shape, *(1,) * (a.ndim - 2)), b[some], a[some])
                for a, b in zip(solution.local, turned, strict=True)
            )
        )
        open_ &= (chosen != one).any(-1)
    return torch.cat(rows), tuple(torch.cat(parts) for parts in zip(*poses, strict=True))


def _alone(rival: Tensor, more: Tensor) -> Tensor:
    """Choices `(C, P, V)` of one view each, of those that cost the least more."""
    count = min(rival.shape[1], ALONE)
    first = torch.where(rival, more, torch.inf).topk(count, largest=False).indices
    one = torch.zeros(count, *rival.shape, dtype=torch.bool, device=rival.device)
    return one.scatter(2, first.mT.unsqueeze(-1), value=True) & rival


def _soft(here: Bowls, prior: tuple[Tensor, Tensor], variance: Tensor) -> Tensor:
    """Places `(C, P, q)` some deviations along the directions that are known least."""
    H = here.H.sum(1) + prior[0]
    scale = H.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(H * scale.unsqueeze(-1) * scale.unsqueeze(-2))
    count = min(SOFT_DIRECTIONS, values.shape[-1])
    step = (variance.unsqueeze(-1) / values[:, :count].clamp(min=1e-12)).sqrt()
    steps = (scale.unsqueeze(-1) * vectors[..., :count] * step.unsqueeze(-2)).permute(2, 0, 1)
    return torch.cat([far * steps for far in FAR_ALONG])


def _lower(here: Bowls, there: Bowls, x: Tensor) -> Tensor:
    """Which views are lower in their other pose `(C, P, V)` at parameters `(C, P, q)`."""

    def at(bowls: Bowls) -> Tensor:
        turned = torch.einsum("pvij,cpj->cpvi", bowls.H, x) / 2 + bowls.g
        return bowls.c + (turned * x.unsqueeze(-2)).sum(-1)

    return at(there) < at(here)


def _lowest(here: Bowls, there: Bowls, prior: tuple[Tensor, Tensor], chosen: Tensor) -> tuple[Tensor, Tensor]:
    """The lowest costs `(C, P)` of choices `(C, P, V)`, and at which parameters `(C, P, q)`."""
    which = chosen.to(here.c)
    H = (here.H.sum(1) + prior[0]) + torch.einsum("cpv,pvij->cpij", which, there.H - here.H)
    g = (here.g.sum(1) + prior[1]) + torch.einsum("cpv,pvi->cpi", which, there.g - here.g)
    c = here.c.sum(1) + torch.einsum("cpv,pv->cp", which, (there.c - here.c).nan_to_num())
    scale = H.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    scaled = H * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    scaled.diagonal(dim1=-2, dim2=-1).add_(1e-12)
    L, failed = torch.linalg.cholesky_ex(scaled)
    x = -scale * torch.cholesky_solve((scale * g).unsqueeze(-1), L).squeeze(-1)
    cost = c + (g * x).sum(-1) / 2
    sound = (failed == 0) & cost.isfinite()
    return torch.where(sound, cost, torch.inf), torch.where(sound.unsqueeze(-1), x, 0.0)
