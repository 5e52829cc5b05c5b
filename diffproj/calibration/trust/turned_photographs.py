"""Whether the photographs of some views are turned by 180 degrees against the others'.

A file that says how the camera was held, or a camera that hangs upside down for a while, turns some photographs. Their
boards then seem to be seen through a camera whose principal point lies on the other side of the image's middle, and
whose one-sided terms (decentring, prism, tilt) have the other sign. All else stays, so that a view whose photograph is
turned back has the same cost at these other parameters: its bowl, mirrored. Which views to turn back is found as by
k-means, from the bowls alone: each view is taken as it is or turned, whichever is lower, and the parameters go to where
the sum of all is lowest.

Unlike two cameras of any kind, this costs no parameter, so that it may be judged by what is saved: over the variance
of the residuals and the dispersion, both of the better choice, it is the square of a normal variable's deviations if
the photographs are not turned. The shape of a target stays as it was found.

The choice itself saves, too: where the errors of each view's corners go together, the views' principal points scatter,
and those on one side of the middle are always nearer when turned. So along the line from the camera to the turned one
the views must also be in two heaps, so clearly that these are more likely than one wide heap by more than the number of
ways to choose so many views. Or else what is saved must be more than any choice among one heap saved.

What is amiss otherwise may look alike: a lens that the model lacks, skew, a bent board or one of a wrong width, two
cameras, and a prior that does not fit. So `remarks` wants more than these explain (of two cameras, nearly as much), and
does not ask at all where there is a prior.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.fitting.bowls import Bowls, bowls, of_prior
from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.trust.dispersion import contradiction

ONE_SIDED = ("p1", "p2", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""Parameters that have the other sign in a turned image."""
BEYOND, ROUNDS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0), 5
"""Where the search begins, as parts of the way from the turned camera to the one found, beyond this; and its rounds.
Where some views are turned, the fit lies between, and the true one beyond it."""
ASIDE = 0.03
"""And how far aside of the one found, as a part of the image: where half are turned, it is the same turned."""
TINY = 1e-10
"""Added to the sum of the bowls, relative to it, for directions of which it tells nothing."""
CERTAIN, OF_A_VIEW = 5.0, 3.0
"""Deviations of a normal variable beyond which photographs are turned, and each of them is."""
TWO_HEAPS, BEYOND_CHOICE = 6.0, 5.5
"""Logarithm of how much more likely two heaps of views are than one, from which on they are told; and what is saved for
each view, over the variance, from which on nothing else is asked. Where errors of .1 to .3 px went together in views of
one camera, 381 of 3200 sets were accused without these (82 of 100 where the principal point was the middle), 21 are."""
WIDTHS = (0.0, 0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0, 1.5, 2.5, 4.0)
"""Of one heap: its standard deviations, in lengths of the line."""


class Turned(NamedTuple):
    """The views of one camera that are turned against the others, and the part of the sum of squares they cost.

    `in_heaps` where the views are in two heaps, and not in one wide one.
    """

    views: list[int]
    saved: float
    in_heaps: bool


def turned_photographs(found: Fit, which: Tensor, sizes: Sequence[tuple[int, int] | None]) -> dict[int, Turned]:
    """Those of cameras `(n,)` of which some views are turned, by their number; none whose size is not known.

    Args:
        found: the fit of P cameras.
        which: of them.
        sizes: width and height of the photographs of each of all P.
    """
    which = which[torch.tensor([sizes[p] is not None for p in which.tolist()], dtype=torch.bool, device=which.device)]
    if len(which) == 0:
        return {}
    with torch.no_grad():
        part = found.part(which)
        task, few = part.task, part.task.parameters.few
        shared = part.solution.shared.detach()
        local = tuple(z.detach() for z in part.solution.local)
        held = replace(task, basis=None)  # where points are free, the bowls are by the camera alone
        seen = bowls(held, shared, local)
        T = torch.eye(few, dtype=shared.dtype, device=shared.device).expand(len(shared), -1, -1)
        if task.basis is not None:
            T = task.basis[:, :few, (task.basis[:, :few] != 0).any(1).any(0)]
        if T.shape[-1] == 0:
            return {}
        size = shared.new_tensor([sizes[p] for p in which.tolist()])
        Q, pull = of_prior(held, shared)
        choice = _Choice(seen, T, Q[:, :few, :few], pull[:, :few], size, *_turn(task.names[:few], shared, size))
        turned = choice.best(task.used.any(-1))
        share = task.used.any(-1).to(shared) * (1.0 if task.shares is None else task.shares)
        saved, of_each, level, spare, heaps = choice.judged(turned, share, part.degrees_of_freedom())
        clear = heaps | (saved > BEYOND_CHOICE * share.sum(-1) * level)
        told = ((saved > _as_rare(CERTAIN, spare) * level) & clear).unsqueeze(-1) & turned
        told &= of_each > (_as_rare(OF_A_VIEW, spare) * level).unsqueeze(-1)
        total = 2 * seen.c.sum(-1)
    groups = {}
    for i in told.any(-1).nonzero().flatten().tolist():
        groups[int(which[i])] = Turned(told[i].nonzero().flatten().tolist(), float(saved[i] / total[i]), bool(heaps[i]))
    return groups


def _turn(names: tuple[str, ...], shared: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Signs `(s,)` and shift `(P, s)` of the parameters, from where they are, that see the same in the turned image."""
    few = len(names)
    sign, origin = shared.new_ones(few), torch.zeros_like(shared[:, :few])
    for place, name in enumerate(names):
        if name in ("c_x", "c_y"):
            sign[place], origin[:, place] = -1.0, size[:, "xy".index(name[-1])] - 1
        elif name in ONE_SIDED:
            sign[place] = -1.0
    return sign, sign * shared[:, :few] + origin - shared[:, :few]


class _Judged(NamedTuple):
    """What it is worth to turn views back.

    Attributes:
        saved: of the sum of squares `(P,)`.
        of_each: the same by each view `(P, V)`.
        level: phi s^2 then `(P,)`.
        spare: degrees of freedom that phi is from `(P,)`.
        heaps: whether the views are in two heaps `(P,)`.
    """

    saved: Tensor
    of_each: Tensor
    level: Tensor
    spare: Tensor
    heaps: Tensor


class _Choice(NamedTuple):
    """The bowls of V views of P cameras by s parameters, and those of the views turned: at `M x + d` in place of x."""

    seen: Bowls
    T: Tensor
    Q: Tensor
    pull: Tensor
    size: Tensor
    sign: Tensor
    d: Tensor

    def best(self, used: Tensor) -> Tensor:
        """Which views are to be turned back `(P, V)`, at most half of them."""
        starts = self._starts()
        every, P = self._repeated(len(starts)), len(used)
        used_by_each = used.repeat(len(starts), 1)
        turned, cost = every._following(torch.cat(starts), used_by_each)
        for _ in range(ROUNDS - 1):
            turned, cost = every._following(every._lowest_place(turned)[0], used_by_each)
        first = cost.unflatten(0, (-1, P)).argmin(0) * P + torch.arange(P, device=used.device)
        best = turned[first]
        more = 2 * best.sum(-1) > used.sum(-1)
        return torch.where(more.unsqueeze(-1), used & ~best, best)

    def _following(self, x: Tensor, used: Tensor) -> tuple[Tensor, Tensor]:
        """Which views cost less turned at x `(P, V)`, and what all cost where the sum is lowest then `(P,)`."""
        costs = self._costs(x)
        turned = used & (costs[1] < costs[0])
        return turned, self._lowest_place(turned)[1]

    def _lowest_place(self, turned: Tensor) -> tuple[Tensor, Tensor]:
        """Where the sum is lowest with these views turned `(P, s)`, and what it costs there `(P,)`."""
        A, b, fixed = self._sum(turned)
        y = _lowest(A, b)
        return (self.T @ y.unsqueeze(-1)).squeeze(-1), fixed + (b * y).sum(-1) / 2

    def _repeated(self, times: int) -> "_Choice":
        """The same for so many times the cameras."""

        def again(whole: Tensor) -> Tensor:
            return whole.repeat(times, *[1] * (whole.ndim - 1))

        return self._replace(
            seen=Bowls(*map(again, self.seen)),
            T=again(self.T),
            Q=again(self.Q),
            pull=again(self.pull),
            size=again(self.size),
            d=again(self.d),
        )

    def _starts(self) -> list[Tensor]:
        starts = [-far * self.d for far in BEYOND]
        for u, v in ((1, 0), (0, 1), (1, 1), (1, -1)):
            aside = torch.zeros_like(self.d)
            aside[:, 2:4] = ASIDE * self.size * self.size.new_tensor([u, v])
            starts.append(aside)
        return starts

    def judged(self, turned: Tensor, share: Tensor, redundant: Tensor) -> _Judged:
        """What it is worth to turn these views back `(P, V)`, each of which counts by its share `(P, V)`.

        The bowls have these shares in them: a copy tells nothing more.
        """
        whole = torch.where(share > 0, 1 / share, 0.0)
        A, b, fixed = self._sum(turned)
        y = _lowest(A, b)
        saved = -2 * (fixed + (b * y).sum(-1) / 2)
        x = (self.T @ y.unsqueeze(-1)).squeeze(-1)
        costs = self._costs(x)
        left = (2 * self.seen.c.sum(-1) - saved) / redundant.clamp(min=1)
        H, g, _ = self._placed(turned)
        H, g = self.T.mT.unsqueeze(1) @ H @ self.T.unsqueeze(1), (g.unsqueeze(-2) @ self.T.unsqueeze(1)).squeeze(-2)
        u = g + (H @ y[:, None, :, None]).squeeze(-1)
        pull = u.sum(1) + b - g.sum(1) + ((A - H.sum(1)) @ y.unsqueeze(-1)).squeeze(-1)
        u, H = u * whole.unsqueeze(-1), H * whole[..., None, None]
        phi, spare, _ = contradiction(u, H, left[:, None, None, None] * H, share, A, pull)
        level = phi.clamp(min=1) * left
        heaps = self._two_heaps(x, turned, share, level) > TWO_HEAPS
        return _Judged(saved, 2 * (costs[0] - costs[1]) * whole, level, spare, heaps)

    def _two_heaps(self, x: Tensor, turned: Tensor, share: Tensor, level: Tensor) -> Tensor:
        """By how much two heaps of views, at x and at its turned place, are likelier than one `(P,)`, as a logarithm.

        A view's place on the line between both, from the middle and in lengths of the line, is what it costs more at x
        than turned, over its curvature; this scatters as `level` if not more. One heap is as wide as fits it best.
        """
        jump = self.sign * x + self.d - x
        curvature = torch.einsum("pi,pvij,pj->pv", jump, self.seen.H, jump)
        told = (share > 0) & (curvature > 0)
        share, curvature = torch.where(told, share, 0.0), torch.where(told, curvature, 1.0)
        count, some = share.sum(-1), (turned * share).sum(-1)
        costs = self._costs(x)
        place = torch.where(told, (costs[0] - costs[1]) / curvature, 0.0)
        curvature = torch.where(told, curvature / torch.where(told, share, 1.0), 1.0)  # of the whole view
        off = torch.where(told, place - torch.where(turned, 0.5, -0.5), 0.0)
        within = ((share * off.square() * curvature).sum(-1) / count.clamp(min=1)).maximum(level)
        two = _likelihood(off, within.unsqueeze(-1) / curvature, share)
        variance = (level.unsqueeze(-1) / curvature) + place.new_tensor(WIDTHS).square()[:, None, None]
        weight = share / variance
        middle = (weight * place).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True).clamp(min=1e-300)
        one = _likelihood(place - middle, variance, share).amax(0)
        ways = (count + 1).lgamma() - (some + 1).lgamma() - (count - some + 1).lgamma()
        return two - one - ways

    def _costs(self, x: Tensor) -> Tensor:
        """What each view costs at x `(P, s)`, as it is and turned `(2, P, V)`."""
        H, g, _ = self.seen
        both = torch.stack([x, self.sign * x + self.d])
        return (g * both.unsqueeze(2)).sum(-1) + torch.einsum("cpi,pvij,cpj->cpv", both, H, both) / 2

    def _placed(self, turned: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Bowls and what they cost at their place, where those views are turned."""
        H, g, _ = self.seen
        shifted = (H @ self.d[:, None, :, None]).squeeze(-1)
        fixed = (self.d.unsqueeze(1) * (g + shifted / 2)).sum(-1)
        one = turned.unsqueeze(-1)
        g = torch.where(one, self.sign * (g + shifted), g)
        H = torch.where(one.unsqueeze(-1), self.sign.unsqueeze(-1) * H * self.sign, H)
        return H, g, torch.where(turned, fixed, 0.0)

    def _sum(self, turned: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The sum of the bowls by the free parameters: `A (P, q, q)`, `b (P, q)` and what it costs at y = 0."""
        H, g, fixed = self._placed(turned)
        A = self.T.mT @ (H.sum(1) + self.Q) @ self.T
        b = ((g.sum(1) + self.pull).unsqueeze(-2) @ self.T).squeeze(-2)
        return A, b, fixed.sum(-1)


def _likelihood(off: Tensor, variance: Tensor, share: Tensor) -> Tensor:
    """The logarithm of how likely normal variables `(*B, V)` are that count by shares, up to a constant `(*B,)`."""
    return -(share * (off.square() / variance + variance.log())).sum(-1) / 2


def _as_rare(deviations: float, freedom: Tensor) -> Tensor:
    """The square of Student's t as rare as that of a normal variable (Wallace 1959)."""
    n = freedom.clamp(min=1e-3)
    return n * ((deviations * (8 * n + 3) / (8 * n + 1)) ** 2 / n).clamp(max=600).expm1()


def _lowest(A: Tensor, b: Tensor) -> Tensor:
    scale = A.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    A = (A * scale.unsqueeze(-1) * scale.unsqueeze(-2)).nan_to_num() + TINY * torch.eye(
        A.shape[-1], dtype=A.dtype, device=A.device
    )
    return -scale * torch.linalg.solve_ex(A, (b * scale).unsqueeze(-1))[0].squeeze(-1)
