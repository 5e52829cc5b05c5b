"""Rigs that are refined side by side: each says what it wants minimised next, and those alike are solved in one batch.

How a rig goes from round to round, which corners it leaves out and what it frees, depends on its residuals alone. So
each is a generator that yields what it wants of the solver and is sent where that ended; whatever is wanted at the same
time, of rigs of one structure, is one problem. Rigs of fewer moments have some behind theirs in which nothing is seen.
The solver goes on with those that still move, and each ends as it would alone.
"""

from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from diffproj.calibration.least_squares.losses import Loss
from diffproj.calibration.least_squares.solver import Prior, solve
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results.calibration import CalibrationError
from diffproj.calibration.rigs.options import free_directions
from diffproj.calibration.rigs.problem import RigProblem

MOST_VIEWS = 800
"""Views in a batch: enough to hide call overhead; of more, what a view costs is all that counts."""
FILLED = 1.5
"""Most moments of a rig in a batch, over the fewest: what is more than the hidden moments cost is not."""

T = TypeVar("T")


class Wanted(NamedTuple):
    """What a rig wants minimised.

    Attributes:
        problem: of one rig.
        shared, local: where it starts, `(1, s)` and `(1, M, ...)`.
        held: positions of the shared unknowns that are.
        prior: on these.
        loss: a robust one, or `None`.
        max_iterations, tolerance: of the solver.
        negligible: a cost that counts as zero.
        progress: is told of steps where a rig is solved by itself.
    """

    problem: RigProblem
    shared: Tensor
    local: tuple[Tensor, ...]
    held: tuple[int, ...]
    prior: Prior | None
    loss: Loss | None
    max_iterations: int
    tolerance: float
    negligible: float
    progress: Callable[[int, Tensor], None] | None

    @property
    def structure(self) -> tuple[Any, ...]:
        """What rigs have in common that are solved in one batch."""
        problem, prior = self.problem, self.prior
        return (
            (problem.parameters.kinds, problem.parameters.points, problem.parameters.bow, self.held),
            None if problem.known is None else problem.known.of,
            None if prior is None else tuple(None if part is None else part.shape for part in prior),
            (id(self.loss), self.max_iterations, self.tolerance, self.shared.device),
        )

    @property
    def views(self) -> int:
        """How many are looked at in each step."""
        return sum(len(group.rig) for group in self.problem.groups)


class Ended(NamedTuple):
    """Where the solver ended with a rig."""

    shared: Tensor
    local: tuple[Tensor, ...]
    status: int
    iterations: int


Refinement = Generator[Wanted, Ended, T]
"""A rig on its way to a result."""


def by_itself(rig: Refinement[T]) -> T:
    """The result of one rig, or its error."""
    found = side_by_side([rig])[0]
    if isinstance(found, Exception):
        raise found
    return found


def side_by_side(rigs: Sequence[Refinement[T]]) -> list[T | CalibrationError | ValueError]:
    """The result of each rig, or the error that it ended with."""
    found: dict[int, T | CalibrationError | ValueError] = {}
    wanted: dict[int, Wanted] = {}

    def goes_on(number: int, ended: Any) -> None:
        try:
            wanted[number] = rigs[number].send(ended)
        except StopIteration as end:
            found[number] = end.value
        except (CalibrationError, ValueError) as error:
            found[number] = error

    for number in range(len(rigs)):
        goes_on(number, None)
    while wanted:
        for batch in _batches(wanted):
            for number, ended in zip(batch, _solved([wanted.pop(number) for number in batch]), strict=True):
                goes_on(number, ended)
    return [found[number] for number in range(len(rigs))]


def _batches(wanted: dict[int, Wanted]) -> list[list[int]]:
    """Which rigs are solved in one batch: those alike, and of about as many moments."""
    alike: dict[Any, list[int]] = {}
    for number, one in wanted.items():
        alike.setdefault(one.structure, []).append(number)
    batches: list[list[int]] = []
    for numbers in alike.values():
        batch, views = [], 0
        for number in sorted(numbers, key=lambda i: wanted[i].problem.moments):
            one, views = wanted[number], views + wanted[number].views
            if batch and (views > MOST_VIEWS or one.problem.moments > FILLED * wanted[batch[0]].problem.moments):
                batches.append(batch)
                batch, views = [], one.views
            batch.append(number)
        batches.append(batch)
    return batches


@torch.inference_mode()
def _solved(batch: Sequence[Wanted]) -> list[Ended]:
    """Where each of some rigs that are alike ends."""
    first, moments = batch[0], [one.problem.moments for one in batch]
    shared = torch.cat([one.shared for one in batch])
    basis = free_directions(first.problem.parameters, first.held, shared)
    found = solve(
        RigProblem.joined([one.problem for one in batch]),
        shared,
        tuple(map(_filled, zip(*(one.local for one in batch), strict=True))),
        local_size=POSE,
        loss=first.loss,
        prior=_joined([one.prior for one in batch if one.prior is not None]),
        basis=None if basis is None else basis.expand(len(batch), -1, -1),
        max_iterations=first.max_iterations,
        tolerance=first.tolerance,
        negligible=shared.new_tensor([one.negligible for one in batch]),
        progress=first.progress if len(batch) == 1 else None,
    )
    ends = zip(found.status.tolist(), found.iterations.tolist(), moments, strict=True)
    return [
        Ended(found.shared[p : p + 1], tuple(z[p : p + 1, :count] for z in found.local), status, iterations)
        for p, (status, iterations, count) in enumerate(ends)
    ]


def _joined(priors: Sequence[Prior]) -> Prior | None:
    """The priors of all rigs, if there are some."""
    if not priors:
        return None
    roots = [prior.root for prior in priors if prior.root is not None]
    mean, precision = torch.cat([prior.mean for prior in priors]), torch.cat([prior.precision for prior in priors])
    return Prior(mean, precision, root=torch.cat(roots) if roots else None)


def _filled(parts: Sequence[Tensor]) -> Tensor:
    """Tensors `(1, M, ...)` of all rigs `(P, M, ...)`, with zeros behind those of fewer moments."""
    most = max(part.shape[1] for part in parts)
    whole = parts[0].new_zeros(len(parts), most, *parts[0].shape[2:])
    for row, part in zip(whole, parts, strict=True):
        row[: part.shape[1]] = part[0]
    return whole
