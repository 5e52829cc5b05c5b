"""From a target whose points are known to one whose points are free: the same fit, with their displacements, too.

The fit to the known points is the start: its residuals are small, so that the points are near their nominal places and
a few steps are enough. What was held, known or restrained about the camera stays so.

Free are the points of a target that was printed roughly, with `shape="free"`; and landmarks with an error of their own
that several views share.
"""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.fitting.surveyed import FINEST_PX
from diffproj.calibration.least_squares.solver import Prior
from diffproj.calibration.problem.constraints import of_points, printing_precision

EXACT = 1e-12
"""Variance of a landmark in a direction, relative to its largest, up to which it counts as exact there."""
SAME_NOISE = 1e-7
"""Relative change of the noise's variance below which a prior that weighs against it is settled."""
MAX_ROUNDS = 30


def with_free_points(flat: Fit, data: Data, options: Options, prior: Prior | None) -> tuple[Fit, Prior | None]:
    """The fit with free points, and the prior with its graph; both as they are where points are not to be free.

    Where the noise of the corners is not known, how well the target was printed, or surveyed, weighs against the noise
    that the residuals tell, which depends on it in turn: a few rounds settle both.
    """
    surveyed = data.surveyed(options.shape)
    if options.shape != "free" and not surveyed:
        return flat, prior
    if surveyed:
        printed, moves = _as_surveyed(data)
        settled = flat.knows_noise
    else:
        printed, moves = _as_printed(data, options)
        settled = printed is None or data.weights is not None
    few, count = flat.task.parameters.size, data.points.numel()
    wide: dict[str, Any] = {
        "used": flat.task.used | flat.rejected,
        "free": True,
        "surveyed": surveyed,
        "spread": None,
        "whitening": None,
        "prior": None if flat.task.prior is None else _padded(flat.task.prior, count),
        "basis": _basis(flat.task.basis, few, count, moves, flat.solution.shared),
    }
    least = FINEST_PX**2 if surveyed and data.weights is None else 0.0
    task = replace(flat.task, **wide)
    shared, local = torch.nn.functional.pad(flat.solution.shared, (0, count)), flat.solution.local
    steps = {name: getattr(options, name) for name in ("max_iterations", "tolerance", "progress")}
    iterations, noise = flat.solution.iterations, torch.ones_like(shared[:, 0])
    if not settled:
        noise = flat.residual_variance().nan_to_num(1.0).clamp(min=least)
    found = flat
    for _ in range(MAX_ROUNDS):
        if printed is not None:
            task = replace(task, printed=printed * noise[:, None, None, None])
        found = fit(task, shared, local, reject=options.outlier_limit, **steps)
        iterations = iterations + found.solution.iterations
        shared, local, task = found.solution.shared, found.solution.local, replace(task, used=found.task.used)
        if settled:
            break
        before, noise = noise, found.residual_variance().nan_to_num(1.0).clamp(min=least)
        if bool(((noise - before).abs() <= SAME_NOISE * before).all()):
            break
    found = Fit(found.task, found.solution._replace(iterations=iterations), found.rejected)
    return found, None if prior is None else _padded(prior, count)


def _as_printed(data: Data, options: Options) -> tuple[Tensor | None, Tensor | None]:
    """The precision of each displacement `(P, N, 3, 3)`, if it is known, and where points may move: see `_basis`."""
    printed = printing_precision(options.priors, data.batch, data.points)
    printed = None if printed is None else printed.detach()
    held = [axis for name in options.fixed for axis in of_points(name)]
    if not held:
        return printed, None
    count = data.points.numel()
    free = [number for number in range(count) if number % 3 not in held]
    return printed, torch.eye(count, dtype=data.points.dtype, device=data.points.device)[:, free]


def _as_surveyed(data: Data) -> tuple[Tensor, Tensor | None]:
    """The same of landmarks: where one is exact along some direction, it does not move."""
    values, axes = torch.linalg.eigh(data.spread)
    loose = values > EXACT * values[:, -1:]
    precision = torch.where(loose, 1 / torch.where(loose, values, 1.0), 0.0)
    blocks = (axes * precision.unsqueeze(-2)) @ axes.mT
    moves = None if bool(loose.all()) else torch.block_diag(*axes)[:, loose.flatten()]
    return blocks.expand(len(data.pixels), *blocks.shape), moves


def _padded(prior: Prior, count: int) -> Prior:
    """The prior with so many more parameters, of which it knows nothing."""
    mean, precision, known, _ = prior
    wide = (0, count, 0, count)
    known = None if known is None else torch.nn.functional.pad(known, wide)
    return Prior(torch.nn.functional.pad(mean, (0, count)), torch.nn.functional.pad(precision, wide), known)


def _basis(basis: Tensor | None, few: int, count: int, moves: Tensor | None, like: Tensor) -> Tensor | None:
    """The directions of the few parameters and those of the displacements `(3 N, m)`; `None` where all are free."""
    if basis is None and moves is None:
        return None
    own = torch.eye(few, dtype=like.dtype, device=like.device).expand(len(like), few, few) if basis is None else basis
    moves = torch.eye(count, dtype=like.dtype, device=like.device) if moves is None else moves
    above = torch.nn.functional.pad(own, (0, moves.shape[-1]))
    below = torch.nn.functional.pad(moves.expand(len(like), *moves.shape), (own.shape[-1], 0))
    return torch.cat([above, below], dim=1)
