"""A device that every machine has: its tensors live on the CPU, but meeting one of the CPU's is refused, as on a GPU.

Where a GPU is missing, this is what finds a constant that was made on the CPU, and an array that was read without being
fetched. PyTorch is told of a backend of its own (`PrivateUse1`), which stays for the rest of the process: use it in a
process of its own, between `register()` and its end, and inside of `Elsewhere()`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

NAME = "elsewhere"
CPU = torch.device("cpu")
PICKS = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_", "aten::_unsafe_index")
"""What takes indices from the CPU on a GPU, too."""


class There(Tensor):
    """A tensor there; `held` is the one on the CPU that holds its values."""

    held: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[attr-defined]

    @staticmethod
    def __new__(cls, inner: Tensor) -> "There":
        with torch.inference_mode(False):
            made = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
                cls,
                inner.shape,
                strides=inner.stride(),
                storage_offset=inner.storage_offset(),
                dtype=inner.dtype,
                device=torch.device(NAME, 0),
            )
        made.held = inner
        return made

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return run(func, args, kwargs or {})

    def numpy(self, *, force: bool = False) -> np.ndarray:
        if not force:
            raise TypeError(f"can't convert {NAME} device type tensor to numpy")
        return self.held.detach().numpy().copy()

    def __array__(self, *_: Any) -> np.ndarray:
        return self.numpy()

    def tolist(self) -> Any:
        return self.held.tolist()

    def __deepcopy__(self, memo: dict[int, Any]) -> "There":
        if id(self) not in memo:
            copied = There(self.held.detach().clone()).requires_grad_(self.requires_grad)
            copied._is_param = getattr(self, "_is_param", False)  # type: ignore[attr-defined]
            memo[id(self)] = copied
        return memo[id(self)]


class Elsewhere(TorchDispatchMode):
    """While it is on, tensors can be made there."""

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return run(func, args, kwargs or {})


def run(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """What a function of PyTorch gives; an error where it joins tensors of the two devices."""
    name = func._schema.name
    asked = kwargs.get("device") or next((leaf for leaf in args if isinstance(leaf, torch.device)), None)
    args = tuple(CPU if isinstance(leaf, torch.device) else leaf for leaf in args)  # of `aten::to` in inference mode
    asked_there = asked is not None and torch.device(asked).type == NAME
    if name == "aten::copy_":
        inner(args[0]).copy_(inner(args[1]))
        return args[0]
    if name == "aten::_to_copy":
        copied = func(inner(args[0]), **{key: value for key, value in kwargs.items() if key != "device"})
        return There(copied) if asked_there or (asked is None and isinstance(args[0], There)) else copied
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    some_there = any(isinstance(tensor, There) for tensor in tensors)
    if some_there:
        for tensor in tensors:
            picks = name in PICKS and not tensor.is_floating_point()
            if not isinstance(tensor, There) and tensor.ndim and not picks:
                shape = tuple(tensor.shape)
                raise RuntimeError(f"all tensors are to be on one device: {name} joins {NAME} and cpu, {shape}")
    if asked_there and "device" in kwargs:
        kwargs = kwargs | {"device": CPU}
    found = func(*tree_map_only(There, inner, args), **tree_map_only(There, inner, kwargs))
    if not (asked_there or (some_there and asked is None)):
        return found
    written = [argument for argument in func._schema.arguments if argument.alias_info and argument.alias_info.is_write]
    if written and some_there:
        outs = [kwargs[argument.name] if argument.kwarg_only else args[0] for argument in written]
        return outs[0] if isinstance(found, Tensor) else tuple(outs)
    return tree_map_only(Tensor, There, found)


def inner(tensor: Tensor) -> Tensor:
    """The tensor on the CPU that holds the values."""
    return tensor.held if isinstance(tensor, There) else tensor


def register() -> torch.library.Library:
    """Tell PyTorch of the device; it stays as long as what is returned."""
    from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

    _setup_privateuseone_for_python_backend(NAME)
    library = torch.library.Library("aten", "IMPL")
    kernels: dict[str, Callable[..., Tensor]] = {
        "empty_strided": lambda size, stride, dtype=None, **_: There(torch.empty_strided(size, stride, dtype=dtype)),
        "empty.memory_format": lambda size, dtype=None, **_: There(torch.empty(size, dtype=dtype)),
        "copy_": lambda to, source, non_blocking=False: run(torch.ops.aten.copy_.default, (to, source), {}),
        "matmul": _matmul,
    }
    for name, kernel in kernels.items():
        library.impl(name, kernel, "PrivateUse1")
    library.impl("matmul", _matmul, "AutogradPrivateUse1")
    return library


def _matmul(a: Tensor, b: Tensor) -> Tensor:
    """PyTorch's own changes shapes in place, which a tensor there cannot."""
    if a.ndim == 1:
        return _matmul(a.unsqueeze(0), b).squeeze(-1 if b.ndim == 1 else -2)
    if b.ndim == 1:
        return _matmul(a, b.unsqueeze(-1)).squeeze(-1)
    batch = torch.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    left, right = (x.expand(*batch, *x.shape[-2:]).reshape(batch.numel(), *x.shape[-2:]) for x in (a, b))
    return torch.bmm(left, right).reshape(*batch, a.shape[-2], b.shape[-1])
