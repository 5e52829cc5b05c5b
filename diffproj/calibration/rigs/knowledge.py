"""What is known of a rig's cameras beforehand: intrinsics, lenses and places, as residuals over their deviations.

A place is said as it is measured, by the camera's rotation, its centre, or its distance from the first camera. None of
these is a parameter of the solver: their derivatives by the pose follow from

    R <- exp(omega) R        centre = -R^T t        d centre = R^T ([t]x^T omega - tau)        d |t| = t . tau / |t|
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffproj.geometry.cayley import cross_matrix, turn_between, turn_rate

ROTATION, CENTER, BASELINE = "rotation", "center", "baseline"


@dataclass(frozen=True, eq=False)
class KnownPlace:
    """What is known of where a camera stands in each of P rigs.

    Attributes:
        camera: its number.
        what: its rotation, its center in the first camera's frame, or its baseline, the distance from that.
        start: where its pose stands among the shared unknowns.
        mean: `(P, 3, 3)`, `(P, 3)` in world units, or `(P, 1)`.
        deviation: in radians about the camera's axes `(P, 3)`, or in world units `(P, 3)`, `(P, 1)`.
    """

    camera: int
    what: str
    start: int
    mean: Tensor
    deviation: Tensor

    def rows(self, R: Tensor, t: Tensor, omega: Tensor) -> tuple[Tensor, Tensor]:
        """How many deviations a camera is off `(P, k)`, and the derivatives of that by omega and tau `(P, k, 6)`.

        Omega says how far the camera has turned since the solver began.
        """
        turn = turn_rate(omega)
        if self.what == ROTATION:
            off = turn_between(self.mean, R)
            slope = torch.cat([torch.linalg.solve(turn_rate(off), turn), torch.zeros_like(turn)], dim=-1)
        elif self.what == CENTER:
            off = -(R.mT @ t.unsqueeze(-1)).squeeze(-1) - self.mean
            slope = torch.cat([R.mT @ cross_matrix(t).mT @ turn, -R.mT], dim=-1)
        else:
            length = t.norm(dim=-1, keepdim=True)
            off = length - self.mean
            slope = torch.cat([torch.zeros_like(t), t / length.clamp(min=1e-300)], dim=-1).unsqueeze(-2)
        return off / self.deviation, slope / self.deviation.unsqueeze(-1)


@dataclass(frozen=True, eq=False)
class RigKnowledge:
    """Priors on the shared unknowns of each of P rigs.

    Attributes:
        positions: of intrinsics and coefficients that are known `(k,)`, the same in all rigs.
        mean, deviation: of these `(P, k)`.
        places: of cameras.
        variance: of a residual of weight 1, against which all of it weighs `(P,)`.
    """

    positions: Tensor
    mean: Tensor
    deviation: Tensor
    places: tuple[KnownPlace, ...]
    variance: Tensor

    def against(self, variance: float) -> "RigKnowledge":
        """The same against residuals of this variance."""
        return replace(self, variance=torch.full_like(self.variance, variance))

    @property
    def of(self) -> tuple[object, ...]:
        """What it is of: that of two rigs can be taken together where this is the same."""
        return tuple(self.positions.tolist()), tuple((place.camera, place.what) for place in self.places)

    def part(self, which: Tensor) -> "RigKnowledge":
        """That of some of the rigs `(n,)`."""
        return self._each([self], lambda parts: parts[0][which])

    def _each(self, ones: "Sequence[RigKnowledge]", take: Callable[[list[Tensor]], Tensor]) -> "RigKnowledge":
        """The same with what is taken of each tensor of those of many rigs."""

        def of(parts: Sequence[Any]) -> dict[str, Tensor]:
            return {name: take([getattr(part, name) for part in parts]) for name in ("mean", "deviation")}

        places = tuple(
            replace(own, **of([one.places[number] for one in ones])) for number, own in enumerate(self.places)
        )
        return replace(self, **of(ones), places=places, variance=take([one.variance for one in ones]))

    def rows(self, shared: Tensor, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """How far off `(P, n)` unknowns `(P, s)` with cameras at `(P, C, 3, 3)`, `(P, C, 3)` are, and the Jacobian.

        In deviations, times the root of the variance; the Jacobian is `(P, n, s)`.
        """
        size = shared.shape[-1]
        own = torch.nn.functional.one_hot(self.positions, size).to(shared) / self.deviation.unsqueeze(-1)
        offs, slopes = [(shared[:, self.positions] - self.mean) / self.deviation], [own]
        for place in self.places:
            start = place.start
            off, slope = place.rows(R[:, place.camera], t[:, place.camera], shared[:, start : start + 3])
            offs.append(off)
            slopes.append(torch.nn.functional.pad(slope, (start, size - start - slope.shape[-1])))
        root = self.variance.sqrt().unsqueeze(-1)
        return root * torch.cat(offs, dim=-1), root.unsqueeze(-1) * torch.cat(slopes, dim=-2)


def joined_knowledge(of_each: Sequence[RigKnowledge]) -> RigKnowledge | None:
    """What is known of many rigs, of whose unknowns the same are; `None` where nothing is."""
    return of_each[0]._each(of_each, torch.cat) if of_each else None
