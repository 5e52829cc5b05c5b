"""Copies of what PyTorch refuses: deep ones of results of a computation, and of what inference mode made."""

import copy
from collections.abc import Iterator
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

C = TypeVar("C", bound="Copied")
T = TypeVar("T")


class Copied:
    """What `copy.deepcopy` copies with all its tensors; results of a computation are cut off from its graph."""

    __slots__ = ()

    def __deepcopy__(self: C, memo: dict[int, Any]) -> C:
        for tensor in _results(self, set()):
            memo.setdefault(id(tensor), tensor.detach().clone())
        new = memo[id(self)] = type(self).__new__(type(self))
        for name, value in _state(self):
            object.__setattr__(new, name, copy.deepcopy(value, memo))
        return new


def ordinary(tree: T) -> T:
    """A tensor, a camera or another tree with copies of the tensors that inference mode made: those have no slopes."""
    if not any(isinstance(leaf, Tensor) and leaf.is_inference() for leaf in tree_leaves(tree)):
        return tree
    with torch.inference_mode(False):
        return tree_map(lambda leaf: leaf.clone() if isinstance(leaf, Tensor) and leaf.is_inference() else leaf, tree)


def with_ordinary(thing: T) -> T:
    """A thing, or a copy of it, that is `ordinary` where it is a tree, and whose attributes are."""
    new = thing = ordinary(thing)
    for name, value in list(_state(thing)):
        kept = ordinary(value)
        if kept is not value:
            new = copy.copy(thing) if new is thing else new
            object.__setattr__(new, name, kept)
    return new


def _state(thing: Any) -> Iterator[tuple[str, Any]]:
    """The attributes of a thing by name."""
    yield from getattr(thing, "__dict__", {}).items()
    for kind in type(thing).__mro__:
        names = kind.__dict__.get("__slots__", ())
        for name in (names,) if isinstance(names, str) else names:
            if name not in ("__dict__", "__weakref__") and hasattr(thing, name):
                yield name, getattr(thing, name)


def _results(thing: Any, seen: set[int]) -> Iterator[Tensor]:
    """The tensors within a thing that are results of a computation."""
    if id(thing) in seen or isinstance(thing, str | bytes | int | float | type):
        return
    seen.add(id(thing))
    if isinstance(thing, Tensor):
        if not thing.is_leaf:
            yield thing
        return
    parts = [value for _, value in _state(thing)]
    if isinstance(thing, dict):
        parts += thing.values()
    elif isinstance(thing, list | tuple | set | frozenset):
        parts += thing
    elif isinstance(thing, partial):
        parts += [*thing.args, *thing.keywords.values()]
    for part in parts:
        yield from _results(part, seen)
