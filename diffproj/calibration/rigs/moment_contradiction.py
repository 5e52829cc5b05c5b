"""Whether one moment of a rig contradicts the others, and places hang on it.

A photograph that one camera took a little later than the others, of a target that moved by a few millimetres, hardly
shows in the residuals: with few views at that moment the places of the cameras give way. So each view that others share
the moment of is asked whether it wants its camera somewhere else. With P the derivatives of its corners by the camera's
pose, and the notation of `common_errors.py`,

    u = P^T W r      V = P^T W P - P^T W J H^-1 J^T W P      chi-square = u^T V^-1 u / s^2

with six degrees of freedom is what the sum of squares would lose if the camera stood there by itself, and
`J^T W P V^-1 u` through H how far the shared unknowns would move. Views whose corners err together are off by more than
chance in all moments: what counts is a view that is so beyond the median of all, and that moves a place by more than
its deviation.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.rigs.common_errors import moves_of, without_poses
from diffproj.calibration.rigs.fit import RigFit
from diffproj.calibration.rigs.problem import Group
from diffproj.calibration.rigs.uncertainty import CameraNoise, noisy_moments

CHANCE = 1e-2
"""How likely any view of a rig may contradict the others by chance before it is said."""
MEDIAN = 5.348
"""Of chi-square with six degrees of freedom."""
MOVED = 1.0
"""Deviations by which a place has to hang on it."""
LEAST_TOLD = 1e-6
"""Part of what a view tells of its camera's pose that the others have to tell, too."""
EXACT_PX = 1e-6
"""Noise in pixels below which residuals are rounding errors."""


class Contradiction(NamedTuple):
    """The view that contradicts the others most.

    Attributes:
        moment: its number.
        cameras: of those that see that moment, the one that does, or both where there are two.
        turn: how far the camera would turn, in degrees.
        shift: how far it would move, in world units.
        moved: how far the shared unknowns would `(s,)`.
    """

    moment: int
    cameras: list[str]
    turn: float
    shift: float
    moved: Tensor

    def remark(self, found: RigFit, covariance: Tensor) -> str:
        """A remark, where a place hangs on it; else ''. `covariance (s, s)` is that of the shared unknowns."""
        deviations = covariance.diagonal().clamp(min=0).sqrt()
        said, most = "", MOVED
        for name, rows in zip(found.views.names[1:], found.parameters.poses[1:], strict=True):
            known = (deviations[rows] > 0) & deviations[rows].isfinite()
            far = float(torch.where(known, self.moved[rows].abs() / deviations[rows], 0.0).amax())
            if far > most:
                said, most = name, far
        if not said:
            return ""
        who = f"{self.cameras[0]} contradicts the others" if len(self.cameras) == 1 else " and ".join(self.cameras)
        who = who if len(self.cameras) == 1 else f"{who} contradict each other"
        return (
            f"at {found.views.moments[self.moment]} {who}, by about {self.shift:.2g} world units and {self.turn:.2g} "
            f"degrees, and more clearly than at any other moment, and without it {said} would be {most:.1f} of its "
            "deviations elsewhere: were its photographs taken at once, and did the target rest? If not, leave it out"
        )


@torch.no_grad()
def contradicting_moment(found: RigFit, noise: CameraNoise) -> Contradiction | None:
    """The view that contradicts the others by more than chance and than views do in general; `None` if none does."""
    level = (noise.variance / noise.bend).clamp(min=0)
    if not bool((level.sqrt() > EXACT_PX).all()):
        return None
    moves = moves_of(found, noise.bend, POSE, lambda group, panel: _by_pose(found, group, panel))
    basis = found.basis
    left, inverse_S, inverse_W = without_poses(found, noise.bend, moves)
    V = moves.weight - torch.einsum("mcai,mij,mcbj->mcab", moves.local, inverse_W, moves.local)
    V = V - left @ inverse_S @ left.mT
    told = moves.weight.diagonal(dim1=-2, dim2=-1)
    there = told[..., 0] > 0
    unit = torch.where(told > 0, told, 1.0).rsqrt()
    values, axes = torch.linalg.eigh((V + V.mT) / 2 * unit.unsqueeze(-1) * unit.unsqueeze(-2))
    known = (values > LEAST_TOLD) & (there & (there.sum(-1, keepdim=True) > 1)).unsqueeze(-1)
    along = (axes.mT @ (moves.pull * unit).unsqueeze(-1)).squeeze(-1)
    step = torch.where(known, along / torch.where(known, values, 1.0), 0.0)
    squares, count = (step * along).sum(-1), known.sum(-1)
    # The noise is that of the noisiest camera at that moment, where one view may have been blurred; but for what the
    # contradiction itself leaves in the residuals.
    corners = torch.stack([_corners(found, name) for name in found.views.names], dim=-1)
    of_itself = squares.amax(-1, keepdim=True) / (2 * corners * level).clamp(min=1e-300)
    noisy = (noisy_moments(found, noise).mT - of_itself).clamp(min=1)
    squares = squares / torch.where(there, level * noisy, 0.0).amax(-1, keepdim=True).clamp(min=1e-300)
    asked = count == POSE
    if int(asked.sum()) == 0:
        return None
    squares = torch.where(asked, squares, 0.0) / max(1.0, float(squares[asked].median()) / MEDIAN)
    chance = torch.special.gammaincc(squares.new_tensor(POSE / 2), squares / 2)
    m, c = divmod(int(squares.argmax()), squares.shape[1])
    if not float(chance[m, c]) * int(asked.sum()) < CHANCE:
        return None
    move = -unit[m, c] * (axes[m, c] @ step[m, c])
    moved = -inverse_S @ left[m, c].mT @ move
    moved = moved if basis is None else basis[0] @ moved
    names = [found.views.names[i] for i in there[m].nonzero().flatten().tolist()]
    who = names if len(names) == 2 else [found.views.names[c]]
    return Contradiction(m, who, float(move[:3].norm().rad2deg()), float(move[3:].norm()), moved)


def _corners(found: RigFit, name: str) -> Tensor:
    """How many corners of a camera count at each moment `(M,)`."""
    count = found.shared.new_zeros(found.problem.moments)
    count[found.views.where[name]] = found.used[name].sum(-1).to(count)
    return count


def _by_pose(found: RigFit, group: Group, panel: Tensor) -> Tensor:
    """How corners move by their camera's pose in the rig `(n, 6, 2, N)`."""
    by_view = panel[:, group.size : group.size + POSE]
    composition = found.problem.composition(group, found.shared, found.local)[..., :POSE]
    return torch.einsum("nij,niap->njap", composition, by_view)
