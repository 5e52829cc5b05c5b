"""Lenses within lenses: the fit of a rich one starts from the lowest of all the poorer ones that it contains.

The terms of a long lens nearly cancel each other, and those of a tilted sensor, a prism and skew do much the same as a
shifted principal point: from far off they lead into side valleys. So they come in groups, and the camera is fitted with
none of them, then with one, with two and so on. Every fit starts from the lowest of those with one group fewer. As the
solver only ever goes down, a richer lens never ends above a poorer one.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.fitting.positive_focal import with_positive_focal_lengths
from diffproj.calibration.fitting.second_look import second_look
from diffproj.calibration.fitting.start import Straightened
from diffproj.calibration.nested.factors import aside
from diffproj.calibration.nested.restraint import restrained
from diffproj.calibration.nested.tilt_twin import lower_valley
from diffproj.calibration.outcome import begun
from diffproj.calibration.problem.parametrisation import SKEW, Parametrisation, Pose
from diffproj.calibration.trust.entangled import DENOMINATOR
from diffproj.lens.models import MODELS

SHORT = 5
"""Coefficients up to which a lens is fitted at once."""
PRISM, TILT = ("s1", "s2", "s3", "s4"), ("tau_x", "tau_y")
GROUPS = ((SKEW,), PRISM, TILT, DENOMINATOR)
"""Parameters that a long lens gets one group after the other."""


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
    """

    data: Data
    chosen: Options
    parameters: Parametrisation
    shared: Tensor
    local: Pose
    reference: Tensor
    straight: Straightened
    size: tuple[int, int]

    def richest(self) -> Fit:
        """The fit with all groups."""
        groups = self._groups()
        if not groups:
            return self._fit(self.chosen, (self.shared, self.local))
        early = self.chosen.but(
            objective="image",
            reject_outliers=False,
            loss=None if self.chosen.objective == "plane" else self.chosen.loss,  # its scale is in world units
            progress=None,
        )
        fits: dict[tuple[tuple[str, ...], ...], Fit] = {}
        for count in range(len(groups)):
            for inside in combinations(groups, count):
                if TILT in inside and PRISM in groups and PRISM not in inside:
                    continue  # no lens has it
                held = [name for group in groups if group not in inside for name in group]
                options = early.but(fixed=(*early.fixed, *held))
                fits[inside] = self._fit(options, self._start(fits, inside), inside)
        return self._fit(self.chosen, self._start(fits, tuple(groups)), tuple(groups))

    def _groups(self) -> list[tuple[str, ...]]:
        """The groups of which some parameters are free; none for a short lens."""
        if MODELS[self.parameters.lens].count <= SHORT or "distortion" in self.chosen.fixed:
            return []
        names = self.parameters.names
        return [g for g in GROUPS if set(g) <= set(names) and not set(g) <= set(self.chosen.fixed)]

    def _start(
        self, fits: dict[tuple[tuple[str, ...], ...], Fit], inside: tuple[tuple[str, ...], ...]
    ) -> tuple[Tensor, Pose]:
        """Shared parameters and poses of the lowest fit with one group fewer, of each camera."""
        poorer = (tuple(g for g in inside if g != left) for left in inside)
        fewer = [fits[names].solution for names in poorer if names in fits]
        if not fewer:
            return self.shared, self.local
        costs = torch.stack([solution.cost.nan_to_num(torch.inf) for solution in fewer])
        best = costs.argmin(0), torch.arange(costs.shape[1], device=costs.device)
        shared = torch.stack([solution.shared for solution in fewer])[best]
        local = zip(*(solution.local for solution in fewer), strict=True)
        return shared, tuple(torch.stack(parts)[best] for parts in local)

    def _fit(self, options: Options, start: tuple[Tensor, Pose], inside: tuple[tuple[str, ...], ...] = ()) -> Fit:
        """The lowest fit that is found from there, with these groups."""
        begin = begun(self.data, options, self.parameters, *start, self.reference)
        steps: dict[str, Any] = {"max_iterations": options.max_iterations, "tolerance": options.tolerance}
        limit, beside = options.outlier_limit, None
        if DENOMINATOR in inside:
            both: dict[str, Any] = steps | {"reject": limit, "progress": options.progress}
            found, beside = aside(begin.task, begin.shared, begin.local, self.size, **both)
        else:
            found = begin.minimum(options)
        # The valleys of a prism alone and of a denominator are long; many steps to a tilt may lead to a side one.
        long_valley = inside == (PRISM,) or DENOMINATOR in inside
        found = second_look(found, self.straight, reject=limit, long_valley=long_valley, **steps)
        found = with_positive_focal_lengths(found, **steps)
        if DENOMINATOR in inside:
            found = restrained(found, *start, self.size, beside, reject=limit, **steps)
        return lower_valley(found, self.size, reject=limit, **steps) if TILT in inside else found
