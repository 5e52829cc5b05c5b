"""`Batched`: the base of everything that is made of tensors with batch axes in front, such as cameras and planes.

A subclass names its tensors, with how many axes each has behind those of the batch, the parts that are batched
themselves, and its constants; it says how to build one without checks (`unchecked`). In return it can be converted,
moved, detached, indexed, expanded and stacked, all in one way, and is a PyTree: `vmap`, `torch.func`, `torch.compile`
and `torch.export` carry it. Inside such a transformation the tensors are tracers, placeholders or plain `object()`s,
whose values nobody can read: this is why a PyTree is rebuilt by `unchecked`. `torch.load(weights_only=True)` reads it
once a public name of the package was used.
"""

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
import torch.utils._pytree as torch_pytree
from torch import Tensor

from diffproj._core.arguments import called, listing, whole_number
from diffproj._core.copying import Copied
from diffproj._core.numerics import at_least_float32, converted
from diffproj._core.shown import Shown

T = TypeVar("T")
B = TypeVar("B", bound="Batched")
Rearrange = Callable[[Tensor, int], Tensor]
"""Takes a tensor and how many axes it has behind those of the batch to the same in another arrangement."""


MOST_AXES = 60
"""Of a batch: PyTorch's tensors have 64 at most, and some of them stand behind those of the batch."""


class Batched(Copied, Shown):
    """Tensors that share batch axes `*B`, parts with the same batch axes, and constants."""

    __slots__ = ()

    _tensors: ClassVar[dict[str, int]]
    """The tensors, the leading one first, and how many axes each has behind those of the batch."""
    _parts: ClassVar[tuple[str, ...]]
    """What has batch axes of its own, or is `None`."""
    _constants: ClassVar[tuple[str, ...]]
    _remedies: ClassVar[dict[str, str]]
    """What to do with items that cannot be stacked, for their parts or constants of a name differ."""

    def __init_subclass__(
        cls,
        tensors: dict[str, int] | None = None,
        parts: Sequence[str] = (),
        constants: Sequence[str] = (),
        remedies: dict[str, str] | None = None,
        **options: Any,
    ) -> None:
        super().__init_subclass__(**options)
        if tensors is None:  # a base of others
            return
        cls._tensors, cls._parts, cls._constants, cls._remedies = (
            tensors,
            tuple(parts),
            tuple(constants),
            remedies or {},
        )
        register_pytree(cls, children=(*tensors, *parts), constants=constants)

    @classmethod
    def unchecked(cls: type[B], *args: Any, **fields: Any) -> B:
        """Build without a look at what is given: for parts of other instances, or from inside a transformation."""
        raise NotImplementedError

    # ------------------------------------------------------------------------------------------------- as a tensor

    @property
    def batch_shape(self) -> torch.Size:
        """The batch shape `*B`."""
        name, behind = next(iter(self._tensors.items()))
        shape = getattr(self, name).shape
        return shape[: len(shape) - behind]

    @property
    def dtype(self) -> torch.dtype:
        """The floating-point type."""
        return getattr(self, next(iter(self._tensors))).dtype

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return getattr(self, next(iter(self._tensors))).device

    def to(self: B, *args: Any, **kwargs: Any) -> B:
        """The same in another dtype or on another device: arguments as `torch.Tensor.to`; half becomes float32.

        Raises:
            TypeError: the arguments name no dtype and no device, or a dtype that is not of floating-point type.
            ValueError: there is no such device.
        """
        # An empty tensor shows what the arguments ask for.
        try:
            wanted = torch.empty(0, dtype=self.dtype, device=self.device).to(*args, **kwargs)
        except TypeError:
            given = ", ".join(called(value) for value in (*args, *kwargs.values()))
            raise TypeError(f"dtype, device: want a torch.dtype, a device or a tensor, got {given}") from None
        except (RuntimeError, AssertionError, NotImplementedError, ValueError, OverflowError) as error:
            raise ValueError(
                f"dtype, device: want ones that are here, got {(*args, *kwargs.values())} ({error})"
            ) from None
        wanted = at_least_float32(wanted)
        if not wanted.is_floating_point():
            raise TypeError(f"dtype: want a floating-point one, got {wanted.dtype}")

        def convert(tensor: Tensor, _: int) -> Tensor:  # a mask moves, and stays a mask
            return converted(tensor, wanted.device, wanted.dtype if tensor.is_floating_point() else tensor.dtype)

        return self._rearranged(convert, lambda part: part.to(*args, **kwargs))

    def detach(self: B) -> B:
        """The same cut off from the graph."""
        return self._rearranged(lambda tensor, _: tensor.detach(), lambda part: part.detach())

    def pin_memory(self: B) -> B:
        """The same in memory that a GPU copies from fast: what `DataLoader(pin_memory=True)` calls."""
        return self._rearranged(
            lambda tensor, _: tensor.pin_memory(),
            lambda part: part.pin_memory() if hasattr(part, "pin_memory") else part,
        )

    def expand(self: B, *batch_shape: int | Sequence[int]) -> B:
        """The same with its batch axes broadcast to `batch_shape`, as `torch.Tensor.expand`: nothing is copied.

        Raises:
            TypeError: the shape is not whole numbers.
            ValueError: the batch axes do not broadcast to it.
        """
        first = batch_shape[0] if len(batch_shape) == 1 else None
        shape = self._stretched(first if isinstance(first, tuple | list) else batch_shape)

        def stretch(tensor: Tensor, behind: int) -> Tensor:
            return tensor.expand((*shape, *tensor.shape[tensor.ndim - behind :]))

        return self._rearranged(stretch, lambda part: part.expand(*shape))

    def _stretched(self, shape: Sequence[Any]) -> torch.Size:
        """The shape that the batch is asked to take on, with -1 for the length that an axis has already."""
        own = self.batch_shape
        if not all(isinstance(length, int | torch.SymInt) for length in shape):
            raise TypeError(f"batch_shape: want whole numbers, got {tuple(shape)}")
        if len(shape) > MOST_AXES:
            raise ValueError(f"batch_shape: want at most {MOST_AXES} axes, got {len(shape)}")
        new = len(shape) - len(own)
        wanted = [own[k - new] if length == -1 and k >= new else length for k, length in enumerate(shape)]
        # That of a graph is a length, and a comparison would limit the graph to it.
        added = [length for length in wanted[: max(new, 0)] if not isinstance(length, torch.SymInt)]
        fits = new >= 0 and all(0 <= length < sys.maxsize for length in added)
        if not fits or any(length not in (1, want) for length, want in zip(own, wanted[new:], strict=True)):
            raise ValueError(f"batch_shape: want one that {tuple(own)} broadcasts to, got {tuple(shape)}")
        return torch.Size(wanted)

    def __getitem__(self: B, index: Any) -> B:
        """Some of the batch, chosen as one indexes a tensor of shape `*B`.

        Raises:
            TypeError: the index is not one that tensors take.
            IndexError: there is no such element, or the index does not fit the batch shape.
        """
        check_index(index)
        return self._rearranged(lambda tensor, behind: index_batch(tensor, index, behind), lambda part: part[index])

    @classmethod
    def stack(cls: type[B], items: Sequence[B], dim: int = 0) -> B:
        """Join several along a new batch axis; their batch shapes broadcast, their constants must agree.

        Args:
            items: at least one.
            dim: where the new axis stands among the batch axes.

        Raises:
            TypeError: others than this class among them, or different dtypes or kinds of parts.
            ValueError: none, different constants, shapes or devices, or batch shapes that do not broadcast, or no such
                axis.
        """
        items = listing("items", items, f"several {cls.__name__}")
        if not items or not all(isinstance(item, cls) for item in items):
            got = ", ".join(sorted({type(item).__name__ for item in items})) or "none"
            raise (TypeError if items else ValueError)(f"items: want at least one {cls.__name__}, got {got}")
        items = cls._alike(items)
        if len({item.dtype for item in items}) > 1:
            raise TypeError(f"items: want one dtype, got {sorted({str(item.dtype) for item in items})}; .to() converts")
        try:
            batch = torch.broadcast_shapes(*(item.batch_shape for item in items))
        except RuntimeError:
            got = ", ".join(str(tuple(item.batch_shape)) for item in items)
            raise ValueError(f"items: batch shapes do not broadcast: {got}") from None
        if len({item.device for item in items}) > 1:
            raise ValueError(f"items: want one device, got {sorted({str(item.device) for item in items})}; .to() moves")
        items = [item.expand(*batch) for item in items]
        for name in cls._tensors:
            shapes = {tuple(getattr(item, name).shape) for item in items}
            if len(shapes) > 1:
                raise ValueError(f"items: want {name} of one shape, got {sorted(shapes)}")
        axes = len(batch) + 1
        dim = whole_number("dim", dim, f"an axis from {-axes} to {axes - 1}", least=-axes, most=axes - 1) % axes
        fields = {name: torch.stack([getattr(item, name) for item in items], dim) for name in cls._tensors}
        fields |= {name: cls._stacked(name, [getattr(item, name) for item in items], dim) for name in cls._parts}
        return cls.unchecked(**fields, **{name: cls._agreed(name, items) for name in cls._constants})

    @classmethod
    def _alike(cls, items: list[Any]) -> list[Any]:
        """The items that are to be stacked, those that adapt to others adapted."""
        return items

    @classmethod
    def _agreed(cls: type[B], name: str, items: Sequence[B]) -> Any:
        """The constant that all have.

        Raises:
            ValueError: they differ.
        """
        first, *others = (getattr(item, name) for item in items)
        if any(other != first for other in others):
            raise ValueError(f"items: want the same {name}, got {[first, *others]}{cls._remedy(name)}")
        return first

    @classmethod
    def _stacked(cls, name: str, parts: list[Any], dim: int) -> Any:
        """The parts of that name joined.

        Raises:
            TypeError: they are of different kinds.
            ValueError: they are of one kind, and still do not fit together.
        """
        kinds, remedy = {type(part) for part in parts}, cls._remedy(name)
        if len(kinds) > 1:
            got = ", ".join(sorted(kind.__name__ for kind in kinds))
            raise TypeError(f"items: want one kind of {name}, got {got}{remedy}")
        if parts[0] is None:
            return None
        leaves = [torch_pytree.tree_flatten(part) for part in parts]
        if any(len(flat) != len(leaves[0][0]) or structure != leaves[0][1] for flat, structure in leaves):
            raise ValueError(f"items: want {name}s that are alike, got different ones{remedy}")
        if any(a.shape != b.shape for flat, _ in leaves for a, b in zip(flat, leaves[0][0], strict=True)):
            raise ValueError(f"items: want {name}s of one size, got different ones{remedy}")
        stacked = [torch.stack(tensors, dim) for tensors in zip(*(flat for flat, _ in leaves), strict=True)]
        return torch_pytree.tree_unflatten(stacked, leaves[0][1])

    @classmethod
    def _remedy(cls, name: str) -> str:
        return f"; {cls._remedies[name]}" if name in cls._remedies else ""

    def __len__(self) -> int:
        """The length of the first batch axis.

        Raises:
            TypeError: there is none.
        """
        if not self.batch_shape:
            raise TypeError(f"len() of a single {type(self).__name__}, which has no batch axes")
        return self.batch_shape[0]

    def __iter__(self: B) -> Iterator[B]:
        """Those of the first batch axis, one after the other.

        Raises:
            TypeError: there is no batch axis.
        """
        return (self[number] for number in range(len(self)))

    def __bool__(self) -> bool:
        """True, as of any object: what has a length is not false for being short."""
        return True

    def _rearranged(self: B, rearrange: Rearrange, part: Callable[[Any], Any]) -> B:
        """The same with each tensor and each part rearranged."""
        fields: dict[str, Any] = {
            name: rearrange(getattr(self, name), behind) for name, behind in self._tensors.items()
        }
        for name in self._parts:
            value = getattr(self, name)
            fields[name] = None if value is None else part(value)
        return self.unchecked(**fields, **{name: getattr(self, name) for name in self._constants})


# -------------------------------------------------------------------------------------------------------- indexing


def check_index(index: Any) -> None:
    """Check that an index is one that tensors take.

    Raises:
        TypeError: it is not. (PyTorch itself would read any object with a length, number by number, also one inside of
            a list, and crashes where that never ends.)
    """
    for part in index if isinstance(index, tuple) else (index,):
        if not (part is None or part is Ellipsis or _is_index(part)):
            raise TypeError(
                f"index: want numbers, slices, lists or masks, got {_described(part)}; "
                "some of a batch is batch[3], batch[2:5], batch[[0, 4]] or batch[mask]"
            )


def _is_index(part: Any) -> bool:
    if isinstance(part, list):
        return all(_is_index(element) and not isinstance(element, slice) for element in part)
    if isinstance(part, slice):
        return all(end is None or isinstance(end, int | np.integer) for end in (part.start, part.stop, part.step))
    if isinstance(part, Tensor):
        return not (part.is_floating_point() or part.is_complex())
    if isinstance(part, np.ndarray):
        return part.dtype.kind in "biu"
    return isinstance(part, int | np.integer | np.bool_)


def _described(part: Any) -> str:
    """The kind of a thing that is no index; of a list, that of what does not belong there."""
    if isinstance(part, list):
        odd = (element for element in part if isinstance(element, slice) or not _is_index(element))
        return f"a list with {_described(next(odd))}"
    if isinstance(part, Tensor | np.ndarray):
        return f"{type(part).__name__} of {part.dtype}"
    return type(part).__name__


def index_batch(tensor: Tensor, index: Any, behind: int) -> Tensor:
    """Index the batch axes of a tensor and keep the `behind` axes behind them whole, also with an ellipsis."""
    index = tuple(_for_tensors(part) for part in (index if isinstance(index, tuple) else (index,)))
    if not any(part is Ellipsis for part in index):
        index = (*index, Ellipsis)
    if not tensor.is_meta and any(isinstance(part, Tensor) and part.is_meta for part in index):
        # PyTorch would give memory as it lies.
        raise IndexError("index: want numbers that are known, got a tensor on the meta device")
    try:
        return tensor[(*index, *(slice(None),) * behind)]
    except (IndexError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        shape = tuple(tensor.shape[: tensor.ndim - behind])
        raise IndexError(f"index: want one that fits the batch shape {shape}, got another ({error})") from None


def _for_tensors(part: Any) -> Any:
    """Arrays as what every release of PyTorch takes."""
    if isinstance(part, np.ndarray) and part.dtype.kind in "iu":
        return torch.from_numpy(part.astype(np.int64))
    return part.copy() if isinstance(part, np.ndarray) else part


# ---------------------------------------------------------------------------------------------------------- PyTrees


def register_pytree(
    cls: type[T],
    *,
    children: Sequence[str],
    constants: Sequence[str] = (),
    build: Callable[..., T] | None = None,
) -> type[T]:
    """Make a class a PyTree.

    Args:
        cls: the class.
        children: names of its tensors, and of what holds tensors. One that is `None` is left out of the leaves,
            because `vmap` refuses `None` as a leaf.
        constants: names of what stays as it is; must be comparable.
        build: makes an instance of children and constants by name, without a look at values; `cls.unchecked` if left
            out.
    """
    make: Callable[..., T] = build or cls.unchecked  # type: ignore[attr-defined]

    def flatten(instance: T) -> tuple[list[Any], Any]:
        present = tuple(name for name in children if getattr(instance, name) is not None)
        kept = tuple(getattr(instance, name) for name in constants)
        return [getattr(instance, name) for name in present], (present, kept)

    def flatten_with_keys(instance: T) -> tuple[list[tuple[Any, Any]], Any]:
        leaves, context = flatten(instance)
        return [(torch_pytree.GetAttrKey(k), v) for k, v in zip(context[0], leaves, strict=True)], context

    def unflatten(leaves: Iterable[Any], context: Any) -> T:
        present, kept = context
        fields = dict.fromkeys(children)
        fields.update(zip(present, leaves, strict=True))
        fields.update(zip(constants, kept, strict=True))
        return make(**fields)

    torch_pytree.register_pytree_node(
        cls,
        flatten,
        unflatten,
        serialized_type_name=f"{cls.__module__}.{cls.__qualname__}",
        flatten_with_keys_fn=flatten_with_keys,
    )
    if build is None:  # built again from a file, attributes are set and nothing else is run
        torch.serialization.add_safe_globals([cls])
    return cls
