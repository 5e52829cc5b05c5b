"""Whether the lens of a fit reaches its own corners, and the whole image.

The solver evaluates the lens's equations wherever it comes, also beyond the radius at which the lens folds back or its
denominator vanishes: the residuals may be small there, but no pixel has one ray. A lens that folds inside the corners
that it was fitted to is no calibration.

Most lenses reach far more than is asked, which is seen much sooner than the domain and the inverse are worked out.
"""

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import Pose
from diffproj.calibration.results.border import border_with_rays
from diffproj.geometry.camera import Camera
from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.brown_domain import domain_reaches, surely_encloses
from diffproj.lens.models import MODELS

OUTWARD = (1.0, 1.02, 1.05, 1.08, 1.12, 1.16, 1.2, 1.26, 1.35, 1.5, 1.75, 2.1, 2.7)
"""Radii whose image may enclose the whole image, relative to the distorted radius of its farthest corner."""


def folds_at_corners(task: Task, shared: Tensor, poses: Pose) -> Tensor:
    """Whether the lens ends before the outermost corner that is used `(P,)`."""
    model = MODELS[task.lens]
    if model.kind is None:
        return torch.zeros_like(task.used[:, 0, 0])
    with torch.no_grad():
        outermost = _outermost(task, poses)
        coefficients = _coefficients(task, shared)
        if model.kind is BrownConrady:
            return ~domain_reaches(coefficients, outermost)
        return ~(outermost <= model.lens(coefficients.clone()).domain)  # type: ignore[union-attr]


def reach_of(found: Fit, size: tuple[int, int]) -> Tensor:
    """Which part of the image's border the lens reaches `(P,)`; -1 where not even its own corners, or no minimum."""
    task, (shared, poses) = found.task, (found.solution.shared, found.solution.local)
    reach = torch.where(found.solution.status == Status.CONVERGED, 1.0, -1.0).to(shared.dtype)
    rows = ((reach > 0) & ~_surely_reaches(task, shared, poses, size)).nonzero().flatten()
    if len(rows) > 0:
        part, own = found.part(rows), task.part(rows)
        with torch.no_grad():
            camera = _upright(own, part.solution.shared)
            ends = torch.inf if camera.distortion is None else camera.distortion.domain
            sound = _outermost(own, part.solution.local) <= ends
            reach[rows] = torch.where(sound, border_with_rays(camera, size), -1.0)
    return reach


def lost_corners(task: Task, shared: Tensor, poses: Pose) -> Tensor:
    """Which of the used corners the lens does not project `(P, V, N)`."""
    camera = task.parameters.unpack(shared.detach().clone(), tuple(z.detach().clone() for z in poses))
    return task.used & ~camera.project(task.points.clone())[1]


def _surely_reaches(task: Task, shared: Tensor, poses: Pose, size: tuple[int, int]) -> Tensor:
    """Whether it is quick to see that the lens reaches all of its corners and of the image `(P,)`."""
    no = torch.zeros_like(task.used[:, 0, 0])
    if MODELS[task.lens].kind is not BrownConrady:
        return no
    with torch.no_grad():
        coefficients, outermost = _coefficients(task, shared), _outermost(task, poses)
        width, height = (length - 1.0 for length in size)
        corners = shared.new_tensor([(0, 0, 1), (width, 0, 1), (0, height, 1), (width, height, 1)])
        rays = torch.linalg.solve_ex(_upright(task, shared).K, corners.mT)[0]
        farthest = torch.hypot(rays[:, 0], rays[:, 1]).amax(-1)
        radii = farthest.unsqueeze(-1) * farthest.new_tensor(OUTWARD)
        count = len(OUTWARD)
        encloses = surely_encloses(
            coefficients.repeat_interleave(count, 0), radii.flatten(), farthest.repeat_interleave(count)
        ).reshape(radii.shape)
        nearest = radii.gather(-1, encloses.to(torch.uint8).argmax(-1, keepdim=True)).squeeze(-1)
        return encloses.any(-1) & domain_reaches(coefficients, nearest.maximum(outermost))


def _coefficients(task: Task, shared: Tensor) -> Tensor:
    return shared.detach()[:, 4 : 4 + MODELS[task.lens_from(shared)].count]


def _outermost(task: Task, poses: Pose) -> Tensor:
    """How far from the axis the outermost corner that is used is seen, before the lens `(P,)`."""
    R, t = (z.detach() for z in poses)
    x, y, z = ((R @ task.points.mT) + t.unsqueeze(-1)).unbind(2)
    side = torch.hypot(x, y)
    perspective = MODELS[task.lens].perspective
    extent = side / torch.where(z > 0, z, torch.nan) if perspective else torch.atan2(side, z)
    return torch.where(task.used, extent, 0.0).nan_to_num(torch.inf).amax((1, 2))


def _upright(task: Task, shared: Tensor) -> Camera:
    """The cameras `(P,)` without their poses."""
    upright = torch.eye(3, dtype=shared.dtype, device=shared.device).expand(len(shared), 3, 3)
    return task.parameters.unpack(shared.detach().clone(), (upright, torch.zeros_like(upright[..., 0])))
