"""From a flat target to one whose points are free: the same fit, with the displacements of the points solved for too.

The fit to the flat target is the start: its residuals are small, so that the points are near their nominal places and
a few steps are enough. What was held, known or restrained about the camera stays so.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.constraints import of_points, printing_precision
from diffproj.calibration.data import Data
from diffproj.calibration.fit import Fit, fit
from diffproj.calibration.options import Options
from diffproj.calibration.solver import Prior

SAME_NOISE = 1e-7
"""Relative change of the noise's variance below which a prior that weighs against it is settled."""
MAX_ROUNDS = 30


def with_free_points(flat: Fit, data: Data, options: Options, prior: Prior | None) -> tuple[Fit, Prior | None]:
    """The fit with free points, and the prior with its graph; both as they are where points are not to be free.

    Where corners have no weights, how well the target was printed weighs against the noise that the residuals tell,
    which depends on it in turn: a few rounds settle both.
    """
    if options.shape != "free":
        return flat, prior
    held = [axis for name in options.fixed for axis in of_points(name)]
    printed = printing_precision(options.priors, data.batch, data.points)
    few, count = flat.task.parameters.size, data.points.numel()
    wide: dict[str, Any] = {
        "used": flat.task.used | flat.rejected,
        "free": True,
        "prior": None if flat.task.prior is None else _padded(flat.task.prior, count),
        "basis": _basis(flat.task.basis, few, count, held, flat.solution.shared),
    }
    task = replace(flat.task, **wide)
    shared, local = torch.nn.functional.pad(flat.solution.shared, (0, count)), flat.solution.local
    steps = {name: getattr(options, name) for name in ("max_iterations", "tolerance", "progress")}
    iterations, noise = flat.solution.iterations, torch.ones_like(shared[:, 0])
    if printed is not None and data.weights is None:
        noise = flat.residual_variance().nan_to_num(1.0)
    found = flat
    for _ in range(MAX_ROUNDS):
        if printed is not None:
            task = replace(task, printed=printed * noise.unsqueeze(-1))
        found = fit(task, shared, local, reject=options.outlier_limit, **steps)
        iterations = iterations + found.solution.iterations
        shared, local, task = found.solution.shared, found.solution.local, replace(task, used=found.task.used)
        if printed is None or data.weights is not None:
            break
        before, noise = noise, found.residual_variance().nan_to_num(1.0)
        if bool(((noise - before).abs() <= SAME_NOISE * before).all()):
            break
    found = Fit(found.task, found.solution._replace(iterations=iterations), found.rejected)
    return found, None if prior is None else _padded(prior, count)


def _padded(prior: Prior, count: int) -> Prior:
    """The prior with so many more parameters, of which it knows nothing."""
    mean, precision, known, _ = prior
    wide = (0, count, 0, count)
    known = None if known is None else torch.nn.functional.pad(known, wide)
    return Prior(torch.nn.functional.pad(mean, (0, count)), torch.nn.functional.pad(precision, wide), known)


def _basis(basis: Tensor | None, few: int, count: int, held: Sequence[int], like: Tensor) -> Tensor | None:
    """The directions of the few parameters and those of the displacements along axes that are not held."""
    if basis is None and not held:
        return None
    own = torch.eye(few, dtype=like.dtype, device=like.device).expand(len(like), few, few) if basis is None else basis
    free = [number for number in range(count) if number % 3 not in held]
    moves = torch.eye(count, dtype=like.dtype, device=like.device)[:, free].expand(len(like), count, len(free))
    above = torch.nn.functional.pad(own, (0, len(free)))
    return torch.cat([above, torch.nn.functional.pad(moves, (own.shape[-1], 0))], dim=1)
