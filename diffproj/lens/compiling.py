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


def fused(*tensors: Tensor) -> bool:
    """Whether a loop over points is compiled for a CPU, not exported, and nobody wants a derivative of it."""
    return _in_loop(tensors[0]) and not derivative_wanted(*tensors)


def _in_loop(tensor: Tensor) -> bool:
    compiling = torch.compiler.is_compiling() and not torch.compiler.is_exporting()
    return compiling and tensor.device.type == "cpu" and not _transforming()


def in_bytes(mask: Tensor) -> Tensor:
    """The same mask; of a loop that is compiled for a CPU one that is written as bytes.

    Inductor of PyTorch 2.13 writes booleans one by one, which takes 5 to 14 ns each. Numbers it converts to bytes many
    at a time, and these are then looked at as booleans.
    """
    return mask.to(torch.float32).to(torch.uint8).view(torch.bool) if _in_loop(mask) else mask


def in_memory(component: Tensor) -> Tensor:
    """The same values in a piece of memory of their own, which a compiled loop writes and reads.

    Inductor vectorises a loop where few of its loads and stores have a stride, and counts those of an expression again
    wherever this is used. The view stands for nothing else: of it Inductor wants the memory.
    """
    component = component.clone(memory_format=torch.contiguous_format)
    return component.as_strided(component.shape, component.stride())


def coordinates(points: Any) -> tuple[Any, Any]:
    """`x` and `y` of points `(*B, N, 2)`, a tensor outside of autograd, or an array of NumPy.

    On a CPU, but not in an exported graph, they are made contiguous first: a loop with stride 2 is not vectorised.
    """
    if not isinstance(points, Tensor):
        return np.ascontiguousarray(points[..., 0]), np.ascontiguousarray(points[..., 1])
    x, y = points.unbind(-1)
    if _in_loop(points):
        x, y = in_memory(x), in_memory(y)
    elif points.device.type == "cpu" and not torch.compiler.is_compiling():
        x, y = x.contiguous(), y.contiguous()
    return x, y


def length_of(x: Tensor, y: Tensor) -> Tensor:
    """`torch.hypot`; in an exported graph of operations that ONNX has, which overflow from 1e19 on in float32."""
    return torch.addcmul(x * x, y, y).sqrt() if torch.compiler.is_exporting() else torch.hypot(x, y)


def with_batch_in_front(info: Any, in_dims: Sequence[int | None], *tensors: Tensor) -> list[Tensor]:
    """Arguments of an opaque operation under `vmap`, with the mapped axis moved, or expanded, to the front of each."""
    return [
        tensor.expand(info.batch_size, *tensor.shape) if axis is None else tensor.movedim(axis, 0)
        for tensor, axis in zip(tensors, in_dims, strict=False)
    ]
