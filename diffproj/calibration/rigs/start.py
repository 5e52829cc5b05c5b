"""Where a rig's solver starts: each camera on its own, then the best-connected pairs, chained from the first camera.

A pair of cameras that see the same moment says how they stand to each other. Of all such moments of a pair, the one is
taken that the others agree with most (their median), and averaged with those that agree: up to half of them may be
wrong, with the board turned or the cameras not at the same moment. The pairs with most agreeing moments make a tree.
Then each moment takes the pose, of those that its cameras see, that the others agree with most; views that contradict
it are set apart, to be looked at again from the minimum.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj._core.numerics import spread_evenly
from diffproj.calibration.results.calibration import CalibrationError
from diffproj.calibration.rigs.views import RigViews

MOST_CANDIDATES = 64
"""Moments of a pair that are tried as its relative pose, spread evenly."""
FAR_OFF = 0.1
"""Angle, in radians, between where a camera sees the target and where another says it is, beyond which the two do not
agree: the board's size in the image, rather than what noise does."""
STANDS_OUT, LEAST_OFF = 8.0, 0.004
"""Medians of that angle, and radians, from which on a view is set apart."""


class Seen(NamedTuple):
    """A camera on its own.

    Attributes:
        shared: its intrinsics `(s_c,)`.
        R, t: the target as each view sees it, from the target's middle `(V_c, 3, 3)`, `(V_c, 3)`.
        used: corners that count `(V_c, N)`; outliers do not.
    """

    shared: Tensor
    R: Tensor
    t: Tensor
    used: Tensor


class Relative(NamedTuple):
    """How a camera stands to another: `X_other = R X_one + t`.

    Attributes:
        R, t: `(3, 3)`, `(3,)`.
        agreeing: how many moments say so.
        common: how many both see.
    """

    R: Tensor
    t: Tensor
    agreeing: int
    common: int


@dataclass(frozen=True, eq=False)
class RigStart:
    """A start.

    Attributes:
        R, t: the cameras in the rig `(C, 3, 3)`, `(C, 3)`.
        poses: the target in the rig `(M, 3, 3)`, `(M, 3)`, from its middle.
        apart: views that contradict the others at their moment `(V_c,)`, by camera.
    """

    R: Tensor
    t: Tensor
    poses: tuple[Tensor, Tensor]
    apart: dict[str, Tensor]


def rig_start(
    views: RigViews, seen: Mapping[str, Seen], known: Mapping[int, tuple[Tensor, Tensor]], who: str
) -> RigStart:
    """The start, from the cameras on their own.

    Args:
        views: of all cameras.
        seen: each on its own.
        known: the places of cameras in the rig that are held, by their numbers.
        who: was asked, for messages.

    Raises:
        CalibrationError: nothing connects some cameras with the first, or moments contradict each other.
    """
    R, t = _chained(views, seen, known, who)
    poses, apart = _moments(views, seen, R, t)
    return RigStart(R, t, poses, apart)


def _sample(views: RigViews) -> Tensor:
    """A few points that span the target `(n, 3)`."""
    points = views.points
    ends = torch.cat([points[:, axis].argsort()[[0, -1]] for axis in (0, 1)])
    diagonal = points[:, :2].sum(-1).argsort()[[0, -1]]
    return points[torch.cat([ends, diagonal]).unique()]


def _relative(views: RigViews, seen: Mapping[str, Seen], one: str, other: str) -> Relative | None:
    """How two cameras stand to each other, by the moments that both see; `None` if there is none."""
    i, j = views.shared_moments(one, other)
    if len(i) == 0:
        return None
    R_i, t_i, R_j, t_j = seen[one].R[i], seen[one].t[i], seen[other].R[j], seen[other].t[j]
    R = R_j @ R_i.mT
    t = t_j - (R @ t_i.unsqueeze(-1)).squeeze(-1)
    sample = _sample(views).mT
    X_i, X_j = R_i @ sample + t_i.unsqueeze(-1), R_j @ sample + t_j.unsqueeze(-1)
    tried = spread_evenly(len(i), min(len(i), MOST_CANDIDATES), R.device)
    predicted = R[tried].unsqueeze(1) @ X_i + t[tried, None, :, None]  # (candidates, moments, 3, n)
    off = _apart(predicted, X_j)
    median = off.sort(dim=-1).values[:, len(i) // 2]
    best = int(median.argmin())
    limit = 3 * float(median[best])
    agree = off[best] <= min(limit, FAR_OFF)
    agree[tried[best]] = True
    U, _, V = torch.linalg.svd(R[agree].sum(0))
    mean = U @ torch.diag(torch.stack([*torch.ones_like(U[:2, 0]), (U @ V).det()])) @ V
    shift = (t_j[agree] - (mean @ t_i[agree].unsqueeze(-1)).squeeze(-1)).mean(0)
    return Relative(mean, shift, int(agree.sum()), len(i))


def _apart(X: Tensor, Y: Tensor) -> Tensor:
    """Mean angle between directions `(..., 3, n)`, `(...,)`, in radians where it is small."""
    one, other = (torch.nn.functional.normalize(Z, dim=-2) for Z in (X, Y))
    return (one - other).square().sum(-2).sqrt().mean(-1)


def _chained(
    views: RigViews, seen: Mapping[str, Seen], known: Mapping[int, tuple[Tensor, Tensor]], who: str
) -> tuple[Tensor, Tensor]:
    """The cameras in the rig `(C, 3, 3)`, `(C, 3)`, along the tree of pairs with most agreeing moments."""
    names = views.names
    pairs = {}
    for a, one in enumerate(names):
        for b, other in enumerate(names[a + 1 :], start=a + 1):
            if (found := _relative(views, seen, one, other)) is not None:
                pairs[a, b] = found
    like = seen[names[0]].R
    R = torch.eye(3, dtype=like.dtype, device=like.device).repeat(len(names), 1, 1)
    t, placed = torch.zeros_like(R[..., 0]), {0, *known}
    for c, (R_known, t_known) in known.items():
        R[c], t[c] = R_known, t_known
    while len(placed) < len(names):
        ends = [(pair, found) for pair, found in pairs.items() if (pair[0] in placed) != (pair[1] in placed)]
        if not ends:
            raise CalibrationError(f"{who}: {_unconnected(names, placed)}")
        (a, b), found = max(ends, key=lambda end: (end[1].agreeing, -end[1].common))
        if found.agreeing < 2 <= found.common:
            raise CalibrationError(
                f"{who}: no two of the {found.common} moments of {names[a]!r} and {names[b]!r} agree on how these "
                "cameras stand to each other: do the moments fit together (moments=), did the cameras stand still, "
                "and are the corners numbered from the same end?"
            )
        if a in placed:
            R[b], t[b] = found.R @ R[a], found.R @ t[a] + found.t
        else:
            R[a] = found.R.mT @ R[b]
            t[a] = found.R.mT @ (t[b] - found.t)
        placed |= {a, b}
    return R, t


def _unconnected(names: tuple[str, ...], placed: set[int]) -> str:
    lost = [repr(name) for i, name in enumerate(names) if i not in placed]
    rest = [repr(name) for i, name in enumerate(names) if i in placed]
    return (
        f"nothing connects {', '.join(lost)} with {', '.join(rest)}: no moment in which both see the target (at least "
        "4 corners each); add some, or calibrate them as rigs of their own"
    )


def _moments(
    views: RigViews, seen: Mapping[str, Seen], R: Tensor, t: Tensor
) -> tuple[tuple[Tensor, Tensor], dict[str, Tensor]]:
    """The target in the rig at each moment, and the views that contradict it."""
    C, M = len(views.names), len(views.moments)
    R_seen, t_seen = R.new_zeros(C, M, 3, 3), t.new_zeros(C, M, 3)
    there = torch.zeros(C, M, dtype=torch.bool, device=R.device)
    for c, name in enumerate(views.names):
        where = views.where[name]
        R_seen[c, where], t_seen[c, where] = seen[name].R, seen[name].t
        there[c, where] = seen[name].used.any(-1)
    R_rig = R.mT.unsqueeze(1) @ R_seen
    t_rig = (R.mT.unsqueeze(1) @ (t_seen - t.unsqueeze(1)).unsqueeze(-1)).squeeze(-1)
    sample = _sample(views).mT
    X_rig = R_rig @ sample + t_rig.unsqueeze(-1)  # (C, M, 3, n): as each camera says
    X_seen = R_seen @ sample + t_seen.unsqueeze(-1)
    off = torch.stack([_apart(R[d] @ X_rig + t[d, :, None], X_seen[d]) for d in range(C)], dim=-1)  # (C, M, D)
    both = there.unsqueeze(-1) & there.mT
    off = torch.where(both, off, 0.0).nan_to_num(torch.inf)
    cost = off.clamp(max=FAR_OFF).square().sum(-1)
    best = torch.where(there, cost, torch.inf).argmin(0)
    every = torch.arange(M, device=R.device)
    poses = R_rig[best, every], t_rig[best, every]
    nobody = ~there.any(0)
    poses[0][nobody], poses[1][nobody] = torch.eye(3, dtype=R.dtype, device=R.device), t.new_tensor([0.0, 0, 1])
    contradiction = off[best, every]  # (M, D)
    others = contradiction[both[best, every] & (best.unsqueeze(-1) != torch.arange(C, device=R.device))]
    limit = max(LEAST_OFF, STANDS_OUT * float(others.median())) if len(others) else torch.inf
    return poses, {name: contradiction[views.where[name], c] > limit for c, name in enumerate(views.names)}
