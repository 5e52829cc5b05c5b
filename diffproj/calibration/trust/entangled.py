"""Whether the views tell a tilted sensor, a thin prism and skew from a principal point that lies elsewhere.

All of them bend the image to one side, each a little differently. Together they can carry the principal point a hundred
pixels away for a hair of the error: along such a valley the image hardly changes. Its deviation tells a part of it:
it is that of the place where the fit ended, in a valley that is curved; and the little that the board is uneven moves
the minimum along it, in all views alike.

So the same camera is fitted once more without them. Where the corners hardly notice, and yet the principal point or a
focal length is no longer where its error bar has it, the views do not tell which is right: with d the step from the one
to the other, the mean square of the error of the parameters that were kept is

    C + d d^T

if the simpler camera is the right one, and no more if it is not.

Of a camera that hardly knows its principal point, as through a long lens, the lens itself is asked about likewise:
terms that stand for noise bend the image about any point that suits them, and seem to know it well. The poorer lens may
end at the same point, and yet know it far less well. If it is the right one, the point is only known so well: then the
covariance is the larger one of this and the poorer lens's own.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import INTRINSICS, SKEW
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.trust.adequacy import EXACT_PX, SIGNIFICANT
from diffproj.calibration.trust.dispersion import dispersion
from diffproj.calibration.trust.leftover import effect
from diffproj.calibration.trust.uncertainty import pooled_covariance_of
from diffproj.lens.models import MODELS

ONE_SIDED = (("tau_x", "tau_y"), ("s1", "s2", "s3", "s4"), (SKEW,))
"""Groups of parameters that bend the image to one side, as a shift of the principal point does."""
LATE = ("k2", "k3", "k4")
"""The terms of a fisheye that little of the image tells of, so that seen through a long lens they stand for noise."""
ADRIFT = 0.05
"""Deviation of the principal point, relative to how far corners are spread in the image, from which on the lens is
doubted."""
LONG = 12.0
"""Focal length, relative to that spread, from which on it is doubted too, however well the point seems to be known."""
ALIKE = 1.05
"""Times the residuals that those through a simpler lens may be at most, to fit about as well. (Of few views that err
together, the corners could seem not to notice any.)"""
FAR = 2.0
"""Deviations of an intrinsic parameter beyond which its error bar does not cover another value."""
TELLING_VIEWS = 3
"""Views from which on the lens is doubted: fewer do not tell how far corners err together."""
PINNED = 1.5
"""Times its deviation that an intrinsic parameter may have through a poorer lens; beyond, the lens's terms pin it."""
REAL = 3.5
"""Deviations of a normal variable from which on a term of the lens is no noise."""


@dataclass(frozen=True, eq=False)
class Simpler:
    """A simpler camera that the corners of one calibration fit about as well, and whose intrinsics are others.

    Attributes:
        held: names of the parameters that are 0 in it.
        name: of the intrinsic parameter that differs most, in deviations.
        here: its value in the calibration.
        there: its value in the simpler camera.
        deviations: of it here, and there if that is asked.
        growth: part by which the residuals are larger there.
        doubt: what the covariance of the shared parameters has to grow by `(s, s)`.
    """

    held: tuple[str, ...]
    name: str
    here: float
    there: float
    deviations: tuple[float, float]
    growth: float
    doubt: Tensor

    @property
    def elsewhere(self) -> bool:
        """Whether it is another value there; else it is only known less well."""
        return abs(self.there - self.here) > FAR * self.deviations[0]


@dataclass(frozen=True, eq=False)
class Entangled:
    """What the views of P cameras do not tell from their intrinsics; looked for when it is asked for.

    Attributes:
        found: the fit.
        status: how each camera ended `(P,)`; one that did not converge is not looked at.
    """

    found: Fit
    status: Tensor

    @cached_property
    def simpler(self) -> dict[int, Simpler]:
        """The simplest camera that the corners fit about as well, by the number of the camera, where it is another."""
        groups, lenses = _together(_free_groups(self.found)), _poorer_lenses(self.found)
        if not groups and not lenses:
            return {}
        told: dict[int, Simpler] = {}
        with torch.no_grad():
            sound = (self.status == Status.CONVERGED) & (self.found.pixel_sigma() > EXACT_PX)
            which = sound.nonzero().flatten()
            if groups and len(which):
                told |= _simpler(self.found.part(which), which.tolist(), groups)
            if lenses:
                sound[list(told)] = False
                which = (sound & _adrift(self.found)).nonzero().flatten()
                told |= _simpler(self.found.part(which), which.tolist(), lenses, True) if len(which) else {}
        return told

    @cached_property
    def needless(self) -> dict[int, float]:
        """Where the terms below the line buy nothing that corners could tell: the part by which residuals grow without.

        Such terms stand for noise, and of many places where they could, the fit ended in one.
        """
        names = tuple(name for name in MODELS[self.found.task.lens].below if name in _free(self.found))
        if not names:
            return {}
        with torch.no_grad():
            sound = (self.status == Status.CONVERGED) & (self.found.pixel_sigma() > EXACT_PX)
            which = sound.nonzero().flatten()
            if len(which) == 0:
                return {}
            whole = self.found.part(which)
            without = _without(whole, names)
            same = (without.solution.status == Status.CONVERGED) & (_noticed(whole, without, names) < SIGNIFICANT)
            growth = (without.solution.cost / whole.solution.cost).sqrt() - 1
            return {int(which[i]): float(growth[i]) for i in same.nonzero().flatten().tolist()}

    def widened(self, covariance: Covariance) -> Covariance:
        """The covariance `(P, ...)` with the doubt in it."""
        if not self.simpler:
            return covariance
        shared = covariance.shared.clone()
        for p, other in self.simpler.items():
            shared[p] += other.doubt.to(shared)
        return replace(covariance, shared=shared)


def _simpler(found: Fit, numbers: list[int], choices: list[tuple[str, ...]], every: bool = False) -> dict[int, Simpler]:
    """The first of some choices of what is held that the corners hardly notice, where the camera is another one then.

    With `every`, the first of all choices with which it is another one, or known far less well.
    """
    told: dict[int, Simpler] = {}
    covariance = pooled_covariance_of(found).shared
    deviations = _deviations(covariance)
    left = torch.arange(len(numbers), device=deviations.device)
    for held in choices:
        whole = found.part(left)
        without = _without(whole, held)
        noticed = _noticed(whole, without, held)
        same = (without.solution.status == Status.CONVERGED) & (noticed < (REAL if every else SIGNIFICANT))
        if every:
            same &= without.solution.cost <= ALIKE**2 * whole.solution.cost
        step = without.solution.shared - whole.solution.shared
        off = step[:, : len(INTRINSICS)].abs() / deviations[left]
        off = torch.where(deviations[left] > 0, off, 0.0)
        doubt, poorer = step.unsqueeze(-1) * step.unsqueeze(-2), deviations[left]
        if every:
            known = pooled_covariance_of(without).shared
            doubt, poorer = doubt + _excess(known, covariance[left] + doubt), _deviations(known)
        pinned = torch.where((deviations[left] > 0) & poorer.isfinite(), poorer / deviations[left], 0.0)
        growth = (without.solution.cost / whole.solution.cost).sqrt() - 1
        moved = off.amax(-1) > FAR
        other = same & (moved | (pinned.amax(-1) > PINNED))
        for i in other.nonzero().flatten().tolist():
            k = int((off if bool(moved[i]) else pinned)[i].argmax())
            here, there = (float(fitted.solution.shared[i, k]) for fitted in (whole, without))
            both = float(deviations[left][i, k]), float(poorer[i, k])
            told[numbers[int(left[i])]] = Simpler(held, INTRINSICS[k], here, there, both, float(growth[i]), doubt[i])
        left = left[~(other if every else same)]
        if len(left) == 0:
            break
    return told


def _deviations(covariance: Tensor) -> Tensor:
    """The deviations of the intrinsic parameters `(n, 4)`."""
    return covariance.diagonal(dim1=-2, dim2=-1)[:, : len(INTRINSICS)].sqrt()


def _excess(poorer: Tensor, richer: Tensor) -> Tensor:
    """What a covariance `(n, s, s)` has to grow by to hold another's intrinsics too, and what goes with them there.

    The others follow by their regression on the intrinsics; pixels are a common measure of these four.
    """
    count = len(INTRINSICS)
    poorer, richer = (part.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0) for part in (poorer, richer))
    own = poorer[:, :count, :count]
    more, axes = torch.linalg.eigh(own - richer[:, :count, :count])
    growth = (axes * more.clamp(min=0).unsqueeze(-2)) @ axes.mT
    follow = poorer[:, :, :count] @ torch.linalg.pinv(own, hermitian=True)
    return follow @ growth @ follow.mT


def _adrift(found: Fit) -> Tensor:
    """Which cameras hardly know their principal point, or have so long a lens that they may only seem to `(P,)`."""
    seen = torch.where(found.task.used.unsqueeze(-1), found.task.pixels, torch.nan).flatten(1, 2)
    spread = (seen - seen.nanmean(1, keepdim=True)).square().nanmean(1).sqrt()
    deviations = found.plain_covariance.shared.diagonal(dim1=-2, dim2=-1)[:, 2:4].sqrt()
    adrift = (deviations > ADRIFT * spread).any(-1) | (found.solution.shared[:, :2].abs() > LONG * spread).any(-1)
    return adrift & (found.task.used.any(-1).sum(-1) >= TELLING_VIEWS)


def _free(found: Fit) -> list[str]:
    """The names of the shared parameters that are free, and of which nothing is known beforehand."""
    names = found.task.names
    free = torch.ones(len(names), dtype=torch.bool, device="cpu")
    if found.task.basis is not None:
        free &= (found.task.basis != 0).any(-1).any(0).cpu()
    if (known := found.measured_precision()) is not None:
        free &= ~(known.diagonal(dim1=-2, dim2=-1) > 0).any(0).cpu()
    return [name for name, is_free in zip(names, free.tolist(), strict=True) if is_free]


def _free_groups(found: Fit) -> list[tuple[str, ...]]:
    """The one-sided groups as far as they are free."""
    free = _free(found)
    groups = [tuple(name for name in group if name in free) for group in ONE_SIDED]
    return [group for group in groups if group]


def _poorer_lenses(found: Fit) -> list[tuple[str, ...]]:
    """What to hold for a lens with ever more terms, from none on."""
    free, task = _free(found), found.task
    terms = tuple(name for name in task.parameters.coefficient_names if name in free)
    if not MODELS[task.lens].perspective:
        choices = [terms, tuple(name for name in terms if name in LATE)]
    else:
        radial = tuple(name for name in terms if name[0] == "k" and name != "k1")
        shifts = tuple(name for name in terms if name in ("p1", "p2"))
        choices = [terms, tuple(name for name in terms if name != "k1"), radial, shifts]
    return list(dict.fromkeys(filter(None, choices)))


def _together(groups: list[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """The names of all groups, then of fewer and fewer of them."""
    return [
        tuple(name for group in chosen for name in group)
        for count in range(len(groups), 0, -1)
        for chosen in combinations(groups, count)
    ]


def _without(found: Fit, held: tuple[str, ...]) -> Fit:
    """The fit to the same corners with some of the parameters 0."""
    task, shared = found.task, found.solution.shared.detach().clone()
    where = [task.names.index(name) for name in held]
    shared[:, where] = 0.0
    return fit(task.holding(where), shared, tuple(z.detach() for z in found.solution.local))


def _noticed(whole: Fit, simpler: Fit, held: tuple[str, ...]) -> Tensor:
    """How improbable it is that the corners want what was held `(n,)`, as deviations of a normal variable.

    As far as corners err together within a view, as many say as little as fewer would. The richer camera tells how far
    they do, for the residuals of one that is too simple go together.
    """
    more, cost = simpler.solution.cost - whole.solution.cost, simpler.solution.cost
    unknowns = torch.full_like(cost, len(held))
    return effect(more / dispersion(whole), unknowns, cost, simpler.degrees_of_freedom()).deviations
