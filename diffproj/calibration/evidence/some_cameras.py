"""Some of the cameras of a batch by themselves, so that what few of them need is computed for those alone."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.evidence.coplanar import Coplanar
from diffproj.calibration.evidence.descent import Found, Rival, Task
from diffproj.calibration.evidence.observation import Observation
from diffproj.calibration.evidence.observations import Heights, Horizon, Lengths, Seen
from diffproj.calibration.evidence.vanishing import VanishingPoints

OF_ITEMS: dict[type, dict[str, int]] = {
    Seen: {"pixels": 2, "visible": 1, "pixel_sigma": 1},
    Horizon: {"pixels": 2, "pixel_sigma": 1},
    Heights: {"feet": 2, "tops": 2, "height": 1, "deviation": 1, "pixel_sigma": 1},
    Lengths: {"starts": 2, "ends": 2, "length": 1, "deviation": 1, "pixel_sigma": 1},
    VanishingPoints: {"pixels": 2, "segments": 3, "pixel_sigma": 1},
    Coplanar: {"pixels": 2, "pixel_sigma": 1},
}
"""How many axes the tensors of an observation have behind those of the batch."""
STATE = ("values", "status", "iterations", "cost")
"""What `Found` has for each camera."""


def for_some(task: Task, found: Found, rows: Tensor, look: Callable[[Task, Found], Found]) -> Found:
    """What was found, with that of a second look, rivals too, in the place of it for the cameras `rows`.

    These are looked at by themselves, unless an observation is of a class that is not known here.
    """
    if len(rows) == len(found.values):
        return look(task, found)
    few = _some_of(task, rows)
    again = _rows_of(look(task, found), rows) if few is None else look(few, _rows_of(found, rows))

    def put(old: Tensor, new: Tensor) -> Tensor:
        return old.index_copy(0, rows, new)

    start, turned = found.parameters.start, again.parameters.start
    if start is not None and turned is not None:
        start = put(start, turned)
    rival = found.rival
    if rival is not None and again.rival is not None:
        rival = Rival(*(put(old, new) for old, new in zip(rival, again.rival, strict=True)))
    state = {name: put(getattr(found, name), getattr(again, name)) for name in STATE}
    return replace(found, parameters=replace(found.parameters, start=start), rival=rival, **state)


def _rows_of(found: Found, rows: Tensor) -> Found:
    start, rival = found.parameters.start, found.rival
    return replace(
        found,
        parameters=replace(found.parameters, start=None if start is None else start[rows]),
        basis=found.basis[rows],
        prior=type(found.prior)(*(part[rows] for part in found.prior[:2])),
        rival=None if rival is None else Rival(*(part[rows] for part in rival)),
        **{name: getattr(found, name)[rows] for name in STATE},
    )


def _some_of(task: Task, rows: Tensor) -> Task | None:
    """Those cameras as a task of batch shape `(n,)`; `None` where an observation cannot be divided."""
    index = torch.unravel_index(rows, task.batch)
    pieces = [_divided(piece, task.batch, index) for piece in task.pieces]
    if any(piece is None for piece in pieces):
        return None
    priors = tuple(
        replace(
            one,
            mean=None if one.mean is None else _chosen(one.mean, 1, task.batch, index),
            deviation=_chosen(one.deviation, 1, task.batch, index),
        )
        for one in task.known.priors
    )
    known = replace(task.known, priors=priors)
    return Task(tuple(one for one in pieces if one is not None), task.camera[index], (len(rows),), known)


def _divided(piece: Observation, batch: Sequence[int], index: tuple[Tensor, ...]) -> Observation | None:
    kept = OF_ITEMS.get(type(piece))
    if kept is None:
        return None
    few = copy.copy(piece)
    for name, behind in kept.items():
        value = getattr(piece, name)
        if value is not None:
            setattr(few, name, _chosen(value, behind, batch, index))
    if isinstance(few, Lengths) and few.plane.batch_shape:
        if few.plane.is_per_point:
            return None
        few.plane = few.plane.expand(*batch)[index]
    return few


def _chosen(tensor: Tensor, behind: int, batch: Sequence[int], index: tuple[Tensor, ...]) -> Tensor:
    """A tensor `(*B, ...)` with so many axes behind those of the batch at `index`; as it is where it has none."""
    if tensor.ndim <= behind:
        return tensor
    on = tuple(one.to(tensor.device) for one in index)
    return tensor.expand(*batch, *tensor.shape[tensor.ndim - behind :])[on]
