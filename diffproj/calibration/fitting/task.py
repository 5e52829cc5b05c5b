"""`Task`: what is minimised, for P cameras side by side; and the solver run over it, in blocks of cameras."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fitting.options import Progress
from diffproj.calibration.fitting.own_frame import are_solid
from diffproj.calibration.least_squares.everyone import for_each
from diffproj.calibration.least_squares.losses import Loss
from diffproj.calibration.least_squares.normal_equations import Equations
from diffproj.calibration.least_squares.solver import Prior, Solution, solve
from diffproj.calibration.problem.board_error import BoardError
from diffproj.calibration.problem.parametrisation import INTRINSICS, POSE, Parametrisation
from diffproj.calibration.problem.reprojection import Reprojection
from diffproj.calibration.problem.shape import Restraint, restraint_of
from diffproj.calibration.results.calibration import Objective
from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.models import MODELS, LensModel

BLOCK_CORNERS = 24_000
"""Corners per block on a CPU, about thirty cameras of 13 views: enough to hide call overhead, and few enough that a
slowly converging camera delays few others."""
NEGLIGIBLE_PX = 1e-11
"""Size of residuals, in pixels, that is rounding error of pixel coordinates."""


@dataclass(frozen=True, eq=False)
class Task:
    """A minimisation problem: P cameras of V views with N corners.

    Attributes:
        points: the target's points `(N, 3)` in their own frame.
        pixels: `(P, V, N, 2)`.
        used: which corners count `(P, V, N)`.
        lens, bow, skew, free: the model; `free` where the places of the target's points are unknowns.
        objective: residuals on the image or on the board.
        weights: of the corners `(P, V, N)`, or `None` for 1.
        known_noise: whether the weights are one over the variances, so that the residuals need not tell their level.
        spread: the covariances of the points in their own frame `(N, 3, 3)`; `None` where they are exact.
        whitening: what residuals are multiplied by for it `(P, V, N, 2, 2)`: see `surveyed.py`.
        shares: how much each view counts in what all views share `(P, V)`, or `None` for 1: see `distinct.py`. A pose
            is determined by all of its view's corners, whatever the view's share.
        loss: a robust loss, or `None` for least squares.
        prior: on the shared parameters.
        basis: of the shared parameters' free directions `(P, s, q)`, or `None` for all.
        brief: whether coefficients of the lens that are held at 0, and come last, are left out to save time, so that a
            shorter lens is fitted; the normal equations then have zeros for them.
        pose_known: how many of the six coordinates of each pose are held, or known beforehand.
        printed: precision of the displacement of each free point `(P, N, 3, 3)`, in the unit of the weights; `None` for
            0.
        surveyed: whether free points are landmarks, of which that says where they are as a whole, too.
    """

    points: Tensor
    pixels: Tensor
    used: Tensor
    lens: LensModel
    bow: bool = False
    skew: bool = False
    free: bool = False
    objective: Objective = "image"
    weights: Tensor | None = None
    known_noise: bool = False
    spread: Tensor | None = None
    whitening: Tensor | None = None
    shares: Tensor | None = None
    loss: Loss | None = None
    prior: Prior | None = None
    basis: Tensor | None = None
    printed: Tensor | None = None
    surveyed: bool = False
    brief: bool = False
    pose_known: int = 0

    @property
    def solid(self) -> bool:
        """Whether the points do not lie on a plane."""
        return are_solid(self.points)

    @property
    def parameters(self) -> Parametrisation:
        """Which they are, and in which order."""
        return Parametrisation(self.lens, self.bow, self.skew, self.points.shape[-2] if self.free else 0)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the shared parameters."""
        return self.parameters.names

    @property
    def problem(self) -> Reprojection:
        """Residuals and Jacobians."""
        kind = BoardError if self.objective == "plane" else Reprojection
        which = self.points, self.pixels, self.used, self.lens, self.bow, self.skew, self.whitening
        return kind(*which, free=self.free)

    @property
    def moves_points(self) -> bool:
        """Whether points are free, and not all shared parameters held."""
        return self.free and (self.basis is None or self.basis.shape[-1] > 0)

    @cached_property
    def restraint(self) -> Restraint | None:
        """What fixes the frame of free points and how well they were printed; `None` where none are free."""
        return self.restraint_at(self.points) if self.moves_points else None

    def restraint_at(self, points: Tensor) -> Restraint:
        """The same for other points of the target `(N, 3)`, differentiable by them."""
        counts = self.pixels.new_ones(self.used.shape) if self.weights is None else self.weights
        counts = counts if self.shares is None else counts * self.shares.unsqueeze(-1)
        return restraint_of(points, self.pixels, self.used, counts, self.printed, self.surveyed)

    @property
    def whole_prior(self) -> Prior | None:
        """The prior together with what restrains free points."""
        if self.restraint is None:
            return self.prior
        P, s = len(self.used), len(self.names)
        few = self.parameters.few
        held = torch.diag_embed(self.restraint.alone) + self.restraint.measured
        held = torch.nn.functional.pad(held, (few, 0, few, 0))
        root = torch.nn.functional.pad(self.restraint.root, (0, 0, few, 0))
        if self.prior is None:
            return Prior(held.new_zeros(P, s), held, root=root)
        return Prior(self.prior.mean, self.prior.precision + held, root=root)

    def lens_from(self, shared: Tensor) -> LensModel:
        """The lens that a fit from shared parameters `(P, s)` needs: a shorter one where it may be `brief`."""
        kind = MODELS[self.lens].kind
        if not self.brief or self.basis is None or kind is not BrownConrady:
            return self.lens
        lens = slice(len(INTRINSICS), self.parameters.lens_end)
        there = (shared[:, lens] != 0).any(0) | (self.basis[:, lens] != 0).any(-1).any(0)
        there = there if self.prior is None else there | (self.prior.whole[:, lens] != 0).any(-1).any(0)
        last = max((number for number, is_there in enumerate(there.tolist(), start=1) if is_there), default=0)
        return next(name for name, model in MODELS.items() if model.kind is kind and model.count >= last)

    def with_shorter_lens(self, lens: LensModel) -> tuple["Task", list[int]]:
        """The same with a shorter lens, the others' coefficients being 0; and where its parameters are among all."""
        short = replace(self, lens=lens)
        where = [self.names.index(name) for name in short.names]
        basis = None if self.basis is None else self.basis[:, where]
        prior = None if self.prior is None else self.prior.among(where)
        return replace(short, basis=basis, prior=prior), where

    def holding(self, where: list[int]) -> "Task":
        """The same with some of the shared parameters held, by their positions."""
        P, s = self.pixels.shape[0], len(self.names)
        basis = torch.eye(s, dtype=self.pixels.dtype, device=self.pixels.device).expand(P, s, s)
        basis = (basis if self.basis is None else self.basis).clone()
        basis[:, where] = 0.0
        return replace(self, basis=basis[..., (basis != 0).any(1).any(0)])

    def part(self, where: slice | Tensor) -> "Task":
        """The task of some of the cameras."""
        cut = {name: getattr(self, name)[where] for name in ("pixels", "used")}
        optional = ("weights", "whitening", "shares", "basis", "printed")
        cut |= {name: None if (whole := getattr(self, name)) is None else whole[where] for name in optional}
        prior = None if self.prior is None else self.prior.part(where)
        return replace(self, **cut, prior=prior)


def solved(
    task: Task,
    shared: Tensor,
    local: tuple[Tensor, ...],
    *,
    max_iterations: int | Tensor,
    tolerance: float,
    progress: Progress | None = None,
) -> Solution:
    """Run the solver from shared parameters `(P, s)` and poses `(P, V, ...)`, in blocks of cameras.

    `max_iterations` is one number, or one of each camera `(P,)`. `progress` is told of the steps of the blocks in turn,
    as a part of the most.
    """
    blocks, parts = _blocks(task), []
    limits = for_each(max_iterations, shared)
    most = max(limits.tolist(), default=0)
    for number, where in enumerate(blocks):

        def report(step: int, _: Tensor, number: int = number) -> None:
            if progress is not None:
                progress((number * most + step) // len(blocks), most)

        block, start = task.part(where), tuple(z[where] for z in local)
        options = {"max_iterations": limits[where], "tolerance": tolerance, "progress": report}
        parts.append(_solved(block, shared[where], start, **options))
    return parts[0] if len(parts) == 1 else _joined(parts)


def _scale(task: Task, unit: float) -> float:
    """What a residual of `unit` costs, over its square: little with small weights, or a loss of a small scale."""
    scale = 1.0 if task.weights is None else float(task.weights.flatten(1).amax(1).amin())
    if task.loss is not None:
        squared = torch.full((1,), unit**2, dtype=torch.float64, device=task.used.device)
        scale *= float(task.loss.value(squared)) / unit**2
    return scale


def _solved(task: Task, shared: Tensor, local: tuple[Tensor, ...], **options: Any) -> Solution:
    lens = task.lens_from(shared)
    if lens != task.lens:
        short, where = task.with_shorter_lens(lens)
        return _lengthened(_solved(short, shared[:, where], local, **options), shared, where)
    size = task.used.sum((-2, -1)).amax().clamp(min=1).item()
    unit = NEGLIGIBLE_PX if task.objective == "image" else 1e-13 * float(task.points.abs().amax())
    weights = task.weights
    if task.shares is not None:
        weights = task.shares.unsqueeze(-1).expand(task.used.shape) * (1.0 if weights is None else weights)
    solution = solve(
        task.problem,
        shared,
        local,
        local_size=POSE,
        weights=weights,
        loss=task.loss,
        prior=task.whole_prior,
        basis=task.basis,
        negligible=size * _scale(task, unit) * unit**2,
        **options,
    )
    if task.shares is None:
        return solution
    # The blocks of the views are those of all their corners; only what is summed over views holds their shares.
    whole = {name: getattr(solution.equations, name) for name in ("E", "W", "h", "c")}
    return solution._replace(
        equations=solution.equations._replace(
            **{name: block / shaped_like(task.shares, block) for name, block in whole.items()}
        )
    )


def _lengthened(solution: Solution, shared: Tensor, where: list[int]) -> Solution:
    """The solution for a shorter lens, among all parameters `(P, s)`."""
    at, s = torch.tensor(where, device=shared.device), shared.shape[-1]
    U, E, *_ = equations = solution.equations
    P, V, _, size = E.shape
    equations = equations._replace(
        U=U.new_zeros(P, s, s).index_copy(1, at, U.new_zeros(P, len(where), s).index_copy(2, at, U)),
        E=E.new_zeros(P, V, s, size).index_copy(2, at, E),
        g=equations.g.new_zeros(P, s).index_copy(1, at, equations.g),
    )
    return solution._replace(shared=shared.index_copy(1, at, solution.shared), equations=equations)


def shaped_like(shares: Tensor, block: Tensor) -> Tensor:
    """Shares `(P, V)` with as many axes as blocks of the views `(P, V, ...)`."""
    return shares.reshape(*shares.shape, *(1,) * (block.ndim - 2))


def _blocks(task: Task) -> list[slice]:
    P, V, N, _ = task.pixels.shape
    length = P if task.pixels.device.type != "cpu" else max(1, min(P, BLOCK_CORNERS // max(1, V * N)))
    return [slice(start, start + length) for start in range(0, P, length)]


def _joined(parts: list[Solution]) -> Solution:
    return Solution(
        torch.cat([part.shared for part in parts]),
        tuple(torch.cat(pieces) for pieces in zip(*(part.local for part in parts), strict=True)),
        torch.cat([part.cost for part in parts]),
        torch.cat([part.status for part in parts]),
        torch.cat([part.iterations for part in parts]),
        Equations(*(torch.cat(pieces) for pieces in zip(*(part.equations for part in parts), strict=True))),
    )
