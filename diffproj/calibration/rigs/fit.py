"""From a rig's start to its minimum: solve, look again at views that were set apart, reject outliers, solve again."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import MAX_REJECTION_ROUNDS, normal_tensors
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.fitting.task import NEGLIGIBLE_PX
from diffproj.calibration.least_squares.losses import Loss
from diffproj.calibration.least_squares.normal_equations import Equations
from diffproj.calibration.least_squares.solver import Prior
from diffproj.calibration.problem.shape import Restraint
from diffproj.calibration.results.border import border_with_rays
from diffproj.calibration.rigs.knowledge import RigKnowledge
from diffproj.calibration.rigs.options import free_directions
from diffproj.calibration.rigs.parameters import RigParameters
from diffproj.calibration.rigs.problem import RigProblem
from diffproj.calibration.rigs.start import RigStart
from diffproj.calibration.rigs.together import Refinement, Wanted
from diffproj.calibration.rigs.views import RigViews
from diffproj.lens.models import MODELS

READMITTED = 10.0
"""RMS residuals of all views up to which a view that was set apart fits after all."""
LEAST_PX = 1e-6
"""Noise in pixels below which residuals are rounding errors, none of which is an outlier."""


@dataclass(frozen=True, eq=False)
class RigFit:
    """The fit of a rig.

    Attributes:
        views: of all cameras.
        problem: with the corners used in the last round, its unknowns counted from the minimum.
        shared: the unknowns `(1, s)`: intrinsics, and poses that have not moved from the problem's base.
        local: the target in the rig at each moment, from its middle.
        equations: there.
        used, rejected: corners `(V_c, N)` by camera.
        apart: views that contradict the others at their moment `(V_c,)`, which were left out.
        status, iterations: of the solver.
        basis: of the free directions of the shared unknowns `(1, s, q)`, or `None` for all.
        loss: a robust loss, or `None`.
        restrained: cameras whose terms below the line are held, for without that their lens folds.
        restraint: what fixes the frame of free points; `None` where none are free.
        positions: of the shared unknowns that are held.
        prior_variance: the variance of residuals that what is known beforehand was weighed against.
        held_errors: the covariance of what is held, as `held_errors.py` has it; `None` where it counts as exact.
    """

    views: RigViews
    problem: RigProblem
    shared: Tensor
    local: tuple[Tensor, ...]
    equations: Equations
    used: dict[str, Tensor]
    rejected: dict[str, Tensor]
    apart: dict[str, Tensor]
    status: int
    iterations: int
    basis: Tensor | None
    loss: Loss | None
    restrained: tuple[str, ...] = ()
    restraint: Restraint | None = None
    positions: tuple[int, ...] = ()
    prior_variance: float = 1.0
    held_errors: Tensor | None = None

    @property
    def prior(self) -> Prior | None:
        """What is minimised besides the residuals."""
        return prior_of(self.restraint, self.parameters)

    @property
    def parameters(self) -> RigParameters:
        """Which unknowns the views share."""
        return self.problem.parameters

    @property
    def free(self) -> int:
        """How many shared unknowns are free."""
        return self.parameters.size if self.basis is None else self.basis.shape[-1]

    def curvature(self, bend: Tensor) -> Equations:
        """The normal equations with all that is minimised, and for each camera the mean slope of a loss `(C,)`."""
        _, H = self.problem.totals(self.shared, self.local, None, scale=bend)
        for more in (self.problem.precision(self.shared), None if self.prior is None else self.prior.whole):
            H = H if more is None else H._replace(U=H.U + more)
        return H

    @cached_property
    def by_camera(self) -> dict[str, Tensor]:
        """Projected minus seen corners `(V_c, N, 2)`, 0 where a corner was not used."""
        residuals = self.problem.residuals(self.shared, self.local)
        self.problem.forget()
        return _by_camera(self.views, self.problem, residuals)


def rig_fit(
    views: RigViews,
    parameters: RigParameters,
    intrinsics: Mapping[str, Tensor],
    start: RigStart,
    inliers: Mapping[str, Tensor],
    positions: Sequence[int],
    options: Options,
    known: RigKnowledge | None = None,
    restrained: Sequence[str] = (),
) -> Refinement[RigFit]:
    """The minimum, by what it wants of the solver.

    Args:
        views: of all cameras.
        parameters: the shared unknowns.
        intrinsics: of each camera to start from.
        start: the cameras and the target in the rig.
        inliers: corners that no camera on its own rejected `(V_c, N)`.
        positions: of the shared unknowns that are held.
        options: checked.
        known: what is known of the cameras beforehand.
        restrained: cameras whose terms below the line had to be held near others on their own. Let go, they nearly
            cancel, if the lens folds by that or not; so they are held here, too.
    """
    terms = _below(parameters)
    below = {name: terms[name] for name in restrained if not set(terms[name]) <= set(positions)}
    positions = sorted({*positions, *(position for one in below.values() for position in one)})
    found = yield from _fitted(views, parameters, intrinsics, start, inliers, positions, options, known)
    folding = _folding(found, intrinsics)
    if folding:  # two terms of a rational lens that nearly cancel: on its own, the camera's was kept from that
        positions = sorted({*positions, *(position for one in folding.values() for position in one)})
        found = yield from _fitted(views, parameters, intrinsics, start, inliers, positions, options, known)
    below |= folding
    return replace(found, restrained=tuple(below), positions=tuple(positions))


def _below(parameters: RigParameters) -> dict[str, list[int]]:
    """Where the terms below the line stand among the shared unknowns, by camera."""
    found = {}
    for c, (name, kind) in enumerate(zip(parameters.cameras, parameters.kinds, strict=True)):
        start = parameters.intrinsics(c).start
        found[name] = [start + kind.names.index(term) for term in MODELS[kind.lens].below]
    return found


def _folding(found: RigFit, alone: Mapping[str, Tensor]) -> dict[str, list[int]]:
    """Where the free terms below the line stand, of the cameras whose lens folds at its corners.

    Or inside the image, of which it has rays for less than with the intrinsics of the camera `alone`.
    """
    R, t = found.problem.cameras(found.shared)
    free = torch.ones_like(found.shared[0]) if found.basis is None else found.basis[0].abs().sum(-1)
    below, every = {}, _below(found.parameters)
    for c, (name, kind) in enumerate(zip(found.views.names, found.parameters.kinds, strict=True)):
        own, where = found.parameters.intrinsics(c), found.views.where[name]
        terms = every[name]
        if not any(bool(free[i] > 0) for i in terms):
            continue
        R_v, t_v = R[c] @ found.local[0][0, where], found.local[1][0, where] @ R[c].T + t[c]
        _, valid = kind.unpack(found.shared[0, own], (R_v, t_v)).project(found.views.points)
        folds = bool((found.used[name] & ~valid).any())
        if not folds and (size := found.views.data[name].views.size) is not None:
            both = kind.unpack(
                torch.stack([found.shared[0, own], alone[name]]), (R[c].expand(2, 3, 3), t[c].expand(2, 3))
            )
            reached, before = border_with_rays(both, size).tolist()
            folds = reached < before
        if folds:
            below[name] = terms
    return below


def _fitted(
    views: RigViews,
    parameters: RigParameters,
    intrinsics: Mapping[str, Tensor],
    start: RigStart,
    inliers: Mapping[str, Tensor],
    positions: Sequence[int],
    options: Options,
    known: RigKnowledge | None,
) -> Refinement[RigFit]:
    shared = start.t.new_zeros(1, parameters.size)
    for c, name in enumerate(views.names):
        shared[0, parameters.intrinsics(c)] = intrinsics[name]
        if c:
            shared[0, parameters.pose(c)] = torch.cat([torch.zeros_like(start.t[c]), start.t[c]])
    local = tuple(part.unsqueeze(0) for part in start.poses)
    given = {name: views.data[name].used[0] for name in views.names}
    used = {name: _enough(inliers[name] & ~start.apart[name].unsqueeze(-1)) for name in views.names}
    fit = Rounds(views, parameters, start.R, positions, options, known=known)
    yield from fit.solve(used, shared, local)
    apart = fit.reviewed(given, start.apart)
    if any(bool((apart[name] != start.apart[name]).any()) for name in views.names):
        used = {name: _enough(inliers[name] & ~apart[name].unsqueeze(-1)) for name in views.names}
        yield from fit.solve(used, fit.shared, fit.local)
    rejected = yield from fit.without_outliers(given, apart)
    return fit.at_the_minimum(rejected, apart)


def _in_normal_tensors(found: RigFit) -> RigFit:
    """The fit outside of inference mode."""
    state = normal_tensors((found.shared, found.local, found.equations, found.problem.base))
    problem = RigProblem(found.views, found.parameters, state[3][0], found.used, found.problem.known)
    return replace(found, shared=state[0], local=state[1], equations=state[2], problem=problem)


def prior_of(restraint: Restraint | None, parameters: RigParameters) -> Prior | None:
    """What restrains free points, as the solver takes it."""
    if restraint is None:
        return None
    few = parameters.few
    held = torch.nn.functional.pad(torch.diag_embed(restraint.alone) + restraint.measured, (few, 0, few, 0))
    root = torch.nn.functional.pad(restraint.root, (0, 0, few, 0))
    return Prior(torch.zeros_like(held[..., 0]), held, root=root)


class Rounds:
    """The solver's rounds, each from where the last ended."""

    def __init__(
        self,
        views: RigViews,
        parameters: RigParameters,
        base: Tensor,
        held: Sequence[int],
        options: Options,
        restraint: Restraint | None = None,
        known: RigKnowledge | None = None,
    ) -> None:
        self.views, self.parameters, self.base, self.held, self.options = views, parameters, base, tuple(held), options
        self.restraint, self.prior, self.known = restraint, prior_of(restraint, parameters), known
        self.iterations, self.round = 0, 0

    def without_outliers(self, given: dict[str, Tensor], apart: dict[str, Tensor]) -> Refinement[dict[str, Tensor]]:
        """Which of the given corners are left out `(V_c, N)`: of views apart, and outliers, if they are to be."""
        names = self.views.names
        rejected = {name: given[name] & apart[name].unsqueeze(-1) for name in names}
        if self.options.outlier_limit is None:
            return rejected
        for _ in range(MAX_REJECTION_ROUNDS):
            kept = self.inliers(given, self.options.outlier_limit)
            kept = {name: kept[name] & ~apart[name].unsqueeze(-1) for name in names}
            rejected = {name: given[name] & ~kept[name] for name in names}
            enough = {name: _enough(part) for name, part in kept.items()}
            if all(torch.equal(enough[name], self.used[name]) for name in names):
                break
            yield from self.solve(enough, self.shared, self.local)
        return rejected

    def solve(self, used: dict[str, Tensor], shared: Tensor, local: tuple[Tensor, ...]) -> Refinement[None]:
        """A round on these corners, from unknowns `(1, s)` and poses of the target."""
        options, self.used = self.options, used
        self.problem = RigProblem(self.views, self.parameters, self.base, used, self.known)
        self.every = sum(int(part.sum()) for part in used.values())
        rounds = 1 if options.outlier_limit is None else 1 + MAX_REJECTION_ROUNDS
        before = min(self.round, rounds - 1) * options.max_iterations

        def tell(step: int, _: Tensor) -> None:
            if options.progress is not None:
                options.progress(before + step, rounds * options.max_iterations)

        ended = yield Wanted(
            self.problem,
            shared,
            local,
            self.held,
            self.prior,
            options.loss,
            options.max_iterations,
            options.tolerance,
            max(1, self.every) * self._scale() * NEGLIGIBLE_PX**2,
            tell,
        )
        self.shared, self.local, self.status, more = ended
        self.iterations, self.round = self.iterations + more, self.round + 1

    def _scale(self) -> float:
        """What a negligible residual costs, over its square: little with small weights, or a small loss."""
        weights = [group.weights.max() for group in self.problem.groups if group.weights is not None]
        scale = float(min(weights)) if weights else 1.0
        if self.options.loss is not None:
            squared = torch.full((1,), NEGLIGIBLE_PX**2, dtype=torch.float64, device=self.shared_device)
            scale *= float(self.options.loss.value(squared)) / NEGLIGIBLE_PX**2
        return scale

    @property
    def shared_device(self) -> torch.device:
        """Where it computes."""
        return self.base.device

    def residuals(self, used: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Of more corners than were fitted to `(V_c, N, 2)`."""
        problem = RigProblem(self.views, self.parameters, self.base, used)
        return _by_camera(self.views, problem, problem.residuals(self.shared, self.local))

    @torch.inference_mode()
    def reviewed(self, given: dict[str, Tensor], apart: dict[str, Tensor]) -> dict[str, Tensor]:
        """Views that still contradict the others at the minimum, of those that were set apart."""
        if not any(bool(part.any()) for part in apart.values()):
            return apart
        squares = {name: off.square().sum(-1) for name, off in self.residuals(given).items()}
        fitted = sum(float(squares[name][self.used[name]].sum()) for name in squares)
        level = max(fitted / max(1, self.every), LEAST_PX**2)
        mean = {name: squares[name].sum(-1) / given[name].sum(-1).clamp(min=1) for name in squares}
        return {name: part & ~(mean[name] <= READMITTED**2 * level) for name, part in apart.items()}

    @torch.inference_mode()
    def inliers(self, given: dict[str, Tensor], limit: float) -> dict[str, Tensor]:
        """Which of the given corners are inliers `(V_c, N)`, by their weighted residuals and their camera's noise."""
        kept = {}
        for name, residual in self.residuals(given).items():
            weights = self.views.data[name].weights
            residual = residual if weights is None else residual * weights[0].sqrt().unsqueeze(-1)
            known = torch.where(self.used[name].unsqueeze(-1), residual.abs(), torch.nan)
            sigma = (1.4826 * known.flatten().nanmedian()).clamp(min=LEAST_PX)
            kept[name] = given[name] & (residual.square().sum(-1) <= (limit * sigma).square())
        return kept

    def at_the_minimum(self, rejected: dict[str, Tensor], apart: dict[str, Tensor]) -> RigFit:
        """Where the last round ended, with the unknowns counted from there."""
        with torch.inference_mode():
            base, t = self.problem.places(self.shared)
            shared = self.shared.clone()
            for c in range(1, t.shape[1]):
                shared[0, self.parameters.pose(c)] = torch.cat([torch.zeros_like(t[0, c]), t[0, c]])
            problem = self.problem.rebased(base)
            _, equations = problem.equations(shared, self.local, self.options.loss)
            if self.prior is not None:
                equations = equations._replace(U=equations.U + self.prior.whole)
        found = RigFit(
            self.views,
            problem,
            shared,
            self.local,
            equations,
            self.used,
            rejected,
            apart,
            self.status,
            self.iterations,
            free_directions(self.parameters, self.held, self.base),
            self.options.loss,
            restraint=self.restraint,
        )
        return _in_normal_tensors(found)


def _enough(used: Tensor) -> Tensor:
    """The same without views of fewer than four corners."""
    return used & (used.sum(-1, keepdim=True) >= 4)


def _by_camera(views: RigViews, problem: RigProblem, residuals: list[Tensor]) -> dict[str, Tensor]:
    found = {name: torch.zeros_like(views.data[name].pixels[0]) for name in views.names}
    for group, residual in zip(problem.groups, residuals, strict=True):
        for c in group.members:
            mine = group.camera == c
            found[views.names[c]][group.number[mine]] = residual[mine].mT
    return found
