"""Everything of PyTorch that this package uses and PyTorch does not promise to keep, in one place.

A release of PyTorch that moves one of these breaks this file and its test, and nothing else.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch.utils._python_dispatch import _disable_current_modes

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

_PROXY = torch._C._TorchDispatchModeKey.PROXY  # type: ignore[attr-defined]


def in_functional_transform() -> bool:
    """Whether the code runs under a transform of `torch.func`: `vmap`, `grad`, `jvp`, ..."""
    return torch._C._functorch.peek_interpreter_stack() is not None  # type: ignore[attr-defined]


def stands_for_a_batch(tensor: torch.Tensor) -> bool:
    """Whether it is one of many under `vmap`, on whatever level: its value cannot be read, as under `grad` and `jvp`.

    Under `jacfwd` and `hessian` the derivatives are a batch, and the value is not.
    """
    functorch = torch._C._functorch  # type: ignore[attr-defined]
    while functorch.is_functorch_wrapped_tensor(tensor):
        if functorch.is_batchedtensor(tensor):
            return True
        tensor = functorch.get_unwrapped(tensor)
    return False


def in_recording() -> bool:
    """Whether the code runs in order to be recorded, as by `torch.jit.trace`, ONNX's older exporter or `make_fx`.

    Values are there, but they are those of an example: what is read of them, or worked out in NumPy, would be a
    constant of the recording.
    """
    return torch._C._is_tracing() or torch._C._get_dispatch_mode(_PROXY) is not None  # type: ignore[attr-defined]


def in_forward_mode() -> bool:
    """Whether forward-mode differentiation is switched on, by `torch.func.jvp` or `torch.autograd.forward_ad`."""
    return torch.autograd.forward_ad._current_level >= 0


def has_no_values(tensor: torch.Tensor) -> bool:
    """Whether it is a shape alone: on the meta device, or fake, as `FakeTensorMode` makes tensors."""
    return tensor.is_meta or type(tensor).__name__ == "FakeTensor"


def has_storage(tensor: torch.Tensor) -> bool:
    """Whether there are numbers behind it; not where it stands for a batch, as under `vmap` and `is_grads_batched`."""
    return bool(torch._C._has_storage(tensor))  # type: ignore[attr-defined]


def constant_in_graphs(function: F) -> F:
    """Mark a function that `torch.compile` is to call once, while it traces, and whose result is a constant.

    `torch.compiler.assume_constant_result` sets the same mark, but imports the whole compiler to do so, which takes
    as long as PyTorch itself.
    """
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]
    return function


def traced_beside(tensor: torch.Tensor) -> bool:
    """Whether `torch.export` traces here, and the tensor is none of its inputs: a constant, whose values are there.

    Only where it traces by running the code (`strict=False`, which is the default): Dynamo shows no values.
    """
    return (
        torch.compiler.is_exporting()
        and not torch.compiler.is_dynamo_compiling()
        and not in_functional_transform()
        and type(tensor) in (torch.Tensor, torch.nn.Parameter)
        and not tensor.is_meta
    )


def outside_of_tracing(function: Callable[[], T]) -> T:
    """What a function gives where nothing is traced: its results are constants of the graph."""
    with _disable_current_modes():
        return function()
