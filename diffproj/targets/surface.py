"""Where its neighbours put each point of a board, whatever the board's layout."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

NEIGHBOURS = 24
"""Points near each that say where it should be."""

ENOUGH = 10
"""Neighbours below which nothing is said."""


class Limits(NamedTuple):
    """Distances from where neighbours put a point up to which it is taken, the largest of these.

    Attributes:
        deviations: in terms of the view's median.
        loose: in pitches, to which `least` is added.
        least: in px.
    """

    deviations: float
    loose: float
    least: float


def off_surface(
    places: Float[np.ndarray, "n 2"],
    seen: Float[np.ndarray, "n 2"],
    known: Bool[np.ndarray, " n"],
    pitch: float,
    limits: Limits,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """How far each known point lies from a smooth surface through its neighbours, and how far it may, in px.

    The surface is of third degree on the board, which no lens and no tilt fools. 0 where there are few neighbours.

    Args:
        places: of all points, on the board.
        seen: of all points, in px; what is not known does not matter.
        known: which are known.
        pitch: the distance between neighbours on the board.
        limits: how far they may be.
    """
    off, limit = np.zeros(len(places)), np.full(len(places), np.inf)
    which = np.flatnonzero(known)
    if len(which) < ENOUGH + 1:
        return off, limit
    apart = np.linalg.norm(places[which, None] - places[None, which], axis=-1)
    count = min(NEIGHBOURS, len(which) - 1)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, 1 : count + 1]
    offset = (places[which][nearest] - places[which, None]) / (2 * pitch)
    x, y = offset[..., 0], offset[..., 1]
    weight = np.exp(-0.5 * (x * x + y * y))
    powers = [(i, j) for i in range(4) for j in range(4 - i)]
    basis = np.stack([x**i * y**j for i, j in powers], axis=-1)
    # What few neighbours leave open is held near zero: terms of higher degree more.
    ridge = np.diag(np.array([1e-9, 1e-9, 1e-3, 1e-2])[[i + j for i, j in powers]])
    weighted = np.swapaxes(basis * weight[..., None], 1, 2)
    hat = (np.linalg.inv(weighted @ basis + ridge) @ weighted)[:, 0]
    put = (hat[..., None] * seen[which][nearest]).sum(axis=1) / hat.sum(axis=1)[:, None]
    distance = np.linalg.norm(put - seen[which], axis=-1) / np.sqrt(1 + (hat**2).sum(axis=1))
    step = (
        np.linalg.norm(seen[which][nearest[:, 0]] - seen[which], axis=-1) / apart[np.arange(len(which)), nearest[:, 0]]
    )
    off[which] = distance
    limit[which] = np.maximum(limits.deviations * np.median(distance), limits.loose * step * pitch + limits.least)
    return off, limit
