"""Make a class of tensors a PyTree, so that `vmap`, `torch.func`, `torch.compile` and `torch.export` carry it.

A registered class names its tensors (`children`) and its constants (`static`), and has a classmethod
`_unchecked(**fields)` that builds an instance without looking at values: inside a transformation the leaves are
tracers, placeholders or plain `object()`s, whose values nobody can read. A child that is `None` is left out of the
leaves, because `vmap` refuses `None` as a leaf.
"""

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import torch.utils._pytree as torch_pytree

T = TypeVar("T")


def register(cls: type[T], *, children: Sequence[str], static: Sequence[str] = ()) -> type[T]:
    """Register `cls` with PyTorch's trees; see the module's text for what the class must offer."""

    def flatten(instance: T) -> tuple[list[Any], Any]:
        present = tuple(name for name in children if getattr(instance, name) is not None)
        constants = tuple(getattr(instance, name) for name in static)
        return [getattr(instance, name) for name in present], (present, constants)

    def flatten_with_keys(instance: T) -> tuple[list[tuple[Any, Any]], Any]:
        leaves, context = flatten(instance)
        return [(torch_pytree.GetAttrKey(k), v) for k, v in zip(context[0], leaves, strict=True)], context

    def unflatten(leaves: Iterable[Any], context: Any) -> T:
        present, constants = context
        fields = dict.fromkeys(children)
        fields.update(zip(present, leaves, strict=True))
        fields.update(zip(static, constants, strict=True))
        return cls._unchecked(**fields)  # type: ignore[attr-defined]

    torch_pytree.register_pytree_node(
        cls,
        flatten,
        unflatten,
        serialized_type_name=f"{cls.__module__}.{cls.__qualname__}",
        flatten_with_keys_fn=flatten_with_keys,
    )
    return cls
