"""How many standard deviations an interval reaches: the normal distribution's quantile, and Student's t.

A standard deviation that was itself estimated from few residuals may be too small by chance, and an interval has to
reach further: 4.3 deviations instead of 1.96 for 95 % with two degrees of freedom.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import number

NODES, WEIGHTS = np.polynomial.legendre.leggauss(64)
NEARLY_NORMAL = 1000.0
"""Degrees of freedom from which on a series in their reciprocal is exact to rounding."""


def check_level(level: float) -> float:
    """The level of an interval, known to be a probability.

    Raises:
        TypeError: the level is no number.
        ValueError: it is not between 0 and 1.
    """
    want = "a probability between 0 and 1"
    found = number("level", level, want, above=0)
    if found >= 1:
        raise ValueError(f"level: want {want}, got {level}")
    return found


def normal_reach(level: float) -> float:
    """The number of standard deviations within which a normal error lies with that probability.

    Example:
        >>> round(normal_reach(0.95), 4)
        1.96
    """
    return float(torch.special.ndtri(torch.tensor((1 + check_level(level)) / 2, dtype=torch.float64, device="cpu")))


def joint_reach(level: float, count: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The number of standard deviations within which so many normal errors lie together with that probability.

    The root of the quantile of chi squared, by bisection. `count` is from 1 on, and need not be whole.

    Example:
        >>> joint_reach(0.95, torch.tensor([1.0, 2.0], dtype=torch.float64))
        tensor([1.9600, 2.4477], dtype=torch.float64)
    """
    half = count.detach().to(torch.float64) / 2
    low, high = torch.zeros_like(half), 4 * half.sqrt() + 2 * normal_reach(level)
    for _ in range(60):
        middle = (low + high) / 2
        inside = torch.special.gammainc(half, middle.square() / 2) < level
        low, high = torch.where(inside, middle, low), torch.where(inside, high, middle)
    return (low + high) / 2


def student_reach(level: float, degrees: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The number of estimated standard deviations within which an error lies with that probability.

    With `t = sqrt(n) tan(phi)` the probability is the integral of `cos(phi)^(n - 1)`, which Gauss's 64 nodes give to
    rounding, and Newton's steps from 0 rise to the solution, for the integrand falls. From 1000 degrees of freedom on
    Fisher's series is as exact (Abramowitz and Stegun 26.7.5).

    Args:
        level: the probability.
        degrees: degrees of freedom, from 1 on, not only whole ones; infinity stands for a known standard deviation.

    Returns:
        The reach, infinite where there are no degrees of freedom.

    Example:
        >>> student_reach(0.95, torch.tensor([1.0, 2, 10, torch.inf], dtype=torch.float64))
        tensor([12.7062,  4.3027,  2.2281,  1.9600], dtype=torch.float64)
    """
    n = degrees.detach().to(torch.float64)
    reach = torch.where(n > 0, _series(normal_reach(level), 1 / n.clamp(min=NEARLY_NORMAL)), torch.inf)
    few = (n > 0) & (n < NEARLY_NORMAL)
    if bool(few.any()):
        distinct, where = n[few].unique(return_inverse=True)
        reach[few] = _by_newton(level, distinct)[where]
    return torch.where(n.isnan(), torch.nan, reach)


def _series(z: float, inverse: Tensor) -> Tensor:
    """From the normal quantile z and the reciprocal of the degrees of freedom."""
    first, second = (z**3 + z) / 4, (5 * z**5 + 16 * z**3 + 3 * z) / 96
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    return z + inverse * (first + inverse * (second + inverse * third))


def _by_newton(level: float, n: Tensor) -> Tensor:
    nodes, weights = (torch.as_tensor(part, dtype=n.dtype, device=n.device) for part in ((1 + NODES) / 2, WEIGHTS / 2))
    scale = (torch.lgamma((n + 1) / 2) - torch.lgamma(n / 2)).exp() * (2 / math.sqrt(math.pi))
    phi = torch.zeros_like(n)
    for _ in range(100):
        inside = ((phi.unsqueeze(-1) * nodes).cos() ** (n - 1).unsqueeze(-1) * weights).sum(-1) * phi
        step = (level / scale - inside) / phi.cos() ** (n - 1)
        phi = torch.minimum(phi + step, (phi + math.pi / 2) / 2)
        if bool((step <= 1e-15 * phi).all()):
            break
    return n.sqrt() * phi.tan()
