"""From a rig's fit to a flat target to one whose points are free, or stand where they were found before.

All cameras see one target, so that its points are unknowns of the whole rig: what one camera alone could take for its
lens, the others contradict. Their frame and what holds them besides is that of one camera: see `shape.py`.
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.options import Options
from diffproj.calibration.rig_fit import RigFit, Rounds, in_normal_tensors
from diffproj.calibration.rig_options import free_directions
from diffproj.calibration.shape import Restraint, restraint_of


def with_shape(flat: RigFit, held_points: list[int], options: Options, known: Tensor | None = None) -> RigFit:
    """The fit with free points.

    Args:
        flat: to the flat target.
        held_points: coordinates of the displacements that stay 0, numbers from 0.
        options: checked.
        known: displacements `(N, 3)` that are not fitted, but known.
    """
    views, few = flat.views, flat.parameters.few
    count = len(views.points)
    parameters = replace(flat.parameters, points=count)
    held = range(3 * count) if known is not None else held_points
    basis = free_directions(parameters, [*flat.positions, *(few + i for i in held)], flat.shared)
    restraint = None if known is not None else _restraint(flat)
    moves = flat.shared.new_zeros(3 * count) if known is None else known.to(flat.shared).flatten()
    shared = torch.cat([flat.shared, moves.unsqueeze(0)], dim=-1)
    given = {name: views.data[name].used[0] for name in views.names}
    with torch.inference_mode():
        fit = Rounds(views, parameters, flat.problem.base, basis, options, restraint)
        fit.solve(flat.used, shared, flat.local)
        found = fit.at_the_minimum(fit.without_outliers(given, flat.apart), flat.apart)
    found = replace(found, iterations=flat.iterations + found.iterations)
    return replace(in_normal_tensors(found), restrained=flat.restrained, positions=flat.positions)


def _restraint(flat: RigFit) -> Restraint:
    """What fixes the frame, from all views of all cameras."""
    views = flat.views
    pixels = torch.cat([views.data[name].pixels[0] for name in views.names])
    used = torch.cat([flat.used[name] for name in views.names])
    weights = [views.data[name].weights for name in views.names]
    ones = [torch.ones_like(views.data[name].pixels[0, :, :, 0]) for name in views.names]
    counts = torch.cat([one if given is None else given[0] for one, given in zip(ones, weights, strict=True)])
    # A point counts as shown where two views show it, of whichever cameras.
    return restraint_of(views.points, pixels[None], used[None], counts[None], None)
