"""Two fits to the same corners: what these cost in each, and one fit with some of the cameras of the other."""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.second_look import truncated
from diffproj.calibration.fitting.two_poses import replaced, view_costs
from diffproj.calibration.least_squares.solver import Prior


def unrestrained_cost(found: Fit) -> Tensor:
    """What corners and earlier knowledge cost `(P,)`, without what only restrains a lens."""
    task, (shared, poses) = found.task, (found.solution.shared, found.solution.local)
    if task.prior is None or task.prior.known is None:
        return found.solution.cost
    costs = view_costs(task, shared, poses)
    costs = (costs if task.shares is None else costs * task.shares).sum(-1)
    off = (shared - task.prior.mean).unsqueeze(-1)
    return costs + (off.mT @ task.prior.known @ off).flatten() / 2


def costs(found: Fit, other: Fit, which: Tensor, reject: float | None) -> tuple[Tensor, Tensor]:
    """What some cameras cost `(n,)` in one fit and in the other without restraint, whichever corners each rejects."""
    if reject is not None:
        return truncated(found, other, which, reject)
    return unrestrained_cost(found)[which], unrestrained_cost(other)


def put(found: Fit, which: Tensor, other: Fit, taken: Tensor) -> Fit:
    """The fit with some cameras `(n,)` replaced by the others that are taken, their priors included."""
    if len(which) == 0:
        return found
    task = found.task
    used, rejected = task.used.clone(), found.rejected.clone()
    used[which], rejected[which] = other.task.used[taken], other.rejected[taken]
    new = Prior(*(a.index_put((which,), b[taken]) for a, b in zip(_prior(found), _prior(other), strict=True)))
    solution = replaced(found.solution, which, other.solution, taken)
    return Fit(replace(task, used=used, prior=new), solution, rejected)


def _prior(found: Fit) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, precision and known precision of the prior, 0 where there is none."""
    shared, prior = found.solution.shared, found.task.prior
    if prior is None:
        nothing = shared.new_zeros(*shared.shape, shared.shape[-1])
        return torch.zeros_like(shared), nothing, nothing
    return prior.mean, prior.precision, prior.precision if prior.known is None else prior.known
