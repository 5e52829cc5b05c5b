"""Reading what a file says of a calibration: numbers, in the shape and the range that they have to be in."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

Shape = tuple[int | None, ...]
"""Lengths of axes; `None` where one is free."""


def tensor(
    fields: dict[str, Any],
    name: str,
    shape: Shape | None = None,
    *,
    least: float | None = None,
    gaps: bool = False,
) -> Tensor:
    """A field as a float64 tensor.

    Args:
        fields: what the file holds.
        name: of the field.
        shape: that it has to have; any if left out.
        least: the smallest number that it may hold.
        gaps: whether numbers may be missing, `null` in a file; they become NaN.

    Raises:
        KeyError: it is missing.
        ValueError: it holds something else than finite numbers, in another shape, or smaller ones.
    """
    array = _array(name, fields[name], gaps)
    if array.size == 0 and shape is not None and 0 in shape and None not in shape:
        array = array.reshape(shape)  # type: ignore[arg-type]  # lists of nothing do not tell what is in them
    if shape is not None and not _fits(array.shape, shape):
        wanted = ", ".join("any" if side is None else str(side) for side in shape)
        raise ValueError(f"{name}: want shape ({wanted}), got {array.shape}")
    known = array[~np.isnan(array)] if gaps else array
    if not np.isfinite(known).all() and not (gaps and not np.isneginf(known).any()):
        raise ValueError(f"{name}: want finite numbers, got NaN or infinity")
    if least is not None and known.size and float(known.min()) < least:
        raise ValueError(f"{name}: want numbers of at least {least:g}, got {float(known.min()):g}")
    return torch.from_numpy(array)


def mask(fields: dict[str, Any], name: str, shape: Shape | None = None) -> Tensor:
    """A field of booleans.

    Raises:
        KeyError: it is missing.
        ValueError: it holds something else, or has another shape.
    """
    array = _regular(name, fields[name])
    if array.dtype != np.bool_ and array.size:
        raise ValueError(f"{name}: want true and false, got {array.dtype}")
    if shape is not None and tuple(shape) != array.shape:
        raise ValueError(f"{name}: want shape {tuple(shape)}, got {array.shape}")
    return torch.from_numpy(array.astype(np.bool_))


def codes(fields: dict[str, Any], name: str, shape: Shape, most: int) -> Tensor:
    """A field of whole numbers from 0 to `most`.

    Raises:
        KeyError: it is missing.
        ValueError: it holds something else, or has another shape.
    """
    found = tensor(fields, name, shape, least=0)
    if bool((found != found.round()).any()) or bool((found > most).any()):
        raise ValueError(f"{name}: want whole numbers from 0 to {most}, got {found.flatten()[:4].tolist()}")
    return found.long()


def present(fields: dict[str, Any], name: str) -> bool:
    """Whether a field is there and holds something; files of earlier releases lack some."""
    return fields.get(name) is not None


def _fits(found: tuple[int, ...], wanted: Shape) -> bool:
    return len(found) == len(wanted) and all(want in (None, got) for want, got in zip(wanted, found, strict=True))


def _regular(name: str, value: Any) -> np.ndarray:
    try:
        return np.array(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: want lists of equal lengths, got others") from None


def _array(name: str, value: Any, gaps: bool) -> np.ndarray:
    array = _regular(name, value)
    if array.dtype == object and gaps:
        if any(item is not None and type(item) not in (int, float) for item in array.flat):
            raise ValueError(f"{name}: want numbers or null, got something else")
        array = np.array(array, dtype=np.float64)  # NaN for None
    if array.dtype.kind not in "fiu" and array.size:
        raise ValueError(
            f"{name}: want numbers, got {'gaps or mixed values' if array.dtype == object else array.dtype}"
        )
    return array.astype(np.float64)
