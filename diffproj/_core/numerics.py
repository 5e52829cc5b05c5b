"""Numerical ground rules that every other file builds on: argument checks, lifting, safe linear maps, blocks.

Three rules live here because they are easy to break one call at a time:

* **No matrix multiplication touches a point.** Under `autocast`, with TF32 or with
  `torch.set_float32_matmul_precision("medium")` a matrix product runs in 8 to 11 bits of mantissa: at 500 px that is
  off by a pixel or more. `linear` multiplies and adds elementwise instead, which no such switch reaches, and which is
  faster for matrices this small.
* **Values are read only where somebody can read them.** Inside `torch.compile`, `vmap` or on the meta device a tensor
  has a shape but no values, and in a recording (`torch.jit.trace`) those of an example; `has_values` tells, and checks
  on values are skipped there.
* **Work in blocks changes no result.** `in_blocks` cuts long inputs only when no derivative of any kind is asked.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from diffproj._core.arguments import Kind, tensor_of
from diffproj._core.torch_private import (
    has_no_values,
    in_forward_mode,
    in_functional_transform,
    in_recording,
    stands_for_a_batch,
    traced_beside,
)
from diffproj._core.warn import warn_caller

BLOCK_POINTS = 2**16
"""Points handled at once on a CPU when no derivative is asked: large enough to hide the cost of dispatch, small enough
that the intermediate results stay in the processor's cache."""
BLOCK_POINTS_ELSEWHERE = 2**23
"""The same on a GPU: large enough that its kernels take longer than their launch, small enough for its memory."""
SHORT = 2**12
"""Points on a CPU up to which NumPy's steps, which cost half of what PyTorch's do, make up for slower arithmetic."""


# ----------------------------------------------------------------------------------------------- argument checks


def at_least_float32(tensor: Tensor) -> Tensor:
    """Half and bfloat16 as float32, everything else as it is: bfloat16 has steps of 2 px at 500 px."""
    return tensor.float() if tensor.dtype in (torch.float16, torch.bfloat16) else tensor


def check_tensor(name: str, value: object, *shape: int | str, like: Kind | None = None) -> Tensor:
    """Check that `value` is a floating-point tensor whose trailing axes fit `shape`, and lift it.

    NumPy arrays and lists of numbers are taken as well: see `diffproj._core.arguments`.

    Args:
        name: the argument's name, for the message.
        value: what the caller handed in.
        shape: the trailing axes: a number where the length is fixed, a word where it is free; `"*"` in front of them
            stands for any leading axes and is implied.
        like: whose dtype and device an array takes on.

    Returns:
        The tensor, in float32 if it came in half precision.

    Raises:
        TypeError: no tensor, array or numbers, or a tensor that is not dense or not of floating-point type.
        ValueError: the trailing axes do not fit.
    """
    value = tensor_of(name, value, like)
    if not value.is_floating_point():
        remedy = ".real and .imag are" if value.is_complex() else ".double() or .float() makes one"
        raise TypeError(f"{name}: want a floating-point tensor, got {value.dtype}; {remedy}")
    if shape:
        fits = value.ndim >= len(shape) and all(
            isinstance(want, str) or want == got
            for want, got in zip(shape, value.shape[value.ndim - len(shape) :], strict=True)
        )
        if not fits:
            want = ", ".join(["*B", *map(str, shape)])
            raise ValueError(f"{name}: want shape ({want}), got {tuple(value.shape)}")
    return at_least_float32(value)


def check_same_kind(**tensors: Kind | None) -> None:
    """Check that all tensors share one dtype and one device, naming the first that does not.

    Raises:
        TypeError: dtypes differ.
        ValueError: devices differ.
    """
    present = [(name, tensor) for name, tensor in tensors.items() if tensor is not None]
    (first, reference), *others = present
    for name, tensor in others:
        if tensor.dtype != reference.dtype:
            want = reference.dtype
            raise TypeError(f"{name}: want {want} as {first} has, got {tensor.dtype}; {name}.to({want}) converts")
        if tensor.device != reference.device:
            raise ValueError(f"{name}: want device {reference.device} as {first} has, got {tensor.device}")


def broadcast_batches(**shapes: Sequence[int]) -> torch.Size:
    """Broadcast batch shapes, naming them all when they do not fit together.

    Raises:
        ValueError: the shapes do not broadcast.
    """
    first, *others = shapes.values()
    if all(len(other) == len(first) and other == first for other in others):  # the usual case, and 20 times as fast
        return torch.Size(first)
    sizes: list[int] = []  # by hand: PyTorch's own loads a library of symbols first, which takes half a second
    for axis in range(1, 1 + max(map(len, shapes.values()))):
        size = 1
        for shape in shapes.values():
            if len(shape) >= axis and shape[-axis] != 1:
                if size not in (1, shape[-axis]):
                    listed = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes.items())
                    raise ValueError(f"batch shapes do not broadcast: {listed}")
                size = shape[-axis]
        sizes.append(size)
    return torch.Size(reversed(sizes))


def has_values(*tensors: Tensor) -> bool:
    """Whether the values of these tensors can be read here: not of a graph, under `vmap`, or of a fake tensor."""
    tracing = torch.compiler.is_compiling() or in_functional_transform() or in_recording()
    return not (tracing or any(has_no_values(tensor) for tensor in tensors))


def check_untransformed(who: str, remedy: str) -> None:
    """Check that the code does not run under a transform of `torch.func`, where PyTorch's own message names no cause.

    Args:
        who: the call that reads values.
        remedy: what to do.

    Raises:
        ValueError: it does.
    """
    if in_functional_transform():
        raise ValueError(
            f"{who}: want a call outside of torch.func's transforms, for it reads values, got one under vmap, grad, "
            f"jvp or another; {remedy}"
        )


def check_not_mapped(who: str, remedy: str, *given: Any) -> None:
    """Check that values can be read under the transforms of `torch.func`: under `grad` and `jvp`, but not `vmap`.

    Args:
        who: the call that reads them.
        remedy: what to do.
        given: tensors and trees of them; all else has no say.

    Raises:
        ValueError: some stand for a batch.
    """
    if not in_functional_transform():
        return
    if any(isinstance(leaf, Tensor) and stands_for_a_batch(leaf) for leaf in tree_leaves(given)):
        raise ValueError(f"{who}: want a call outside of vmap, for it reads values, got one under it; {remedy}")


def gradient_only(step: Tensor) -> Tensor:
    """Zero, with the first derivative of the step: what it is added to keeps its value to the bit.

    For steps that are right to first order only. Who builds a graph of the derivative (`create_graph=True`) is warned.
    """
    if step.requires_grad:
        step.register_hook(_warn_of_second_order)
    return step - step.detach()


def _warn_of_second_order(_: Tensor) -> None:
    if torch.is_grad_enabled():
        warn_caller(
            "create_graph: want False for the gradient of a minimum, which is to first order, got True; second "
            "derivatives, as of a penalty on that gradient, are without those of the minimum"
        )


def all_true(mask: Tensor) -> bool:
    """Whether all are true; false where that cannot be read, or not without waiting for a device."""
    return mask.is_cpu and has_values(mask) and bool(mask.numpy().all())  # in a tenth of PyTorch's time


def all_within(tensor: Tensor, limit: float) -> bool:
    """Whether all values are smaller than a limit by magnitude; false where that cannot be read as above."""
    if not (tensor.is_cpu and has_values(tensor) and tensor.numel()):
        return False
    low, high = tensor.detach().aminmax()  # NaN if one is
    return float(low) > -limit and float(high) < limit


def is_short(vectors: Tensor) -> bool:
    """Whether these are few vectors `(*B, N, 2)` or `(*B, N, 3)` on a CPU."""
    return vectors.device.type == "cpu" and vectors.numel() <= 2 * SHORT


def version_of(tensor: Tensor) -> int:
    """How often a tensor was written to, as far as PyTorch counts; 0 where its values cannot be read."""
    readable = has_values(tensor) or traced_beside(tensor)
    return tensor._version if readable and not tensor.is_inference() else 0


def arrays_of(*tensors: Tensor, double: bool = False) -> tuple[Any, list[Any]]:
    """The library that works fastest with the values of small tensors, and them in its form.

    On the CPU it is NumPy, whose steps on a few values take a third of the time of PyTorch's. What is done with them
    has to be in words that both libraries know. NumPy warns of what PyTorch takes for granted: see `np.errstate`.

    Args:
        tensors: without a look at their graph.
        double: whether in float64.
    """
    if all(tensor.is_cpu for tensor in tensors):
        arrays = [tensor.numpy(force=True) for tensor in tensors]
        return np, [array.astype(np.float64, copy=False) for array in arrays] if double else arrays
    return torch, [in_float64(tensor.detach()) if double else tensor.detach() for tensor in tensors]


def spread_evenly(total: int, count: int, device: torch.device) -> Tensor:
    """`count` of the numbers from 0 to `total - 1`, evenly apart, with the first and the last."""
    return torch.arange(count, device=device) * (total - 1) // max(count - 1, 1)


def converted(tensor: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    """`tensor.to(...)`, with axes that are only expanded left so: a million poses go on sharing one K.

    A matter of memory alone: no result may depend on whether an axis is expanded or holds copies.
    """
    shape, strides = tensor.shape, tensor.stride()
    for axis, (length, stride) in enumerate(zip(shape, strides, strict=True)):
        if length > 1 and stride == 0:
            tensor = tensor.narrow(axis, 0, 1)
    return tensor.to(*args, **kwargs).expand(shape)


# ------------------------------------------------------------------------------------------------- linear algebra


def entries(matrix: Tensor) -> list[list[Tensor]]:
    """The entries of matrices `(*B, m, n)`, row by row, each `(*B, 1)` so that it broadcasts over points."""
    return [list(row.unsqueeze(-1).unbind(-2)) for row in matrix.unbind(-2)]


def linear(rows: Sequence[Sequence[Tensor]], components: Sequence[Tensor | None]) -> list[Tensor]:
    """Multiply small matrices with many vectors that are given component by component.

    Args:
        rows: the `entries` of matrices `(*B, m, n)`.
        components: `n` tensors `(*B, N)`, components of one tensor of vectors; `None` in the last place stands for a
            component that is 1 everywhere.

    Returns:
        `m` tensors `(*B, N)`: the components of the products.
    """
    first, *others = components
    if first is None:
        raise ValueError("components: want a tensor in the first place, got None")
    products = []
    for row in rows:
        product = first * row[0]
        for entry, component in zip(row[1:], others, strict=True):
            product = product + entry if component is None else torch.addcmul(product, component, entry)
        products.append(product)
    return products


def interleaved(components: Sequence[Tensor]) -> Tensor:
    """Vectors `(*B, N, n)` of `n` components `(*B, N)`: `torch.stack` over the last axis.

    Where no derivative is asked, column by column: on a CPU that takes 4 ns a point, `torch.stack` takes 10.
    """
    if wants_derivative(*components):
        return torch.stack(list(components), dim=-1)
    vectors = components[0].new_empty((*components[0].shape, len(components)))
    for column, component in zip(vectors.unbind(-1), components, strict=True):
        column.copy_(component)
    return vectors


def side_by_side(components: Sequence[Tensor]) -> Tensor:
    """The same for what takes them apart again at once: without derivatives, each component in one piece of memory."""
    if wants_derivative(*components):
        return torch.stack(list(components), dim=-1)
    return torch.stack(list(components)).movedim(0, -1)


def transform(matrix: Tensor, vectors: Tensor) -> Tensor:
    """Multiply matrices `(*B, m, n)` with vectors `(*B, N, n)` to `(*B, N, m)`, elementwise as `linear` does."""
    return torch.stack(linear(entries(matrix), vectors.unbind(-1)), dim=-1)


def inverse2(matrix: Tensor) -> Tensor:
    """Inverses of `(..., 2, 2)`; 0 where there is none."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    determinant = a * d - b * c
    sound = determinant.abs() > 0
    adjugate = torch.stack([torch.stack([d, -b], dim=-1), torch.stack([-c, a], dim=-1)], dim=-2)
    return torch.where(sound[..., None, None], adjugate / torch.where(sound, determinant, 1.0)[..., None, None], 0.0)


def in_float64(tensor: Tensor) -> Tensor:
    """The tensor in float64 where its device has that type, for sums that are built once and used a million times."""
    return tensor if tensor.device.type == "mps" else tensor.double()


def rounding(dtype: torch.dtype) -> float:
    """The relative size below which a sum of a few products is rounding: 8 units in the last place."""
    return 8 * torch.finfo(dtype).eps


def least_depth(dtype: torch.dtype) -> float:
    """The depth from which on points are projected: what is divided by it, and its slope, are finite."""
    return math.sqrt(torch.finfo(dtype).tiny)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """The dot product over the last axis, elementwise: `(*B, n)` and `(*B, n)` to `(*B,)`."""
    return (a * b).sum(dim=-1)


# ---------------------------------------------------------------------------------------------------------- blocks


def wants_derivative(*tensors: Tensor) -> bool:
    """Whether somebody may ask for a derivative of any kind: reverse, forward (also under `no_grad`) or functional.

    `torch.no_grad` switches off the reverse tape only; forward-mode tangents and functional transforms go on under
    it, so grad mode alone does not answer the question.
    """
    return (
        torch.compiler.is_compiling()
        or in_functional_transform()
        or in_forward_mode()
        or in_recording()
        or (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors))
    )


def block_points(device: torch.device) -> int:
    """How many points are handled at once where no derivative is asked."""
    return BLOCK_POINTS if device.type == "cpu" else BLOCK_POINTS_ELSEWHERE


def in_blocks(
    function: Callable[[Tensor], tuple[Tensor, ...]], points: Tensor, *parameters: Tensor
) -> tuple[Tensor, ...]:
    """Apply `function` along the points' axis, in blocks when no derivative is asked.

    Fresh memory dominates long inputs: ten intermediate results of 10^7 points do not fit a CPU's cache, those of one
    block do. `function` must treat points independently of each other.

    Args:
        function: maps points `(*B, n, k)` to tensors `(*B, n, ...)`.
        points: `(*B, N, k)`.
        parameters: the other tensors that the result depends on, to tell whether a derivative is asked.

    Returns:
        What `function(points)` returns.
    """
    if torch.compiler.is_compiling():  # a graph is not to depend on lengths, which are not even asked for here
        return function(points)
    batch = max(1, points.shape[:-2].numel())
    length = max(1, block_points(points.device) // batch)
    if points.shape[-2] <= length or wants_derivative(points, *parameters):
        return function(points)
    axis = points.ndim - 2
    results: list[Any] = []
    for start in range(0, points.shape[-2], length):
        block = function(points[..., start : start + length, :])
        if not results:
            results = [b.new_empty((*b.shape[:axis], points.shape[-2], *b.shape[axis + 1 :])) for b in block]
        for result, part in zip(results, block, strict=True):
            result.narrow(axis, start, part.shape[axis]).copy_(part)
    return tuple(results)
