"""Lenses within lenses: the fit of a rich one starts from the lowest of all the poorer ones that it contains.

The terms of a long lens nearly cancel each other, and those of a tilted sensor, a prism and skew do much the same as a
shifted principal point: from far off they lead into side valleys. So they come in groups, and the camera is fitted with
none of them, then with one, with two and so on, those with as many side by side. Every fit starts from the lowest of
those with one group fewer, and the solver only ever goes down.

The fits in between only choose the valley, and end as soon as steps buy next to nothing; but those that a tilt is added
to go on to their minima, for with a tilt there are many valleys.

That is done once more, thoroughly, where it ends in a lens that has to be restrained: then all in between go on to
their minima, some of them from factors, too. And where the poorest fit was doubtful, from a second look at that; but
only if the fit with all groups leaves more than noise. Through a poor lens the residuals are no noise anyway.
"""

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
from diffproj.calibration.nested.restraint import restrained
from diffproj.calibration.nested.side_by_side import Lane, side_by_side
from diffproj.calibration.nested.tilt_twin import lower_valley
from diffproj.calibration.outcome import Begun, begun
from diffproj.calibration.problem.parametrisation import SKEW, Parametrisation, Pose
from diffproj.calibration.trust.entangled import DENOMINATOR
from diffproj.calibration.trust.reach import folds_at_corners, reach_of
from diffproj.lens.models import MODELS

SHORT = 5
"""Coefficients up to which a lens is fitted at once."""
BETWEEN = 1e-4
"""Tolerance of the fits in between: by chance alone a parameter lowers the cost of a thousand residuals by ten times
this part of it."""
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
        options = self._early(loose=False)
        options = options.but(fixed=(*options.fixed, *(name for group in self._groups for name in group)))
        poorest = self._begun(options, self.shared, self.local).minimum(options)
        found = self._climbed(with_positive_focal_lengths(poorest, **_steps(options)))
        rows = self._unclear(found, poorest).nonzero().flatten()
        if len(rows) == 0:
            return found
        some = replace(self, straight=self.straight.part(rows), rows=rows)
        other = some._climbed(some._looked_at(poorest.part(rows), options), thorough=True)
        before, now = costs(found, other, rows, self.chosen.outlier_limit)
        reached, reaches = reach_of(found.part(rows), self.size), reach_of(other, self.size)
        better = (reaches > reached) | ((reaches == reached) & (now < before * (1 - LOWER)))
        return put(found, rows[better], other, better)

    def _unclear(self, found: Fit, poorest: Fit) -> Tensor:
        """Which cameras are fitted once more, thoroughly `(P,)`."""
        held = found.is_restrained()
        unclear = doubtful(poorest, steps_tell=True)
        if bool(unclear.any()):
            unclear &= held | doubtful(found, steps_tell=False)
        return unclear if len(self._groups) == 1 else unclear | held

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

    def _early(self, *, loose: bool) -> Options:
        """The options of fits that others start from."""
        return self.chosen.but(
            objective="image",
            reject_outliers=False,
            loss=None if self.chosen.objective == "plane" else self.chosen.loss,  # its scale is in world units
            progress=None,
            tolerance=max(BETWEEN, self.chosen.tolerance) if loose else self.chosen.tolerance,
        )

    def _begun(self, options: Options, shared: Tensor, local: Pose) -> Begun:
        return begun(self.data, options, self.parameters, shared, local, self.reference, self.rows)

    def _looked_at(self, found: Fit, options: Options, long_valley: bool = False) -> Fit:
        """The fit after a second look, with focal lengths that make sense."""
        steps = _steps(options)
        found = second_look(found, self.straight, reject=options.outlier_limit, long_valley=long_valley, **steps)
        return with_positive_focal_lengths(found, **steps)

    def _climbed(self, poorest: Fit, *, thorough: bool = False) -> Fit:
        """The fit with all groups, from the one with none; thoroughly if those in between go on to their minima."""
        fits: dict[Groups, Fit] = {(): poorest}
        for count in range(1, len(self._upright)):
            fits |= self._between(list(combinations(self._upright, count)), fits, thorough=thorough)
        if self._upright:
            fits[self._upright] = self._whole(self._upright, fits)
        if TILT not in self._groups:
            return fits[self._groups]
        both = {PRISM, TILT} & set(self._groups)  # no lens has a tilt without a prism
        for count in range(len(both), len(self._groups)):
            some = [inside for inside in combinations(self._groups, count) if both <= set(inside)]
            fits |= self._between(some, fits, thorough=thorough)
        return self._whole(self._groups, fits)

    def _between(self, some: list[Groups], fits: dict[Groups, Fit], *, thorough: bool) -> dict[Groups, Fit]:
        """The fits with as many of the groups, each from the lowest poorer one."""
        options = self._early(loose=TILT not in some[0] and not thorough)
        starts = {inside: self._lowest(fits, inside) for inside in some}
        begin = self._begun(options, *starts[some[0]])
        ends = {}
        for inside, (found, beside) in self._side_by_side(begin.task, starts, options, factors=thorough).items():
            end = with_positive_focal_lengths(found, **_steps(options))
            if DENOMINATOR in inside and thorough:
                end = restrained(end, *starts[inside], self.size, beside, reject=None, **_steps(options))
            elif DENOMINATOR in inside:
                end = _no_start_if_folded(end)
            ends[inside] = end
        return ends

    def _whole(self, inside: Groups, fits: dict[Groups, Fit]) -> Fit:
        """The fit with all groups, or all but the tilt."""
        options = self.chosen if inside == self._groups else self._early(loose=False)
        steps, limit = _steps(options), options.outlier_limit
        start = self._lowest(fits, inside)
        begin = self._begun(options, *start)
        starts = {inside: (begin.shared, begin.local)}
        found, beside = self._side_by_side(begin.task, starts, options, factors=True)[inside]
        # The valleys of a prism alone and of a denominator are long; many steps to a tilt may lead to a side one.
        found = self._looked_at(found, options, inside == (PRISM,) or DENOMINATOR in inside)
        if DENOMINATOR in inside:
            found = restrained(found, *start, self.size, beside, reject=limit, **steps)
        return lower_valley(found, self.size, reject=limit, **steps) if TILT in inside else found

    def _side_by_side(
        self, task: Task, starts: dict[Groups, tuple[Tensor, Pose]], options: Options, *, factors: bool
    ) -> dict[Groups, tuple[Fit, Fit | None]]:
        """The minima with some of the groups; and where a few steps with a factor lead, where that is asked for."""
        most, few = options.max_iterations, min(options.max_iterations, FEW_STEPS)
        lanes = {(inside, False): Lane(*start, most, self._held(inside)) for inside, start in starts.items()}
        for inside, (shared, local) in starts.items():
            if factors and DENOMINATOR in inside and TILT not in inside:
                factor = with_factor(task, shared, self.size, FACTORS[0])
                if factor is not None:
                    lanes[inside, True] = Lane(factor, local, few, self._held(inside))
        limits: dict[str, Any] = {"reject": options.outlier_limit, "tolerance": options.tolerance}
        found = side_by_side(task, list(lanes.values()), progress=options.progress, **limits)
        ends = dict(zip(lanes, found, strict=True))
        return {inside: (ends[inside, False], ends.get((inside, True))) for inside in starts}

    def _held(self, inside: Groups) -> tuple[int, ...]:
        """Positions of the parameters of the other groups."""
        others = {name for group in self._groups if group not in inside for name in group}
        return tuple(i for i, name in enumerate(self.parameters.names) if name in others)

    def _lowest(self, fits: dict[Groups, Fit], inside: Groups) -> tuple[Tensor, Pose]:
        """Shared parameters and poses of the lowest fit with one group fewer, of each camera."""
        poorer = (tuple(g for g in inside if g != left) for left in inside)
        fewer = [fits[groups].solution for groups in poorer if groups in fits]
        costs = torch.stack([solution.cost.nan_to_num(torch.inf) for solution in fewer])
        best = costs.argmin(0), torch.arange(costs.shape[1], device=costs.device)
        shared = torch.stack([solution.shared for solution in fewer])[best]
        local = zip(*(solution.local for solution in fewer), strict=True)
        return shared, tuple(torch.stack(parts)[best] for parts in local)


def _no_start_if_folded(found: Fit) -> Fit:
    """The same at infinite cost where the lens folds before its corners, so that no richer one starts from there."""
    solution = found.solution
    folds = folds_at_corners(found.task, solution.shared, solution.local)
    return Fit(found.task, solution._replace(cost=solution.cost.masked_fill(folds, torch.inf)), found.rejected)


def _steps(options: Options) -> dict[str, Any]:
    return {"max_iterations": options.max_iterations, "tolerance": options.tolerance}
