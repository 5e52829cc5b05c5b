"""The variables of MATLAB's `.mat` files of version 5 to 7: numbers, text and structs, as plain Python."""

import struct
import zlib
from typing import Any

import numpy as np

HEADER = 128
NUMBERS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
    16: "u1",
    17: "u2",
}
"""NumPy's types of the element types."""

MATRIX, COMPRESSED = 14, 15
STRUCT, TEXT, FIRST_NUMBER, LAST_NUMBER = 2, 4, 6, 15
"""Classes of arrays; others are cells, objects and functions."""

MOST_BYTES = 2**27
DEEPEST = 20


class Unreadable(str):
    """A variable that holds something else than numbers, text and structs; it says what."""


def variables(data: bytes) -> dict[str, Any]:
    """The variables of a file by name; numbers as float64 arrays, text as `str`, structs as `dict`.

    Raises:
        ValueError: it is damaged.
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise ValueError("want a .mat file of version 5 to 7, got another header")
    found: dict[str, Any] = {}
    try:
        for kind, content in _elements(data[HEADER:], order):
            if kind == COMPRESSED:
                (kind, content), *_ = _elements(_inflated(content), order)
            if kind != MATRIX:
                raise ValueError(f"want a matrix, got the element type {kind}")
            name, value = _matrix(content, order, 0)
            if name in found:
                raise ValueError(f"{name}: want the variable once, got it twice")
            if name:  # the last one, without a name, holds the insides of objects
                found[name] = value
    except (struct.error, zlib.error, TypeError) as error:
        raise ValueError(f"want a whole .mat file, got a damaged one ({error})") from None
    return found


def _inflated(data: bytes) -> bytes:
    stream = zlib.decompressobj()
    content = stream.decompress(data, MOST_BYTES)
    if stream.unconsumed_tail:
        raise ValueError(f"want variables of at most {MOST_BYTES} bytes, got a larger one")
    return content


def _elements(data: bytes, order: str) -> list[tuple[int, bytes]]:
    """The elements that stand one after the other."""
    elements, at = [], 0
    while at + 8 <= len(data):
        kind, length = struct.unpack_from(order + "II", data, at)
        if kind >> 16:  # up to four bytes stand in the tag
            kind, length, start, step = kind & 0xFFFF, kind >> 16, at + 4, 8
        else:
            start, step = at + 8, 8 + length + (0 if kind == COMPRESSED else -length % 8)
        if start + length > len(data) or (step == 8 and length > 4 and start == at + 4):
            raise ValueError("want a whole .mat file, got one that ends early")
        elements.append((kind, data[start : start + length]))
        at += step
    return elements


def _numbers(element: tuple[int, bytes], order: str) -> np.ndarray:
    kind, content = element
    if kind not in NUMBERS:
        raise ValueError(f"want numbers, got the element type {kind}")
    dtype = np.dtype(order + NUMBERS[kind])
    if len(content) % dtype.itemsize:
        raise ValueError("want whole numbers of bytes, got a damaged .mat file")
    return np.frombuffer(content, dtype)


def _matrix(data: bytes, order: str, depth: int) -> tuple[str, Any]:
    """A variable's name and value."""
    if depth > DEEPEST:
        raise ValueError("want structs in structs to a depth of 20 at most, got deeper ones")
    elements = _elements(data, order)
    if not elements:
        return "", np.zeros(0)
    kind = int(_numbers(elements[0], order)[0]) & 0xFF if elements[0][1] else 0
    if len(elements) < 3 or not (FIRST_NUMBER <= kind <= LAST_NUMBER or kind in (STRUCT, TEXT)):
        names = [content for type_, content in elements[1:4] if type_ == 1]
        what = Unreadable(
            {1: "a cell array", 3: "an object", 5: "a sparse matrix", 17: "an object"}.get(kind, "something else")
        )
        return names[0].decode("latin-1") if names else "", what
    shape = _numbers(elements[1], order).astype(int).tolist()
    name = elements[2][1].decode("latin-1")
    if kind == STRUCT:
        return name, _struct(elements[3:], shape, order, depth)
    values = _numbers(elements[3], order) if len(elements) > 3 else np.zeros(0)
    if kind == TEXT:
        return name, "".join(chr(int(code)) for code in values[:1000])
    if any(side < 0 for side in shape) or int(np.prod(shape, dtype=object)) != values.size:
        raise ValueError(f"{name}: want {shape} numbers, got {values.size}")
    return name, values.astype(np.float64).reshape(shape, order="F")


def _struct(elements: list[tuple[int, bytes]], shape: list[int], order: str, depth: int) -> Any:
    """The fields of a single struct."""
    if len(elements) < 2:
        raise ValueError("want the fields of a struct, got a damaged .mat file")
    length = int(_numbers(elements[0], order)[0])
    if length < 1:
        raise ValueError("want names of fields, got a damaged .mat file")
    raw = elements[1][1]
    names = [raw[i : i + length].split(b"\0")[0].decode("latin-1") for i in range(0, len(raw), length)]
    if shape != [1, 1] or len(elements) - 2 != len(names) or len(set(names)) < len(names):
        return Unreadable("an array of structs")
    return {name: _matrix(content, order, depth + 1)[1] for name, (_, content) in zip(names, elements[2:], strict=True)}
