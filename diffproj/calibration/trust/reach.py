"""Whether the lens of a fit reaches its own corners, and the whole image.

The solver evaluates the lens's equations wherever it comes, also beyond the radius at which the lens folds back or its
denominator vanishes: the residuals may be small there, but no pixel has one ray. A lens that folds inside the corners
that it was fitted to is no calibration.
"""

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import Pose
from diffproj.calibration.results.border import border_with_rays
from diffproj.lens.brown_domain import clearly_one_to_one
from diffproj.lens.models import MODELS


def folds_at_corners(task: Task, shared: Tensor, poses: Pose) -> Tensor:
    """Whether the lens ends before the outermost corner that is used `(P,)`."""
    model = MODELS[task.lens]
    if model.kind is None:
        return torch.zeros_like(task.used[:, 0, 0])
    with torch.no_grad():
        shared, (R, t) = shared.detach(), (z.detach() for z in poses)
        coefficients = shared[:, 4 : 4 + model.count]
        x, y, z = ((R @ task.points.mT) + t.unsqueeze(-1)).unbind(2)
        side = torch.hypot(x, y)
        extent = torch.atan2(side, z) if not model.perspective else side / torch.where(z > 0, z, torch.nan)
        outermost = torch.where(task.used, extent, 0.0).nan_to_num(torch.inf).amax((1, 2))
        if model.count in (4, 5) and bool(clearly_one_to_one(coefficients, outermost).all()):
            return torch.zeros_like(task.used[:, 0, 0])  # a tenth of the time that the domain takes
        return ~(outermost <= model.lens(coefficients.clone()).domain)  # type: ignore[union-attr]


def reach_of(found: Fit, size: tuple[int, int]) -> Tensor:
    """Which part of the image's border the lens reaches `(P,)`; -1 where not even its own corners, or no minimum."""
    task, solution = found.task, found.solution
    lost = folds_at_corners(task, solution.shared, solution.local) | (solution.status != Status.CONVERGED)
    return torch.where(lost, -1.0, reaches_image(task, solution.shared, size))


def lost_corners(task: Task, shared: Tensor, poses: Pose) -> Tensor:
    """Which of the used corners the lens does not project `(P, V, N)`."""
    camera = task.parameters.unpack(shared.detach().clone(), tuple(z.detach().clone() for z in poses))
    return task.used & ~camera.project(task.points.clone())[1]


def reaches_image(task: Task, shared: Tensor, size: tuple[int, int]) -> Tensor:
    """Which part of the image's border has rays `(P,)`, from 0 to 1."""
    with torch.no_grad():
        upright = torch.eye(3, dtype=shared.dtype, device=shared.device).expand(len(shared), 3, 3)
        pose = upright, torch.zeros_like(upright[..., 0])
        return border_with_rays(task.parameters.unpack(shared.detach().clone(), pose), size)
