"""Whether located views could be those of a camera of which nothing is known but itself.

A camera from a file says nothing of the noise of its corners, so that residuals cannot be too large for it. What tells
that it is another one, or its K that of another resolution, is what they look like: with the poses free, other
intrinsics would explain nearly all of them. By how much is predicted by one Gauss-Newton step, as in `leftover.py`, for
each view by itself and for all together, whose camera is one.

A true camera's own views do not pass for that. Of the bundled photographs, located with cameras that were calibrated on
4 to 8 of the others, other intrinsics explain at most half of the sum of squares, and 0.12 px of a coordinate; of
single views up to 0.9, but no more than 0.25 px. With the other camera of the pair, whose focal length differs by 1 %,
it is three quarters and 0.2 px; with a K of twice the resolution, or without the lens, 0.98 and more than 1 px.
"""

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.least_squares.eliminated import local_inverse
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results.mismatch import Mismatch
from diffproj.calibration.trust.compatibility import derivatives
from diffproj.calibration.trust.leftover import f_deviations

SHARE_TOGETHER, PX_TOGETHER, VIEWS_TOGETHER = 0.65, 0.15, 3
SHARE_ALONE, PX_ALONE = 0.8, 0.4
"""Part of the sum of squares, and pixels of a coordinate (RMS), that other intrinsics must explain: of all views
together, from three on, and of one alone, where a board that is not flat looks much the same."""
RARE = 3.72
"""Standard deviations that a normal variable exceeds by chance in 0.01 % of all cases."""
FEWEST_LEFT = 3
"""Degrees of freedom that other intrinsics must leave: with fewer, as of six landmarks, not much could be told."""
SINGULAR = 1e-7
"""Eigenvalue of the normal matrix, relative to the largest, below which nothing is told in this direction."""
PARAMETERS_OF_K = 4


def mismatch_of_a_camera(found: Fit, converged: Tensor, batch: tuple[int, ...]) -> Mismatch:
    """Which located views of the cameras `*B` want other intrinsics than they were given; of those `converged` (P,).

    The deviations of a doubtful view are those of residuals that do not average out over its corners, but only over as
    many numbers as there are intrinsics.
    """
    with torch.no_grad():
        S, u = _normal_equations(found)
        used = found.task.used
        squares = _weighted(found).square().sum((-2, -1))
        spare = (2 * used.sum(-1) - POSE * used.any(-1)).to(squares)
        alone = _Explained(S, u, squares, spare)
        together = _Explained(S.sum(1), u.sum(1), squares.sum(-1), spare.sum(-1))
        all_views = together.told(SHARE_TOGETHER, PX_TOGETHER) & (used.any(-1).sum(-1) >= VIEWS_TOGETHER)
        doubtful = (alone.told(SHARE_ALONE, PX_ALONE) | all_views.unsqueeze(-1)) & used.any(-1)
        doubtful &= converged.unsqueeze(-1)
        ratio = torch.where(doubtful, alone.ratio, torch.nan)
        scale = torch.where(doubtful, (alone.share * spare / alone.rank.clamp(min=1)).clamp(min=1).sqrt(), 1.0)
    return Mismatch(*(part.reshape(*batch, part.shape[-1]) for part in (ratio, doubtful, scale)))


class _Explained:
    """What other intrinsics would explain of residuals, from their normal equations `S (..., s, s)`, `u (..., s)`."""

    def __init__(self, S: Tensor, u: Tensor, total: Tensor, spare: Tensor) -> None:
        size = S.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
        values, vectors = torch.linalg.eigh((S * size.unsqueeze(-1) * size.unsqueeze(-2)).nan_to_num(0.0, 0.0, 0.0))
        told = values > SINGULAR * values[..., -1:].clamp(min=1e-300)
        along = (vectors.mT @ (u * size).unsqueeze(-1)).squeeze(-1)
        explained = torch.where(told, along.square() / torch.where(told, values, 1.0), 0.0).sum(-1)
        self.rank, self.spare = told.sum(-1).to(total), spare
        self.share = (
            torch.where(total > 0, explained / total.clamp(min=1e-300), 0.0).nan_to_num(0.0).clamp(0, 1 - 1e-12)
        )
        self.px = (explained / spare.clamp(min=1)).sqrt()

    @property
    def left(self) -> Tensor:
        """Degrees of freedom that other intrinsics would leave."""
        return self.spare - self.rank

    @property
    def ratio(self) -> Tensor:
        """The residuals' root mean square over degrees of freedom, in times what they would leave."""
        return (self.left.clamp(min=1) / self.spare.clamp(min=1) / (1 - self.share)).sqrt()

    def told(self, share: float, px: float) -> Tensor:
        """Whether that is no chance, and as much as that."""
        rank, left = self.rank.clamp(min=1), self.left.clamp(min=1)
        rare = f_deviations(self.share / rank / ((1 - self.share) / left), rank, left) > RARE
        return rare & (self.left >= FEWEST_LEFT) & (self.share > share) & (self.px > px)


def _weighted(found: Fit) -> Tensor:
    """The residuals `(P, V, 1, 2 N)`, by the roots of weights whose mean is 1."""
    return derivatives(found)[2] * _roots(found)


def _roots(found: Fit) -> Tensor:
    weights, used = found.task.weights, found.task.used
    if weights is None:
        return used.any(-1)[..., None, None].to(torch.float64)
    mean = torch.where(used, weights, 0.0).sum((1, 2)) / used.sum((1, 2)).clamp(min=1)
    relative = torch.where(used, weights, 0.0) / mean.clamp(min=1e-300)[:, None, None]
    return relative.sqrt().unsqueeze(2).expand(-1, -1, 2, -1).flatten(-2).unsqueeze(2)


def _normal_equations(found: Fit) -> tuple[Tensor, Tensor]:
    """The normal equations of the intrinsics of each view, its pose eliminated: `(P, V, s, s)` and `(P, V, s)`.

    For a camera without a lens that has coefficients, two terms along the radius stand for one.
    """
    root = _roots(found)
    A, Z, r = (part * root for part in derivatives(found))
    if A.shape[2] <= PARAMETERS_OF_K + 1:
        A = torch.cat([A, _along_the_radius(found) * root], dim=2)
    eliminated = A @ Z.mT @ local_inverse(Z @ Z.mT)[0]
    return A @ A.mT - eliminated @ (Z @ A.mT), (A @ r.mT - eliminated @ (Z @ r.mT)).squeeze(-1)


def _along_the_radius(found: Fit) -> Tensor:
    task, state = found.task, tuple(z.detach() for z in found.solution.local)
    shared = found.solution.shared.detach()
    seen, valid = task.parameters.unpack(shared, state).project(task.points)
    off = torch.where((valid & task.used).unsqueeze(-1), seen - shared[:, None, None, 2:4], 0.0)
    radius = off.square().sum(-1, keepdim=True)
    radius = radius / radius.amax((1, 2), keepdim=True).clamp(min=1e-300)
    return torch.stack([(off * radius).mT, (off * radius.square()).mT], dim=2).flatten(-2)
