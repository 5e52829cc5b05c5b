"""The covariance of what `adjust` found: of intrinsics and pose together, and what nothing tells of them."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.evidence.adjustment import pose_covariance
from diffproj.calibration.evidence.curved import further
from diffproj.calibration.evidence.descent import Found, Task, reach, surveyed
from diffproj.calibration.evidence.problem import jacobian
from diffproj.calibration.evidence.undetermined import Lacking, decisive, inverse, natural, undetermined
from diffproj.calibration.least_squares.robust import robust_matrices
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.covariance import Covariance, zero_where_infinite


class PoseErrors(NamedTuple):
    """How intrinsics and the pose err, in their order, the pose by `(omega, tau)` about a middle.

    Attributes:
        own: the covariance that evidence and priors leave `(P, s + 6, s + 6)`.
        follow: how both follow an error of intrinsics that are held `(P, s + 6, s)`.
        arm: `R middle` `(P, 3)`.
        lacking: which of the s intrinsics, and in the last place whether the pose, nothing tells `(P, s + 1)`.
        names: what is lacking, by name.
    """

    own: Tensor
    follow: Tensor
    arm: Tensor
    lacking: Tensor
    names: list[Lacking]


def pose_errors(
    task: Task,
    found: Found,
    middle: Tensor,
    *,
    follows: bool = True,
    curved: bool = False,
    level: Tensor | None = None,
) -> PoseErrors:
    """How what was found errs.

    Args:
        task: of the adjustment.
        found: where it ended.
        middle: what poses turn about `(3,)`.
        follows: whether `follow` is asked for; not what it should be if not.
        curved: whether the direction that is known worst is followed on the curve: see `further`.
        level: the variance of a residual of the evidence `(P,)`; 1 if left out.
    """
    parameters, values, T = found.parameters, found.values, found.basis
    s, P = parameters.camera.size, len(values)
    H, M = _normal_matrices(task, found, sorted({*task.known.columns, *(range(s) if follows else ())}))
    M = M if level is None else level[:, None, None] * M
    precision = found.prior.precision.detach()
    scale, placed = natural(values, reach(task, values)), surveyed(task)[1].any(-1)
    unit = decisive(T, scale, precision.diagonal(dim1=-2, dim2=-1), placed)
    told, known = T.mT @ H @ T, T.mT @ precision @ T
    Hr, lost, vectors = inverse(told + known, unit)
    reduced = Hr @ (T.mT @ (M + precision) @ T) @ Hr
    C = T @ reduced @ T.mT
    if curved:
        more = further(task, found, reduced, unit, told, known).unsqueeze(-1)
        C = C + more @ more.mT
    held = torch.tensor([at not in task.known.columns for at in range(s)], device=values.device).to(values)
    follow = torch.nn.functional.pad(torch.diag(held), (0, 0, 0, POSE)) - T @ Hr @ (T.mT @ H[..., :s] * held)
    unknown, names = undetermined(parameters, values, T, scale, unit, lost, vectors)
    names = [
        each if code != Status.DIVERGED else Lacking() for each, code in zip(names, found.status.tolist(), strict=True)
    ]
    camera = parameters.unpack(values, (P,), None)
    R = camera.R

    def pose(step: Tensor) -> Tensor:
        again = parameters.unpack(torch.cat([values[:, :-POSE], values[:, -POSE:] + step], dim=-1), (P,), None)
        turn = again.R @ R.mT
        omega = torch.stack(
            [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], -1
        )
        return torch.cat([omega / 2, (again.R @ (middle - again.center).unsqueeze(-1)).squeeze(-1)], dim=-1)

    J = jacobian(pose, values.new_zeros(P, POSE))[1].permute(1, 2, 0)
    to_pose = torch.eye(values.shape[-1], dtype=values.dtype, device=values.device).repeat(P, 1, 1)
    to_pose[:, -POSE:, -POSE:] = J
    lacking = torch.cat([unknown[:, :s], unknown[:, s:].any(-1, keepdim=True)], dim=-1)
    arm = (R @ middle.unsqueeze(-1)).squeeze(-1)
    return PoseErrors(to_pose @ C @ to_pose.mT, to_pose @ follow, arm, lacking, names)


def covariance_of(task: Task, found: Found, calibration: Calibration | None) -> tuple[Covariance, list[Lacking]]:
    """The covariance of intrinsics and pose, and what nothing tells of each camera."""
    s, P = found.parameters.camera.size, len(found.values)
    middle = found.parameters.unpack(found.values, (P,), None).center.mean(0)
    known = calibration is not None and calibration.has_covariance
    C, follow, arm, lacking, names = pose_errors(task, found, middle, follows=known, curved=True)
    if calibration is not None and known:
        # Intrinsics that are held err as the calibration says, and what is found follows them.
        own = calibration.covariance_of_kept_poses.shared[..., :s, :s]
        own = zero_where_infinite(own).expand(*task.batch, s, s).reshape(P, s, s)
        C = C + follow @ own @ follow.mT
    gone = torch.cat([lacking[:, :s], lacking[:, s:].expand(-1, POSE)], dim=-1)
    C = torch.where(gone.unsqueeze(-1) | gone.unsqueeze(-2), 0.0, C)
    batch = task.batch
    joint, arm, lacking = (part.reshape((*batch, *part.shape[1:])) for part in ((C + C.mT) / 2, arm, lacking))
    return pose_covariance(found.parameters.camera.names, joint, arm, middle, lacking), names


def _normal_matrices(task: Task, found: Found, columns: Sequence[int]) -> tuple[Tensor, Tensor]:
    """`H` and `M` of all parameters `(P, q, q)` without the priors: see `robust.py`."""
    evidence = task.evidence(found.parameters, (), columns)
    P, q = found.values.shape
    H = found.values.new_zeros(P, q, q)
    if not task.pieces:
        return H, H
    value, slopes = evidence.along(found.values)
    rows = value.new_zeros(P, q, *value.shape[1:])
    rows[:, list(columns)] = slopes.movedim(0, 1)
    M, start = H, 0
    for piece, block in zip(task.pieces, evidence.blocks(found.values), strict=True):
        count, k = block.shape[1:]
        part = rows[:, :, start : start + count, :k]
        here = robust_matrices(getattr(piece, "loss", None), block, part)
        H, M, start = H + here[0], M + here[1], start + count
    sound = H.isfinite().all(-1).all(-1)[:, None, None]
    return torch.where(sound, H, 0.0), torch.where(sound, M, 0.0)
