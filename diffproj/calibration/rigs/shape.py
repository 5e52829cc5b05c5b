"""From a rig's fit to a flat target to one that is bent, whose points are free, or stand where they were found before.

All cameras see one target, so that its shape is among the unknowns of the whole rig: what one camera alone could take
for its lens, the others contradict. The frame of free points and what holds them besides is that of one camera: see
`shape.py`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.fitting.free_points import MAX_ROUNDS, SAME_NOISE
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.fitting.surveyed import FINEST_PX
from diffproj.calibration.problem.constraints import printing_precision
from diffproj.calibration.problem.shape import Restraint, restraint_of
from diffproj.calibration.rigs.fit import RigFit, Rounds
from diffproj.calibration.rigs.parameters import RigParameters
from diffproj.calibration.rigs.together import Refinement
from diffproj.calibration.rigs.uncertainty import camera_noise, pooled_variance

EXACT = 1e-8
"""Variance of a landmark in a direction, relative to the largest of all, below which it counts as so exact."""
STIFF = 100.0
"""How many times as firmly as without a prior the frame is held beside one, which leaves it no say about the frame."""


def weighed_anew(flat: RigFit, options: Options) -> Refinement[RigFit]:
    """The fit to a flat target with what is known beforehand weighed against the noise that the residuals tell."""

    def again(found: RigFit, noise: float) -> Refinement[RigFit]:
        return _fitted(found, flat.parameters, (), flat.shared.new_zeros(0), options, noise)

    return flat if _is_weighed(flat) else (yield from _settled(flat, again, settled=False))


def with_bow(flat: RigFit, options: Options) -> Refinement[RigFit]:
    """The fit with the board's bow."""
    parameters = replace(flat.parameters, bow=True)

    def again(found: RigFit, noise: float) -> Refinement[RigFit]:
        return _fitted(found, parameters, (), _shape_of(found, 2), options, noise)

    return _settled(flat, again, settled=flat.problem.known is None or _is_weighed(flat))


def with_points(flat: RigFit, held_points: Sequence[int], options: Options) -> Refinement[RigFit]:
    """The fit with free points.

    Args:
        flat: to the flat target.
        held_points: coordinates of the displacements that stay 0, numbers from 0.
        options: checked.
    """
    parameters = replace(flat.parameters, points=len(flat.views.points))
    surveyed = flat.views.spread is not None
    printed = printing_precision(options.priors, (), flat.views.points)
    printed = None if printed is None else printed.detach()
    if flat.views.spread is not None:
        printed = _as_surveyed(flat.views.spread)

    def again(found: RigFit, noise: float) -> Refinement[RigFit]:
        restraint = _restraint(flat, None if printed is None else noise * printed)
        return _fitted(
            found, parameters, held_points, _shape_of(found, 3 * parameters.points), options, noise, restraint
        )

    nothing = printed is None and flat.problem.known is None
    return _settled(flat, again, settled=nothing or _is_weighed(flat), least=FINEST_PX**2 if surveyed else 0.0)


def _settled(
    flat: RigFit, again: Callable[[RigFit, float], Refinement[RigFit]], settled: bool, least: float = 0.0
) -> Refinement[RigFit]:
    """The fit that `again` makes of one, with what is known beforehand weighed against that variance of residuals.

    Where corners have no weights, it weighs against the noise that the residuals tell, which depends on it in turn: a
    few rounds settle both. The variance is taken for no less than `least`.
    """
    found, noise = flat, 1.0 if settled else max(_noise(flat), least)
    for _ in range(MAX_ROUNDS):
        found = replace((yield from again(found, noise)), prior_variance=noise)
        before, noise = noise, noise if settled else max(_noise(found), least)
        if abs(noise - before) <= SAME_NOISE * before:
            break
    return found


def _is_weighed(found: RigFit) -> bool:
    """Whether corners have weights, which say what their noise is."""
    return any(data.weights is not None for data in found.views.data.values())


def _shape_of(found: RigFit, count: int) -> Tensor:
    """The unknowns of the target's shape `(count,)`: 0 as long as it has none."""
    shape = found.shared[0, found.parameters.few :]
    return shape if len(shape) else found.shared.new_zeros(count)


def with_known_points(flat: RigFit, moves: Tensor, options: Options) -> Refinement[RigFit]:
    """The fit with the points of the target displaced by `moves (N, 3)`, which are known."""
    parameters, moves = replace(flat.parameters, points=len(moves)), flat.views.frame.turned(moves.to(flat.shared))
    return _fitted(flat, parameters, range(moves.numel()), moves.flatten(), options)


def _fitted(
    begin: RigFit,
    parameters: RigParameters,
    held: Sequence[int],
    shape: Tensor,
    options: Options,
    noise: float = 1.0,
    restraint: Restraint | None = None,
) -> Refinement[RigFit]:
    """From a fit to one with a shape, which starts at `shape` and of which some unknowns are held, numbers from 0.

    What is known of the cameras weighs against residuals of the variance `noise`.
    """
    few, known = parameters.few, begin.problem.known
    held = [*begin.positions, *(few + i for i in held)]
    shared = torch.cat([begin.shared[:, :few], shape.unsqueeze(0)], dim=-1)
    given = {name: begin.views.data[name].used[0] for name in begin.views.names}
    fit = Rounds(
        begin.views, parameters, begin.problem.base[0], held, options, restraint, known and known.against(noise)
    )
    yield from fit.solve(begin.used, shared, begin.local)
    rejected = yield from fit.without_outliers(given, begin.apart)
    found = fit.at_the_minimum(rejected, begin.apart)
    found = replace(found, iterations=begin.iterations + found.iterations)
    return replace(found, restrained=begin.restrained, positions=begin.positions)


def _as_surveyed(spread: Tensor) -> Tensor:
    """The precision of landmarks' displacements `(1, N, 3, 3)`; exact directions hardly move."""
    values, axes = torch.linalg.eigh(spread)
    precision = values.clamp(min=EXACT * float(values.amax())).reciprocal()
    return ((axes * precision.unsqueeze(-2)) @ axes.mT).unsqueeze(0)


def _noise(found: RigFit) -> float:
    """The variance of a residual; 1 where there are too few to tell."""
    level = float(pooled_variance(camera_noise(found)))
    return level if level > 0 else 1.0


def _restraint(flat: RigFit, printed: Tensor | None) -> Restraint:
    """What fixes the frame, from all views of all cameras."""
    views = flat.views
    pixels = torch.cat([views.data[name].pixels[0] for name in views.names])
    used = torch.cat([flat.used[name] for name in views.names])
    weights = [views.data[name].weights for name in views.names]
    ones = [torch.ones_like(views.data[name].pixels[0, :, :, 0]) for name in views.names]
    counts = torch.cat([one if given is None else given[0] for one, given in zip(ones, weights, strict=True)])
    # A point counts as shown where two views show it, of whichever cameras.
    surveyed = views.spread is not None
    found = restraint_of(views.points, pixels[None], used[None], counts[None], printed, surveyed)
    return found if printed is None or surveyed else found._replace(root=STIFF * found.root)
