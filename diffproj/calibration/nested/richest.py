"""Lenses within lenses: the fit of a rich one starts from poorer ones that it contains.

The terms of a long lens nearly cancel each other, and those of a tilted sensor, a prism and skew do much the same as a
shifted principal point: from far off they lead into side valleys. So they come in groups. The camera is fitted with
none of them, from there with all but one of them, whichever that is, and from the lowest of these with all. As the
solver only ever goes down, none ends above what it started from. The lens without the tilt is fitted in the same way,
as it is on its own: started at once from that with no group it ended above that, and so did the one with the tilt, of
120 random cameras 3 by .2 to 1.8 % of the cost.

The other fits in between only choose the valley, and end as soon as steps buy next to nothing. So some ends are no
good: the lens folds, or it fits badly where that with none of the groups came about in a doubtful way. Then all is done
once more, thoroughly: with one group, with two and so on, each from the lowest of those with one fewer, to their
minima, the rational ones from factors, too, and none that folds; and from there with all groups, from each of those
with one fewer. What ends above one of these all the same is held to it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.fitting.positive_focal import with_positive_focal_lengths
from diffproj.calibration.fitting.second_look import LOWER, doubtful, second_look
from diffproj.calibration.fitting.start import Straightened
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.nested.compared import costs, put
from diffproj.calibration.nested.factors import FACTORS, FEW_STEPS, with_factor
from diffproj.calibration.nested.restraint import not_above, restrained
from diffproj.calibration.nested.side_by_side import Lane, side_by_side
from diffproj.calibration.nested.tilt_twin import lower_valley
from diffproj.calibration.outcome import Begun, begun
from diffproj.calibration.problem.parametrisation import SKEW, Parametrisation, Pose
from diffproj.calibration.trust.reach import folds_at_corners, reach_of
from diffproj.lens.models import DENOMINATOR, MODELS

SHORT = 5
"""Coefficients up to which a lens is fitted at once."""
BETWEEN, BEFORE_TILT, NEARLY = 1e-4, 1e-6, 1e-8
"""Tolerance of the fits in between, by ten times which a parameter lowers the cost of a thousand residuals by chance;
where the next has a tilt, with which there are many valleys; and where all go on to their minima."""
PRISM, TILT = ("s1", "s2", "s3", "s4"), ("tau_x", "tau_y")
GROUPS = ((SKEW,), PRISM, TILT, DENOMINATOR)
"""Parameters that a long lens gets one group after the other."""
Groups = tuple[tuple[str, ...], ...]


@dataclass(frozen=True, eq=False)
class Nested:
    """The fits of P cameras with ever more groups of parameters.

    Attributes:
        data: the views.
        chosen: options of the richest fit.
        parameters: which there are.
        shared: where the poorest fit starts `(P, s)`.
        local: its poses.
        reference: what is held, as `begun` takes it.
        straight: the corners as the first estimate of the lens straightens them.
        size: of the image.
        rows: which of the cameras `(n,)` only are fitted; `None` for all.
    """

    data: Data
    chosen: Options
    parameters: Parametrisation
    shared: Tensor
    local: Pose
    reference: Tensor
    straight: Straightened
    size: tuple[int, int]
    rows: Tensor | None = None

    def richest(self) -> Fit:
        """The fit with all groups."""
        if not self._groups:
            found = self._begun(self.chosen, self.shared, self.local).minimum(self.chosen)
            return self._looked_at(found, self.chosen)
        options = self._poorest_options()
        poorest = self._begun(options, self.shared, self.local).minimum(options)
        return self._lowest_from(with_positive_focal_lengths(poorest, **_steps(options)))

    def _poorest_options(self) -> Options:
        """The options of the fit with none of the groups."""
        options = self._early(NEARLY)
        return options.but(fixed=(*options.fixed, *(name for group in self._groups for name in group)))

    def _lowest_from(self, poorest: Fit) -> Fit:
        """The fit with all groups, from the one with none."""
        in_between = len(self._groups) > 1
        found, lost = self._quickly(poorest) if in_between else self._thoroughly(poorest)
        again = doubtful(poorest, steps_tell=True)
        if bool(again.any()):
            again &= lost | found.is_restrained() | doubtful(found, steps_tell=False)
        rows = (again | lost if in_between else again).nonzero().flatten()
        if len(rows) == 0:
            return found
        own = rows if self.rows is None else self.rows[rows]
        some = replace(self, straight=self.straight.part(rows), rows=own)
        other, _ = some._thoroughly(some._looked_at(poorest.part(rows), self._poorest_options()))
        return self._better(found, rows, other)

    def _quickly(self, poorest: Fit) -> tuple[Fit, Tensor]:
        """The fit with all groups from the lowest with one fewer; and whether its lens folds `(P,)`."""
        fits: dict[Groups, Fit] = {(): poorest}
        if TILT in self._groups and self._upright:
            # As it is fitted on its own: else that would end lower than the fit with all groups now and then.
            fits[self._upright] = _no_start(*self._without_tilt()._quickly(poorest))
        some = [inside for inside in self._with(len(self._groups) - 1) if inside not in fits]
        fits |= self._between(some, fits, thorough=False) if some else {}
        return self._whole(self._lowest(fits, self._groups), thorough=False)

    def _thoroughly(self, poorest: Fit) -> tuple[Fit, Tensor]:
        """The lowest fit with all groups, from each with one fewer; and whether it folds even if restrained `(P,)`."""
        fits: dict[Groups, Fit] = {(): poorest}
        for count in range(1, len(self._groups)):
            some = [inside for inside in self._with(count) if inside != self._upright]
            fits |= self._between(some, fits, thorough=True) if some else {}
        if TILT in self._groups and self._upright:  # as they are fitted on their own
            fits[self._upright] = self._without_tilt()._lowest_from(poorest)
        ends = [
            self._whole((start.shared, start.local), thorough=True)
            for start in (fits[inside].solution for inside in self._with(len(self._groups) - 1))
        ]
        found, folds = ends[0]
        every = torch.arange(len(folds), device=folds.device)
        for other, also in ends[1:]:
            found, folds = self._better(found, every, other), folds & also
        found, folds = self._held_near_another(found, folds, [fits[inside] for inside in reversed(fits)])
        prior = self._begun(self._early(NEARLY), *found.solution[:2]).task.prior
        limits = {"reject": self.chosen.outlier_limit, **_steps(self.chosen)}
        for inside in self._with(len(self._groups) - 1):
            found = not_above(found, fits[inside], prior, self.size, **limits)
        return found, folds

    def _better(self, found: Fit, rows: Tensor, other: Fit) -> Fit:
        """The fit with some cameras `(n,)` replaced whose other one reaches farther, or as far and is lower."""
        before, now = costs(found, other, rows, self.chosen.outlier_limit)
        reached, reaches = reach_of(found.part(rows), self.size), reach_of(other, self.size)
        better = (reaches > reached) | ((reaches == reached) & (now < before * (1 - LOWER)))
        return put(found, rows[better], other, better)

    def _held_near_another(self, found: Fit, folds: Tensor, others: list[Fit]) -> tuple[Fit, Tensor]:
        """The fit with lenses that fold `(P,)` restrained near the first of the poorer ones with which that helps."""
        limits = {"reject": self.chosen.outlier_limit, **_steps(self.chosen)}
        rows = folds.nonzero().flatten()
        for poorer in others:
            if len(rows) == 0:
                break
            near = poorer.part(rows).solution
            held, still = restrained(found.part(rows), near.shared, near.local, self.size, **limits)
            found = put(found, rows[~still], held, ~still)
            rows = rows[still]
        return found, torch.zeros_like(folds).index_fill(0, rows, True)

    @property
    def _groups(self) -> Groups:
        """The groups of which some parameters are free; none for a short lens."""
        if MODELS[self.parameters.lens].count <= SHORT or "distortion" in self.chosen.fixed:
            return ()
        names = self.parameters.names
        return tuple(g for g in GROUPS if set(g) <= set(names) and not set(g) <= set(self.chosen.fixed))

    @property
    def _upright(self) -> Groups:
        """The groups without the tilt."""
        return tuple(group for group in self._groups if group != TILT)

    def _without_tilt(self) -> "Nested":
        """The same for the lens without the tilt, from which the one with it starts."""
        return replace(self, chosen=self._early(NEARLY).but(fixed=(*self.chosen.fixed, *TILT)))

    def _early(self, tolerance: float) -> Options:
        """The options of fits that others start from."""
        return self.chosen.but(
            objective="image",
            reject_outliers=False,
            loss=None if self.chosen.objective == "plane" else self.chosen.loss,  # its scale is in world units
            progress=None,
            tolerance=max(tolerance, self.chosen.tolerance),
        )

    def _begun(self, options: Options, shared: Tensor, local: Pose) -> Begun:
        begin = begun(self.data, options, self.parameters, shared, local, self.reference, self.rows)
        return begin if options is self.chosen else begin._replace(task=replace(begin.task, brief=True))

    def _looked_at(self, found: Fit, options: Options, long_valley: bool = False) -> Fit:
        """The fit after a second look, with focal lengths that make sense."""
        steps = _steps(options)
        found = second_look(found, self.straight, reject=options.outlier_limit, long_valley=long_valley, **steps)
        return with_positive_focal_lengths(found, **steps)

    def _with(self, count: int) -> Iterator[Groups]:
        """The sets of as many groups; none has a tilt without a prism if there is one."""
        for inside in combinations(self._groups, count):
            if TILT not in inside or PRISM in inside or PRISM not in self._groups:
                yield inside

    def _between(self, some: list[Groups], fits: dict[Groups, Fit], *, thorough: bool) -> dict[Groups, Fit]:
        """The fits with as many of the groups, each from the lowest poorer one."""
        options = self._early(NEARLY if thorough else BEFORE_TILT if TILT in self._groups else BETWEEN)
        starts = {inside: self._lowest(fits, inside) for inside in some}
        begin = self._begun(options, *starts[some[0]])
        lanes = {inside: Lane(*start, options.max_iterations, self._held(inside)) for inside, start in starts.items()}
        through = [inside for inside in some if TILT not in inside] if thorough else []
        found, beside = self._side_by_side(begin.task, lanes, through, options)
        ends = {}
        for inside in some:
            end = with_positive_focal_lengths(found[inside], **_steps(options))
            if DENOMINATOR in inside and thorough:
                end, _ = restrained(end, *starts[inside], self.size, beside.get(inside), reject=None, **_steps(options))
            elif DENOMINATOR in inside:
                end = _no_start_if_folded(end)
            ends[inside] = end
        return ends

    def _whole(self, start: tuple[Tensor, Pose], *, thorough: bool) -> tuple[Fit, Tensor]:
        """The fit with all groups; and whether its lens folds `(P,)`, which is mended where it can be if thorough."""
        options, inside = self.chosen, self._groups
        steps, limit = _steps(options), options.outlier_limit
        begin = self._begun(options, *start)
        lanes = {inside: Lane(begin.shared, begin.local, options.max_iterations)}
        ends, beside = self._side_by_side(begin.task, lanes, [inside], options)
        # The valleys of a prism alone and of a denominator are long; many steps to a tilt may lead to a side one.
        found = self._looked_at(ends[inside], options, inside == (PRISM,) or DENOMINATOR in inside)
        folds = torch.zeros_like(found.rejected[:, 0, 0])
        if DENOMINATOR in inside:
            found, folds = restrained(
                found, *start, self.size, beside.get(inside), hold=thorough, reject=limit, **steps
            )
        if TILT in inside:
            found = lower_valley(found, self.size, reject=limit, **steps)
        return found, folds

    def _side_by_side(
        self, task: Task, lanes: dict[Groups, Lane], through: list[Groups], options: Options
    ) -> tuple[dict[Groups, Fit], dict[Groups, Fit]]:
        """Where the lanes end; and where a few steps from a start with a factor lead, of those that are to have one."""
        few = min(options.max_iterations, FEW_STEPS)
        factors = {}
        for inside in through:
            factor = with_factor(task, lanes[inside].shared, self.size, FACTORS[0]) if DENOMINATOR in inside else None
            if factor is not None:
                factors[inside] = replace(lanes[inside], shared=factor, max_iterations=few)
        limits: dict[str, Any] = {"reject": options.outlier_limit, "tolerance": options.tolerance}
        ends = side_by_side(task, [*lanes.values(), *factors.values()], progress=options.progress, **limits)
        return dict(zip(lanes, ends, strict=False)), dict(zip(factors, ends[len(lanes) :], strict=True))

    def _held(self, inside: Groups) -> tuple[int, ...]:
        """Positions of the parameters of the other groups."""
        others = {name for group in self._groups if group not in inside for name in group}
        return tuple(i for i, name in enumerate(self.parameters.names) if name in others)

    def _lowest(self, fits: dict[Groups, Fit], inside: Groups) -> tuple[Tensor, Pose]:
        """Shared parameters and poses of the lowest fit with one group fewer, of each camera; or of that with none."""
        poorer = [tuple(g for g in inside if g != left) for left in inside]
        fewer = [fits[groups].solution for groups in poorer if groups in fits] or [fits[()].solution]
        each = torch.stack([solution.cost.nan_to_num(torch.inf) for solution in fewer])
        best = each.argmin(0), torch.arange(each.shape[1], device=each.device)
        shared = torch.stack([solution.shared for solution in fewer])[best]
        local = zip(*(solution.local for solution in fewer), strict=True)
        return shared, tuple(torch.stack(parts)[best] for parts in local)


def _no_start_if_folded(found: Fit) -> Fit:
    """The same at infinite cost where the lens folds before its corners, so that no richer one starts from there."""
    return _no_start(found, folds_at_corners(found.task, found.solution.shared, found.solution.local))


def _no_start(found: Fit, where: Tensor) -> Fit:
    solution = found.solution
    return Fit(found.task, solution._replace(cost=solution.cost.masked_fill(where, torch.inf)), found.rejected)


def _steps(options: Options) -> dict[str, Any]:
    return {"max_iterations": options.max_iterations, "tolerance": options.tolerance}
