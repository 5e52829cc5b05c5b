"""What users hand in, checked by name: every public function asks here before it does anything with an argument.

Each check returns the argument in the form that the function works with, or raises `TypeError` (of the wrong kind) or
`ValueError` (of the right kind, with a value that cannot be) with the message "name: want ..., got ...; remedy".

Tensors have a check of their own, `diffproj._core.numerics.check_tensor`, which rests on `tensor_of`: the one rule for
NumPy arrays and lists of numbers, which are taken wherever a tensor is, images excepted. They are copied, and take the
dtype and device of the camera, lens or tensors that they meet. Alone, an array of floats keeps its dtype, and all else
becomes float64. Tensors are never converted but from half precision: theirs has to agree.
"""

import math
import operator
import os
from collections.abc import Iterable, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from diffproj._core.dense import dense

Array = np.ndarray | Sequence[Any]
"""What is taken in the place of a tensor: an array, or (nested) lists of numbers."""

_ARRAYS = (list, tuple, float, int, np.ndarray, np.generic)

T = TypeVar("T")


@runtime_checkable
class Kind(Protocol):
    """What has a dtype and a device: a tensor, a lens."""

    @property
    def dtype(self) -> torch.dtype: ...

    @property
    def device(self) -> torch.device: ...


def called(value: object) -> str:
    """What a message calls something: numbers and short strings by value, the rest by type, and shape if it has one."""
    if value is None or isinstance(value, str | bytes | int | float | complex | np.generic):
        text = repr(value.item() if isinstance(value, np.generic) else value)
        return text if len(text) <= 60 else f"a long {type(value).__name__}"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    name = type(value).__name__
    if isinstance(value, np.ndarray | Tensor):
        return f"{name} of shape {tuple(value.shape)}"
    return name


def instance(name: str, value: object, kind: type[T] | tuple[type[T], ...], want: str, remedy: str = "") -> T:
    """Something of a class of the package.

    Args:
        name: the argument's name, for the message.
        value: what the caller handed in.
        kind: the class, or several.
        want: what the message says is wanted, as `"a dp.Plane"`.
        remedy: what to do, as `"dp.Plane(normal, offset) makes one"`.

    Raises:
        TypeError: it is none.
    """
    if not isinstance(value, kind):
        raise TypeError(f"{name}: want {want}, got {called(value)}" + f"; {remedy}" * bool(remedy))
    return value


def flag(name: str, value: object) -> bool:
    """True or False.

    Raises:
        TypeError: anything else.
    """
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name}: want True or False, got {called(value)}")
    return bool(value)


def number(
    name: str,
    value: object,
    want: str = "a finite number",
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    most: float = math.inf,
) -> float:
    """One number, Python's or NumPy's or a tensor without axes, that is finite.

    Args:
        name: the argument's name.
        value: what the caller handed in.
        want: what the message says is wanted, with the range that the limits tell: `"a positive distance in px"`.
        above: it is more than this.
        least: it is no less than this.
        most: it is no more than this.

    Raises:
        TypeError: it is no number.
        ValueError: it is not finite, or out of range.
    """
    single = isinstance(value, Real) and not isinstance(value, bool | np.bool_)
    if isinstance(value, Tensor):
        value = dense(name, value)
        single = value.ndim == 0 and not (value.is_meta or value.is_complex() or value.dtype == torch.bool)
    elif isinstance(value, np.ndarray):
        single = value.ndim == 0 and value.dtype.kind in "fiu"
    if not single:
        raise TypeError(f"{name}: want {want}, got {called(value)}")
    try:
        found = float(value)  # type: ignore[arg-type]
    except OverflowError:
        found = math.inf
    if not (math.isfinite(found) and found > above and least <= found <= most):
        raise ValueError(f"{name}: want {want}, got {called(found)}")
    return found


def numbers(name: str, value: object, want: str, count: int) -> tuple[float, ...]:
    """So many finite numbers: a tuple, a list, an array or a tensor of them.

    Raises:
        TypeError: no such thing.
        ValueError: another count, or one that is not finite.
    """
    if not isinstance(value, Tensor | np.ndarray | list | tuple) or getattr(value, "is_meta", False):
        raise TypeError(f"{name}: want {want}, got {called(value)}")
    value = dense(name, value) if isinstance(value, Tensor) else value
    given = value.tolist() if isinstance(value, Tensor | np.ndarray) else list(value)
    if not isinstance(given, list) or len(given) != count:
        raise ValueError(f"{name}: want {want}, got {_listed(given)}")
    try:
        return tuple(number(name, one) for one in given)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{name}: want {want}, got {_listed(given)}") from None


def whole_number(
    name: str, value: object, want: str = "a whole number", *, least: float = -math.inf, most: float = math.inf
) -> int:
    """A whole number: Python's or NumPy's, or a tensor of integers without axes.

    Raises:
        TypeError: it is none; True, False and 2.0 are none.
        ValueError: it is out of range.
    """
    try:
        found = operator.index(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{name}: want {want}, got {called(value)}") from None
    if isinstance(value, bool) or (isinstance(value, Tensor | np.ndarray) and value.ndim > 0):
        raise TypeError(f"{name}: want {want}, got {called(value)}")
    if not least <= found <= most:
        raise ValueError(f"{name}: want {want}, got {found}")
    return found


def whole_numbers(name: str, value: object, want: str, device: torch.device | None = None) -> Tensor:
    """Whole numbers as a tensor: an integer tensor as it is, or an array or (nested) lists of them.

    Args:
        name: the argument's name.
        value: what the caller handed in.
        want: what the message says is wanted.
        device: where the numbers are needed: on the device meta, a tensor there has to do.

    Raises:
        TypeError: anything else.
    """
    if isinstance(value, Tensor):
        whole = not (value.is_floating_point() or value.is_complex() or value.dtype == torch.bool)
        whole = whole and (not value.is_meta or (device is not None and device.type == "meta"))
        found = dense(name, value)
    else:
        taken = isinstance(value, np.ndarray | list | tuple | range)
        try:
            array = np.asarray(value if taken else None)
        except (TypeError, ValueError, RuntimeError):
            array = np.asarray(None)
        whole = array.dtype.kind in "iu" or (taken and array.size == 0)
        found = torch.from_numpy(np.array(array if whole else 0, np.int64, order="C", copy=True))
    if not whole:
        raise TypeError(f"{name}: want {want}, whole numbers, got {called(value)}")
    return found.long()


def checked_seed(value: object) -> int:
    """The seed of a generator of random numbers.

    Raises:
        TypeError: it is no whole number.
        ValueError: it has more than 64 bits.
    """
    return whole_number("seed", value, "a whole number of at most 64 bits", least=-(2**63), most=2**64 - 1)


def position(name: str, value: object, count: int, of: str) -> int:
    """The number from 0 of one of `count` things, which may be counted from the end as -1, -2, ...

    Raises:
        TypeError: it is no whole number.
        ValueError: there is no such thing.
    """
    if count == 0:
        raise ValueError(f"{name}: want one of the {of}, but there are none")
    want = f"a number from {-count} to {count - 1}, of the {of}"
    return whole_number(name, value, want, least=-count, most=count - 1) % count


def choice(name: str, value: object, choices: Iterable[str]) -> str:
    """One of several words.

    Raises:
        TypeError: it is no string.
        ValueError: it is another one.
    """
    choices = tuple(choices)
    if not isinstance(value, str) or value not in choices:
        kind = ValueError if isinstance(value, str) else TypeError
        raise kind(f"{name}: want one of {', '.join(map(repr, choices))}, got {called(value)}")
    return value


def words(name: str, value: object, want: str) -> tuple[str, ...]:
    """Several strings.

    Raises:
        TypeError: anything else, a single string among it.
    """
    if isinstance(value, str):
        raise TypeError(f"{name}: want {want}, as in {name}=({value!r},), got a string")
    if not isinstance(value, list | tuple | set | frozenset):
        raise TypeError(f"{name}: want {want}, got {called(value)}")
    for one in value:
        if not isinstance(one, str):
            raise TypeError(f"{name}: want {want}, got {called(one)} among them")
    return tuple(value)


def function(name: str, value: T, want: str) -> T:
    """Something that can be called.

    Raises:
        TypeError: it cannot.
    """
    if not callable(value):
        raise TypeError(f"{name}: want {want}, got {called(value)}")
    return value


def file_path(name: str, value: object) -> Path:
    """The path of a file.

    Raises:
        TypeError: neither a string nor a path.
        ValueError: no file can have it.
    """
    if not isinstance(value, str | os.PathLike) or not isinstance(os.fspath(value), str):
        raise TypeError(f"{name}: want the path of a file, got {called(value)}")
    if "\0" in os.fspath(value):
        raise ValueError(f"{name}: want the path of a file, got {value!r}, which has a NUL character")
    return Path(value)


def tensor_of(name: str, value: object, like: Kind | None = None) -> Tensor:
    """A dense tensor as it is; an array or numbers as a new tensor.

    Args:
        name: the argument's name.
        value: what the caller handed in.
        like: whose dtype and device an array takes on; if left out, its own, and float64 for what has none.

    Raises:
        TypeError: it is no such thing, or a tensor that is not dense.
        ValueError: an array some of whose entries are masked.
    """
    if isinstance(value, Tensor):
        return dense(name, value)
    if torch.compiler.is_compiling() and type(value) in (
        float,
        int,
        list,
        tuple,
    ):  # which NumPy would make constants of
        kind, device = (torch.float64, torch.device("cpu")) if like is None else (like.dtype, like.device)
        return torch.tensor(value, dtype=kind, device=device)
    _check_unmasked(name, value)
    taken = isinstance(value, _ARRAYS) or hasattr(value, "__array__")
    try:
        array = np.asarray(value) if taken and not isinstance(value, type | bool) else np.asarray(None)
    except (TypeError, ValueError, RuntimeError):  # lists of several lengths, tensors with a graph
        raise TypeError(
            f"{name}: want a tensor, an array or lists of numbers of equal lengths, got {called(value)}; "
            "torch.stack(...) joins tensors"
        ) from None
    if array.dtype.kind not in "fiu":
        what = f"{called(value)} with {array.dtype}" if taken and array.dtype.kind != "O" else called(value)
        raise TypeError(f"{name}: want a tensor, an array or numbers, got {what}")
    keeps = array.dtype.kind == "f" and array.dtype.itemsize <= 4  # lists have given float64
    tensor = torch.from_numpy(np.array(array, np.float32 if keeps else np.float64, order="C", copy=True))
    if like is None or (tensor.dtype == like.dtype and tensor.device == like.device):
        return tensor
    return tensor.to(like.device, like.dtype)


def _check_unmasked(name: str, value: object) -> None:
    """That no entry of an array is masked: its values would be taken for good.

    Raises:
        ValueError: some are.
    """
    if isinstance(value, np.ma.MaskedArray) and bool(np.ma.is_masked(value)):
        raise ValueError(f"{name}: want an array without masked entries, got some; .filled(...) gives them values")


def booleans(name: str, value: object, device: torch.device | None = None) -> Tensor:
    """A tensor of booleans as it is; an array or lists of booleans as a new tensor on that device.

    Raises:
        TypeError: anything else.
        ValueError: an array some of whose entries are masked.
    """
    if isinstance(value, Tensor):
        found = dense(name, value)
    else:
        _check_unmasked(name, value)
        taken = isinstance(value, np.ndarray | np.bool_ | bool | list | tuple)
        try:
            array = np.asarray(value if taken else None)
        except (TypeError, ValueError, RuntimeError):
            array = np.asarray(None)
        if array.dtype != np.bool_:
            numeric = taken and array.dtype.kind in "fiu"
            raise TypeError(f"{name}: want booleans, got {array.dtype if numeric else called(value)}")
        found = torch.from_numpy(np.array(array, order="C", copy=True)).to(device)
    if found.dtype != torch.bool:
        raise TypeError(f"{name}: want booleans, got {found.dtype}")
    if found.is_meta and device is not None and device.type != "meta":
        raise ValueError(f"{name}: want values, got a tensor on the device meta")
    return found


def first_of(values: Tensor, wrong: Tensor) -> str:
    """The first of the values that are wrong, and where it is among several, for a message: `"-0.1 at (3, 2)"`.

    Args:
        values: numbers.
        wrong: which of them are, or of the rows, matrices and so on that they make up.
    """
    place = tuple(wrong.nonzero()[0].tolist())
    found = values.detach()[place].tolist()
    text = f"{found:.6g}" if isinstance(found, float) else f"{found}"
    if len(place) == 0 or wrong.numel() == 1:
        return text
    return f"{text} at {place[0] if len(place) == 1 else place}"


def meeting(*values: object) -> Kind | None:
    """The first of these that has a floating-point dtype and a device: what arrays among them are to be like."""
    for value in values:
        if isinstance(value, Tensor):
            if value.is_floating_point():
                return value
        elif isinstance(getattr(value, "dtype", None), torch.dtype) and hasattr(value, "device"):
            return value  # type: ignore[return-value]
    return None


def listing(name: str, value: Iterable[Any], want: str) -> list[Any]:
    """The items of a list, a tuple or anything else that has items, but for a string.

    Raises:
        TypeError: it has none.
    """
    try:
        items = iter(None if isinstance(value, str | bytes | type) else value)  # type: ignore[arg-type]
    except TypeError:
        raise TypeError(f"{name}: want {want}, got {called(value)}") from None
    return list(items)  # what fails while a generator runs is its own


def _listed(given: Any) -> str:
    text = repr(tuple(given)) if isinstance(given, list) else repr(given)
    return text if len(text) <= 60 else f"{len(given)} of them" if isinstance(given, list) else called(given)
