"""Several fits of the same cameras as one batch: with few views the calls take the time, not the numbers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.options import Progress
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.problem.parametrisation import Pose


@dataclass(frozen=True, eq=False)
class Lane:
    """One of the fits.

    Attributes:
        shared: where it starts `(P, s)`.
        local: the poses there.
        max_iterations: of the solver.
        held: positions of the shared parameters that stay as they are.
    """

    shared: Tensor
    local: Pose
    max_iterations: int
    held: tuple[int, ...] = ()


def side_by_side(
    task: Task, lanes: Sequence[Lane], *, reject: float | None, tolerance: float, progress: Progress | None = None
) -> list[Fit]:
    """Where each of the lanes ends; the options are those of `fit`."""
    shared = torch.cat([lane.shared for lane in lanes])
    every = torch.arange(len(task.used), device=shared.device)
    limits = torch.tensor([lane.max_iterations for lane in lanes], device=shared.device)
    together = fit(
        replace(task.part(every.repeat(len(lanes))), basis=_basis(task, lanes)),
        shared,
        tuple(torch.cat(parts) for parts in zip(*(lane.local for lane in lanes), strict=True)),
        max_iterations=limits.repeat_interleave(len(every)),
        reject=reject,
        tolerance=tolerance,
        progress=progress,
    )
    ends = [together.part(every + number * len(every)) for number in range(len(lanes))]
    return [
        Fit(replace(end.task, basis=_own(task, lane).basis), end.solution, end.rejected)
        for lane, end in zip(lanes, ends, strict=True)
    ]


def _own(task: Task, lane: Lane) -> Task:
    return task.holding(list(lane.held)) if lane.held else task


def _basis(task: Task, lanes: Sequence[Lane]) -> Tensor | None:
    """The free directions of all lanes, filled up with zeros to the same number."""
    own = task.basis
    if own is None and not any(lane.held for lane in lanes):
        return None
    if own is None:
        shared = lanes[0].shared
        own = torch.eye(shared.shape[-1], dtype=shared.dtype, device=shared.device).expand(*shared.shape, -1)
    held = [torch.tensor(lane.held, dtype=torch.int64, device=own.device) for lane in lanes]
    return torch.cat([own.index_fill(1, where, 0.0) for where in held])
