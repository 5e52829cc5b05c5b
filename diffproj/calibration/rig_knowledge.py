"""What is known of a rig's cameras beforehand: intrinsics, lenses and places, as residuals over their deviations.

A place is said as it is measured, by the camera's rotation, its centre, or its distance from the first camera. None of
these is a parameter of the solver: their derivatives by the pose follow from

    R <- exp(omega) R        centre = -R^T t        d centre = R^T ([t]x^T omega - tau)        d |t| = t . tau / |t|
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffproj.geometry.cayley import cross_matrix, turn_between, turn_rate

ROTATION, CENTER, BASELINE = "rotation", "center", "baseline"


@dataclass(frozen=True, eq=False)
class KnownPlace:
    """What is known of where a camera stands in the rig.

    Attributes:
        camera: its number.
        what: its rotation, its center in the first camera's frame, or its baseline, the distance from that.
        start: where its pose stands among the shared unknowns.
        mean: `(3, 3)`, `(3,)` in world units, or `(1,)`.
        deviation: in radians about the camera's axes `(3,)`, or in world units `(3,)`, `(1,)`.
    """

    camera: int
    what: str
    start: int
    mean: Tensor
    deviation: Tensor

    def rows(self, R: Tensor, t: Tensor, omega: Tensor) -> tuple[Tensor, Tensor]:
        """How many deviations a camera is off `(k,)`, and the derivatives of that by omega and tau `(k, 6)`.

        Omega says how far the camera has turned since the solver began.
        """
        turn = turn_rate(omega)
        if self.what == ROTATION:
            off = turn_between(self.mean, R)
            slope = torch.cat([torch.linalg.solve(turn_rate(off), turn), torch.zeros_like(turn)], dim=-1)
        elif self.what == CENTER:
            off = -(R.mT @ t) - self.mean
            slope = torch.cat([R.mT @ cross_matrix(t).mT @ turn, -R.mT], dim=-1)
        else:
            length = t.norm()
            off = length - self.mean
            slope = torch.cat([torch.zeros_like(t), t / length.clamp(min=1e-300)]).unsqueeze(0)
        return off / self.deviation, slope / self.deviation.unsqueeze(-1)


@dataclass(frozen=True, eq=False)
class RigKnowledge:
    """Priors on the shared unknowns of a rig.

    Attributes:
        positions: of intrinsics and coefficients that are known `(k,)`.
        mean, deviation: of these `(k,)`.
        places: of cameras.
        variance: of a residual of weight 1, against which all of it weighs.
    """

    positions: Tensor
    mean: Tensor
    deviation: Tensor
    places: tuple[KnownPlace, ...]
    variance: float = 1.0

    def against(self, variance: float) -> "RigKnowledge":
        """The same against residuals of this variance."""
        return replace(self, variance=variance)

    def rows(self, shared: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """How far off `(n,)` the unknowns `(s,)` with cameras at `(C, 3, 3)`, `(C, 3)` are, and its Jacobian `(n, s)`.

        In deviations, times the root of the variance.
        """
        size = len(shared)
        own = torch.nn.functional.one_hot(self.positions, size).to(shared) / self.deviation.unsqueeze(-1)
        offs, slopes = [(shared[self.positions] - self.mean) / self.deviation], [own]
        for place in self.places:
            start = place.start
            off, slope = place.rows(R[place.camera], t[place.camera], shared[start : start + 3])
            offs.append(off)
            slopes.append(torch.nn.functional.pad(slope, (start, size - start - slope.shape[-1])))
        root = self.variance**0.5
        return root * torch.cat(offs), root * torch.cat(slopes)
