"""A function of a few points at many places at once."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map


def at_each(function: Callable[[Tensor], Any]) -> Callable[[Tensor], Any]:
    """The function of points `(k, 3)` for points `(*B, k, 3)`, which may be none; its results get one axis in front.

    `vmap` over nothing fails in many of PyTorch's functions. So that is taken from the function at one place.
    """
    every = torch.func.vmap(function)

    def mapped(points: Tensor) -> Any:
        rows = points.flatten(0, -3)
        return every(rows) if len(rows) else tree_map(lambda one: one[:0], every(rows.new_zeros(1, *rows.shape[1:])))

    return mapped


def number_of_each(function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """The same of a function that gives a number: `(*B,)` for points `(*B, k, 3)`."""
    return lambda points: at_each(function)(points).reshape(points.shape[:-2])
