"""A function of a few points at many places at once."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from diffproj._core.arguments import called

SHOWN = 160
"""Characters of an error of PyTorch's."""


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


def checked_number(given: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """A function of a caller's from points to a number, which names what is wrong with it.

    Raises:
        ValueError: it gives something else, fails, or does what PyTorch cannot do for many points at once or
            differentiate.
    """

    def checked(points: Tensor) -> Tensor:
        try:
            found = given(points)
        except torch.cuda.OutOfMemoryError:
            raise
        except RuntimeError as error:
            if failure := _failure(given, points):
                k = points.shape[-2]
                raise ValueError(f"function: want one of points ({k}, 3), got one that fails: {failure}") from error
            reason = _short(error)
            raise ValueError(
                "function: want one written in PyTorch's functions of the points, with torch.where in the place of if, "
                f"and without .item(), float(), NumPy or writing to them; got one that fails: {reason}"
            ) from error
        if not isinstance(found, Tensor) or found.ndim or not found.is_floating_point():
            raise ValueError(
                "function: want one that gives a number, a tensor without axes of floating-point type, got "
                f"{called(found)}"
            )
        return found

    return checked


def _failure(given: Callable[[Tensor], Any], points: Tensor) -> str:
    """Why a function fails on points that are neither differentiated nor batched; empty if it does not."""
    numbers = torch.arange(1.0, 1 + points.shape[-2] * points.shape[-1], dtype=points.dtype, device=points.device)
    try:
        given(numbers.reshape(points.shape[-2:]).sqrt())  # no two alike, and no three on a line
    except RuntimeError as error:
        return "" if "data pointer" in str(error) else _short(error)  # NumPy's, which vmap refuses for any tensor
    return ""


def _short(error: Exception) -> str:
    return str(error)[:SHOWN].partition("\n")[0]
