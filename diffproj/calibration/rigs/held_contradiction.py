"""Whether the cameras of a rig contradict what is held of them: focal lengths, principal points, and places.

At the minimum the corners still pull at what is held. With S the normal matrix of the shared unknowns with the poses of
the target eliminated, g its gradient, and F what is free, held numbers h would, if they were free as well, change by

    -V^-1 g_h      with the covariance s^2 V^-1      V = S_hh - S_hF S_FF^-1 S_Fh

A wrong number that is held bends all others to it, and they are as sure as ever. Numbers that go together are let go
together: with one focal length held, the other hardly moves. Where what is held has errors of its own that are known
(`held_errors.py`), it may change by as much as these explain.
"""

import math
from typing import NamedTuple

import torch

from diffproj.calibration.least_squares.eliminated import inverse, reduced
from diffproj.calibration.rigs.fit import RigFit
from diffproj.calibration.rigs.parameters import POSE_NAMES
from diffproj.calibration.rigs.uncertainty import CameraNoise, pooled_variance
from diffproj.calibration.trust.prior_contradiction import DEVIATIONS, LEAST

TOGETHER = (("f_x", "f_y"), ("c_x", "c_y"), POSE_NAMES[:3], POSE_NAMES[3:])


class Held(NamedTuple):
    """The held number that the corners contradict most.

    Attributes:
        position: of it among the shared unknowns.
        change: how far it would move.
        deviation: of that, of corners that err independently.
        saved: which part of the sum of squares would be gone.
        own: deviation of the change by the errors of all that is held, where these are known.
    """

    position: int
    change: float
    deviation: float
    saved: float
    own: float = 0.0

    def remark(self, found: RigFit, dispersion: float) -> str:
        """A remark; '' where moments contradict each other as much as they do what is held."""
        deviation = self.deviation * max(1.0, dispersion * (1 - self.saved)) ** 0.5
        far = abs(self.change) / math.hypot(deviation, self.own)
        if not far > DEVIATIONS:
            return ""
        camera, _, name = found.parameters.names[self.position].rpartition(".")
        if name in POSE_NAMES:
            turns = name.startswith("omega")
            sizes = [math.degrees(size) if turns else size for size in (self.change, deviation)]
            off = (
                f"{sizes[0]:.3g} ± {sizes[1]:.2g} {'degrees about' if turns else 'world units along'} {name[-1]} off it"
            )
            return (
                f"the views contradict the place of {camera}, which is held: they tell {off}: did a camera move since, "
                "and are cameras= at their poses in the target's unit?"
            )
        here = float(found.shared[0, self.position])
        return (
            f"the views contradict {camera}.{name}, which is held at {here:.6g}: they tell "
            f"{here + self.change:.6g} ± {deviation:.2g}: is it of this camera, its zoom, lens model and size?"
        )


@torch.no_grad()
def contradicted_held(found: RigFit, noise: CameraNoise) -> Held | None:
    """The number that is contradicted most by corners that err independently; `None` if none is.

    Nor if all shared unknowns are held: how much the moments contradict each other is not known then.
    """
    variance = float(pooled_variance(noise))
    if found.basis is None or found.free == 0 or not variance > 0:
        return None
    H, free = found.equations, found.basis[0].abs().sum(-1) > 0
    S, F, *_ = reduced(H, None, None)
    S, pull = S[0], (H.g - (F @ H.h.unsqueeze(-1)).squeeze(-1).sum(1))[0]
    inner = S[free][:, free]
    known = inverse(inner.unsqueeze(0), inner.diagonal().unsqueeze(0))[0][0]
    squares, most, worst = variance * float(noise.freedom.clamp(min=0).sum()), DEVIATIONS, None
    errors = torch.zeros_like(S)
    if found.held_errors is not None:
        own = found.held_errors.to(S)
        errors[: len(own), : len(own)] = own
    by_held = S - S[:, free] @ known @ S[free]  # how pulls follow what is held, and what is free that
    for rows in _groups(found):
        across = S[rows][:, free] @ known
        V, g = S[rows][:, rows] - across @ S[free][:, rows], pull[rows] - across @ pull[free]
        inverse_V, unknown = inverse(V.unsqueeze(0), S.diagonal()[rows].unsqueeze(0))
        change = -inverse_V[0] @ g
        saved = min(float(-change @ g) / max(squares, 1e-300), 1 - LEAST)
        deviation = (variance * (1 - saved) * inverse_V[0].diagonal().clamp(min=0)).sqrt()
        slope = inverse_V[0] @ by_held[rows]
        own = (slope @ errors @ slope.mT).diagonal().clamp(min=0).sqrt()
        whole = torch.hypot(deviation, own)
        far = torch.where((deviation > 0) & ~unknown[0], change.abs() / whole, 0.0).nan_to_num(0.0)
        i = int(far.argmax())
        if float(far[i]) > most:
            most, worst = float(far[i]), Held(rows[i], float(change[i]), float(deviation[i]), saved, float(own[i]))
    return worst


def _groups(found: RigFit) -> list[list[int]]:
    """Where held numbers stand among the shared unknowns, those that go together and each."""
    names, held, groups = found.parameters.names, set(found.positions), []
    place = {name: i for i, name in enumerate(names)}
    for camera in found.views.names:
        for together in TOGETHER:
            rows = [place[key] for name in together if (key := f"{camera}.{name}") in place and place[key] in held]
            groups += [rows, *([row] for row in rows if len(rows) > 1)] if rows else []
    return groups
