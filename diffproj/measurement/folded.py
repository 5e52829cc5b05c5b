"""Lengths near zero: what an error bar means for the length of a vector that noise could have made.

Let w be a measured vector with covariance C, D the length of its true value, and s the standard deviation of w along
itself. Far from 0 its length r is normal about D with deviation s. Near 0 it is not: noise makes vectors longer, and no
length is negative. Then

* the **deviation** is the root mean square error, which is s far off and `sqrt(tr C)` at 0;
* the **lower bound** is the smallest D that r agrees with. Measurements of D are accepted from `D - z s` up, and so far
  that they are accepted as often as the level says. So often a length of 0 has the lower bound 0, and away from 0 the
  bound goes over into `r - z s`;
* the **upper bound** is the length of the longest vector within z deviations of w: across w the noise may be larger
  than along it, as between two points close to the horizon. Else it is `r + z s`.
"""

import math

import numpy as np
import torch
from torch import Tensor

NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)
NEAR, FAR = 6.0, 12.0
"""Below how many deviations a length counts as near 0, and from how many on as far; in between both are mixed."""


def norm_variance(r: Tensor, along: Tensor, across: Tensor) -> Tensor:
    """The mean square error of a length r, from the variances of its vector along itself and across."""
    noisy = across > 0
    fade = torch.exp(-r.square() / torch.where(noisy, across, 1.0))
    return along + torch.where(noisy, across * fade, 0.0)


def longest_first(C: Tensor) -> tuple[Tensor, Tensor]:
    """The largest variance `(...)` of a vector with covariance `(..., 3, 3)`, and its direction `(..., 3)`."""
    values, vectors = torch.linalg.eigh(C)
    return values[..., -1].clamp(min=0), vectors[..., -1]


def lower_bound(
    r: Tensor, along: Tensor, across: Tensor, cross: Tensor, largest: Tensor, level: float, z: float
) -> Tensor:
    """The smallest length that a measured one of r is compatible with, `(M,)`.

    Args:
        r: the measured lengths.
        along: the variance along the vector.
        across: the sum of the variances across it.
        cross: the squared covariance of along and across.
        largest: the largest variance in any direction.
        level: of the interval.
        z: its reach in deviations.
    """
    plain = r - z * along.sqrt()
    near = _nearness(r, largest) > 0
    if not bool(near.any()):
        return plain.clamp(min=0)
    r, along, across, cross, largest, short = (x[near] for x in (r, along, across, cross, largest, plain))
    s = along.sqrt()
    across = across.clamp(min=1e-12 * along).clamp(min=1e-300)

    def surprise(length: Tensor) -> Tensor:
        """How far the probability of less than r, given a true length, lies above what is accepted."""
        low = (length - z * s).clamp(min=0)
        below = torch.where(low > 0, _probability_below(low, length, along, across, cross), 0.0)
        return _probability_below(r, length, along, across, cross) - level - below

    zero = torch.zeros_like(r)
    low, high = zero, r
    for _ in range(40):
        middle = (low + high) / 2
        too_short = surprise(middle) > 0
        low, high = torch.where(too_short, middle, low), torch.where(too_short, high, middle)
    found = torch.where(surprise(zero) > 0, (low + high) / 2, 0.0)
    weight = _nearness(r, largest)
    mixed = plain.clamp(min=0)
    mixed[near] = torch.where(weight < 1, weight * found + (1 - weight) * short.clamp(min=0), found)
    return mixed


def upper_bound(w: Tensor, C: Tensor, largest: Tensor, longest: Tensor, z: float) -> Tensor:
    """The length of the longest vector within z deviations of `w (M, 3)`, with covariance `C (M, 3, 3)`."""
    r = w.norm(dim=-1)
    towards = torch.where((longest * w).sum(-1, keepdim=True) < 0, -longest, longest)
    at = w + z * largest.sqrt().unsqueeze(-1) * towards
    start = w / r.clamp(min=1e-300).unsqueeze(-1)
    plain = r + z * (start * (C @ start.unsqueeze(-1)).squeeze(-1)).sum(-1).clamp(min=0).sqrt()
    for _ in range(40):
        u = torch.nn.functional.normalize(at, dim=-1, eps=1e-300)
        Cu = (C @ u.unsqueeze(-1)).squeeze(-1)
        s = (u * Cu).sum(-1, keepdim=True).clamp(min=0).sqrt()
        at = w + z * torch.where(s > 0, Cu / torch.where(s > 0, s, 1.0), 0.0)
    weight = _nearness(r, largest)
    return torch.where(weight > 0, weight * at.norm(dim=-1) + (1 - weight) * plain, plain)


def _nearness(r: Tensor, largest: Tensor) -> Tensor:
    """1 near zero, 0 far from it."""
    return ((FAR - r / largest.sqrt().clamp(min=1e-300)) / (FAR - NEAR)).clamp(0, 1)


def _probability_below(x: Tensor, length: Tensor, along: Tensor, across: Tensor, cross: Tensor) -> Tensor:
    """The probability that a vector of that true length is measured as shorter than x.

    An integral over the error e across: the vector is shorter than x where its part along lies between the two roots of
    `x^2 - e^2`. With `e = x sin(phi)` the integrand is smooth, and Gauss's nodes give it to 1e-6.
    """
    nodes, weights = (torch.as_tensor(part, dtype=x.dtype, device=x.device) for part in (NODES, WEIGHTS))
    tau = across.sqrt()
    end = torch.asin((6 * tau / x.clamp(min=1e-300)).clamp(max=1)).unsqueeze(-1)
    e, half = x.unsqueeze(-1) * (end * nodes).sin(), x.unsqueeze(-1) * (end * nodes).cos()
    slope = cross.sqrt() / across
    left = (along - cross / across).clamp(min=1e-12 * along).clamp(min=1e-300).sqrt().unsqueeze(-1)
    middle = length.unsqueeze(-1) + slope.unsqueeze(-1) * e
    inside = torch.special.ndtr((half - middle) / left) - torch.special.ndtr((-half - middle) / left)
    density = torch.exp(-(e / tau.unsqueeze(-1)).square() / 2) / (tau.unsqueeze(-1) * math.sqrt(2 * math.pi))
    return (density * half * inside * weights).sum(-1) * end.squeeze(-1)
