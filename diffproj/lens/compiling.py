"""Special cases of the lenses inside a compiled graph."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffproj._core.numerics import wants_derivative
from diffproj._core.torch_private import constant_in_graphs, in_forward_mode, in_functional_transform


def derivative_wanted(*tensors: Tensor) -> bool:
    """As `wants_derivative`, but exact inside `torch.compile` as well, where that function always returns true.

    The graph is guarded on each of these conditions and recompiled when one changes.
    """
    if not torch.compiler.is_compiling():
        return wants_derivative(*tensors)
    reverse = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return reverse or _transforming()


@constant_in_graphs
def _transforming() -> bool:
    """Whether the code being compiled runs under a functional transform or in forward mode."""
    return in_functional_transform() or in_forward_mode()


def coordinates(points: Any) -> tuple[Any, Any]:
    """`x` and `y` of points `(*B, N, 2)`, a tensor outside of autograd, or an array of NumPy.

    On a CPU, but not in an exported graph, they are made contiguous first, in a compiled graph by an opaque operation:
    a loop with stride 2 is not vectorised and runs at a quarter of the speed.
    """
    if not isinstance(points, Tensor):
        return np.ascontiguousarray(points[..., 0]), np.ascontiguousarray(points[..., 1])
    compiling = torch.compiler.is_compiling() and not torch.compiler.is_exporting()
    if compiling and points.device.type == "cpu" and not _transforming():
        points = _deinterleaved(points).movedim(0, -1)
    x, y = points.unbind(-1)
    if points.device.type == "cpu" and not torch.compiler.is_compiling():
        x, y = x.contiguous(), y.contiguous()
    return x, y


def length_of(x: Tensor, y: Tensor) -> Tensor:
    """`torch.hypot`; in an exported graph of operations that ONNX has, which overflow from 1e19 on in float32."""
    return torch.addcmul(x * x, y, y).sqrt() if torch.compiler.is_exporting() else torch.hypot(x, y)


@torch.library.custom_op("diffproj::deinterleave", mutates_args=())
def _deinterleaved(points: Tensor) -> Tensor:
    return points.movedim(-1, 0).clone(memory_format=torch.contiguous_format)


@_deinterleaved.register_fake
def _deinterleaved_shape(points: Tensor) -> Tensor:
    return points.new_empty((points.shape[-1], *points.shape[:-1]))


def with_batch_in_front(info: Any, in_dims: Sequence[int | None], *tensors: Tensor) -> list[Tensor]:
    """Arguments of an opaque operation under `vmap`, with the mapped axis moved, or expanded, to the front of each."""
    return [
        tensor.expand(info.batch_size, *tensor.shape) if axis is None else tensor.movedim(axis, 0)
        for tensor, axis in zip(tensors, in_dims, strict=False)
    ]
