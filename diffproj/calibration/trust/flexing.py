"""Whether the corners of a view err together, another way in each view, as those of a board that bends.

A sheet of paper in a hand, or held by magnets, is bent otherwise in each photograph; so is what a shutter reads row
after row of a board that moves. To a single rigid board such corners seem to scatter, but neighbours do so alike: what
a polynomial over the board explains of a view's residuals is far more than it would of noise.
"""

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.problem.parametrisation import INTRINSICS, POSE
from diffproj.calibration.results.remark import Kind, Remark

ORDER = 3
"""Highest degree of the polynomial, in both coordinates of the board together."""
LEAST_SPARE = 10
"""Degrees of freedom that must be left in a view with the polynomial for it to be asked."""
MOSTLY = 0.5
"""Part of the variance of a corner that goes together from which on it is the word for it. Of noise it was -.09
to .04 in simulated views; of wrong corners, 3 % of them 80 px off, up to .17."""
LEAST_PX = 0.3
"""Scatter of a coordinate above which it is asked for: less is not more than a detector's."""


def together(found: Fit, which: Tensor) -> Tensor:
    """The part of a corner's variance that is smooth over the board, in each view by itself `(n,)`; NaN if not told.

    Args:
        found: the fit of a flat target.
        which: the cameras, `(n,)`.
    """
    task, solution = found.task, found.solution
    with torch.no_grad():
        poses = tuple(z.detach()[which] for z in solution.local)
        residual = task.part(which).problem.linearise(solution.shared.detach()[which], poses)[:, :, -1]
        used = task.used[which].to(residual)
        terms = _polynomial(task.points).to(residual)  # (N, k)
        of_view = terms.mT @ (used.unsqueeze(-1) * terms)  # (n, V, k, k)
        size, turn = torch.linalg.eigh(of_view)
        free = size > 1e-9 * size[..., -1:].clamp(min=1e-300)
        pull = turn.mT @ (terms.mT @ (used.unsqueeze(-1) * residual.mT))  # (n, V, k, 2)
        explained = torch.where(free.unsqueeze(-1), pull.square() / size.unsqueeze(-1).abs(), 0.0).sum((-2, -1))
        total = (used.unsqueeze(2) * residual.square()).sum((-2, -1))
        spare, left = 2 * used.sum(-1) - POSE, 2 * used.sum(-1) - 2 * free.sum(-1)
        told = left >= LEAST_SPARE
        rest, total, left, spare = (
            torch.where(told, part, 0.0).sum(-1) for part in (total - explained, total, left, spare)
        )
        return 1 - rest / left * spare / total


def of_a_flexing_board(found: Fit, p: int, sigma: float, repeated: float) -> Remark | None:
    """The remark on camera `p`, if there is one.

    Args:
        found: the fit.
        p: which of its cameras.
        sigma: the scatter of a corner's coordinate, px.
        repeated: the part of the residuals' sum of squares that is alike in all views.
    """
    if sigma <= LEAST_PX or found.task.objective == "plane" or _holds_a_camera(found, p):
        return None
    part = float(together(found, torch.tensor([p], device=found.task.used.device)))
    if not part > MOSTLY + repeated:
        return None
    return Remark(
        f"the corners scatter by {sigma:.1f} px in each coordinate, neighbours alike and each view another way "
        f"({100 * part:.0f} % of the variance), as on a board that bends, or that moves while the shutter reads row "
        "after row: glue it to glass or aluminium, and photograph it at rest",
        Kind.FLEXING,
        "the corners of a view err together, as on a board that bends",
    )


def _holds_a_camera(found: Fit, p: int) -> bool:
    """Whether focal lengths or principal point are held: of wrong ones residuals are smooth in each view, too."""
    basis = found.task.basis
    return basis is not None and not bool((basis[p, : len(INTRINSICS)] != 0).any(-1).all())


def _polynomial(points: Tensor) -> Tensor:
    """All products of powers of the board's coordinates `(N, k)` up to `ORDER`, for coordinates from -1 to 1."""
    xy = points[:, :2]
    low, high = xy.amin(0), xy.amax(0)
    x, y = ((xy - (low + high) / 2) / ((high - low) / 2).clamp(min=1e-300)).unbind(-1)
    return torch.stack([x**i * y**j for i in range(ORDER + 1) for j in range(ORDER + 1 - i)], dim=-1)
