"""What a lens does differently inside a compiled graph."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from diffproj._core.numerics import wants_derivative
from diffproj._core.torch_private import constant_in_graphs, in_forward_mode, in_functional_transform


def derivative_wanted(*tensors: Tensor) -> bool:
    """As `wants_derivative`, but inside `torch.compile` too the answer is no where nobody asks.

    A graph is compiled anew when one of these answers changes: each of them is guarded.
    """
    if not torch.compiler.is_compiling():
        return wants_derivative(*tensors)
    reverse = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return reverse or _transforming()


@constant_in_graphs
def _transforming() -> bool:
    """Whether the code being compiled runs under a functional transform or in forward mode."""
    return in_functional_transform() or in_forward_mode()


def coordinates(points: Tensor) -> tuple[Tensor, Tensor]:
    """`x` and `y` of points `(*B, N, 2)` of which no derivative is wanted.

    In a compiled graph for the processor they are taken apart by an opaque operation: a loop that reads every second
    number is not vectorised, and runs at a quarter of the speed.
    """
    if torch.compiler.is_compiling() and points.device.type == "cpu" and not _transforming():
        points = _apart(points).movedim(0, -1)
    x, y = points.unbind(-1)
    return x, y


@torch.library.custom_op("diffproj::apart", mutates_args=())
def _apart(points: Tensor) -> Tensor:
    return points.movedim(-1, 0).clone(memory_format=torch.contiguous_format)


@_apart.register_fake
def _apart_shape(points: Tensor) -> Tensor:
    return points.new_empty((points.shape[-1], *points.shape[:-1]))


def with_batch_in_front(info: Any, in_dims: Sequence[int | None], *tensors: Tensor) -> list[Tensor]:
    """Tensors that `vmap` hands to an opaque operation, with the axis it maps over in front of each."""
    return [
        tensor.expand(info.batch_size, *tensor.shape) if axis is None else tensor.movedim(axis, 0)
        for tensor, axis in zip(tensors, in_dims, strict=False)
    ]
