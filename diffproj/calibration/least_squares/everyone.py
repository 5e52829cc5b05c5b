"""All problems of a batch, while the solver goes on with those that are still moving."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from diffproj.calibration.least_squares.damping import DampingControl


def for_each(max_iterations: int | Tensor, problems: Tensor) -> Int[Tensor, " p"]:
    """The maximum number of steps of each of the problems `(P, ...)`, where one stands for all."""
    return torch.as_tensor(max_iterations, device=problems.device).expand(len(problems))


def pays_to_part(control: DampingControl) -> bool:
    """Whether so few problems are still moving that the solver should go on with those alone."""
    return 2 * int(control.active.sum()) <= len(control.active)


class Everyone:
    """Where all problems of a batch are, and how they ended.

    Attributes:
        state: tensors `(P, ...)` in nested tuples; of problems that are still moving, as they were when last kept.
    """

    def __init__(self, state: Any, control: DampingControl) -> None:
        self.state, self._status, self._iterations = state, control.status, control.iterations
        self._moving: Tensor | None = None

    def keep(self, state: Any, control: DampingControl, which: Tensor) -> None:
        """Take down how far the present problems have come, of which some `(n,)` go on."""
        self._take(state, control)
        self._moving = which if self._moving is None else self._moving[which]

    def whole(self, before: Any, now: Any) -> Any:
        """Tensors of all problems, with those of the ones that are still moving in their place."""
        return now if self._moving is None else rows(before, self._moving, now)

    def ends(self, state: Any, control: DampingControl) -> tuple[Any, np.ndarray, np.ndarray]:
        """The state of all, their status and iterations."""
        self._take(state, control)
        return self.state, self._status, self._iterations

    def _take(self, state: Any, control: DampingControl) -> None:
        self.state = self.whole(self.state, state)
        if self._moving is None:
            self._status, self._iterations = control.status, control.iterations
        else:
            where = self._moving.numpy(force=True)
            self._status[where], self._iterations[where] = control.status, control.iterations


def rows(whole: Any, which: Tensor, new: Any = None) -> Any:
    """Some rows `(n,)` of tensors in nested tuples; or all rows, with new ones in their place."""
    if isinstance(whole, Tensor):
        return whole[which] if new is None else whole.index_put((which,), new)
    news = [None] * len(whole) if new is None else new
    parts = [rows(part, which, one) for part, one in zip(whole, news, strict=True)]
    return type(whole)(*parts) if hasattr(whole, "_fields") else tuple(parts)
