"""MATLAB's binary files element by element: every type of number, both byte orders, what is not read, and damage."""

import struct
import zlib

import numpy as np
import pytest

from diffproj.files.mat5 import DEEPEST, NUMBERS, Unreadable, variables


def element(kind: int, content: bytes, order: str = "<") -> bytes:
    return struct.pack(order + "II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def small(kind: int, content: bytes, order: str = "<") -> bytes:
    """Up to four bytes in the tag."""
    return struct.pack(order + "I", len(content) << 16 | kind) + content.ljust(4, b"\0")


def matrix(
    *parts: bytes, array: int = 6, shape: tuple[int, ...] = (1, 1), name: bytes = b"a", order: str = "<"
) -> bytes:
    flags = element(6, struct.pack(order + "II", array, 0), order)
    sides = element(5, struct.pack(f"{order}{len(shape)}i", *shape), order)
    return element(14, flags + sides + element(1, name, order) + b"".join(parts), order)


def file(*elements: bytes, order: bytes = b"IM") -> bytes:
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1" + order + b"".join(elements)


def packed(content: bytes) -> bytes:
    data = zlib.compress(content)
    return struct.pack("<II", 15, len(data)) + data


def struct_of(names: bytes, *fields: bytes, length: int = 8, shape: tuple[int, int] = (1, 1)) -> bytes:
    return matrix(small(5, struct.pack("<i", length)), element(1, names), *fields, array=2, shape=shape)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", sorted(set(NUMBERS) - {16, 17}))
def test_every_type_of_number(kind: int, order: str) -> None:
    values = np.array([[1, 2], [3, 100]])
    content = values.astype(np.dtype(order + NUMBERS[kind])).tobytes("F")
    mark = b"IM" if order == "<" else b"MI"
    found = variables(file(matrix(element(kind, content, order), shape=(2, 2), order=order), order=mark))
    np.testing.assert_array_equal(found["a"], values)
    assert found["a"].dtype == np.float64
    one = variables(file(matrix(small(2, b"\7", order), order=order), order=mark))
    np.testing.assert_array_equal(one["a"], [[7.0]])


def test_text_structs_and_empty_arrays() -> None:
    text = matrix(element(4, "µm".encode("utf-16-le")), array=4, shape=(1, 2))
    both = struct_of(b"unit\0\0\0\0empty\0\0\0", text, element(14, b""))
    found = variables(file(both, packed(matrix(element(9, b""), shape=(0, 0), name=b"nothing"))))
    assert found["a"]["unit"] == "µm"
    assert found["a"]["empty"].size == 0
    assert found["nothing"].shape == (0, 0)


@pytest.mark.parametrize(
    ("array", "what"),
    [(1, "a cell array"), (3, "an object"), (5, "a sparse matrix"), (17, "an object"), (16, "something else")],
)
def test_what_is_not_read_says_what_it_is(array: int, what: str) -> None:
    found = variables(file(matrix(array=array), matrix(element(9, struct.pack("<d", 2.0)), name=b"b")))
    assert isinstance(found["a"], Unreadable)
    assert found["a"] == what
    assert found["b"] == 2.0
    several = struct_of(b"x\0\0\0\0\0\0\0", matrix(), matrix(), shape=(1, 2))
    assert variables(file(several))["a"] == "an array of structs"


def deep() -> bytes:
    inner = matrix(element(9, struct.pack("<d", 2.0)))
    for _ in range(DEEPEST + 2):
        inner = struct_of(b"x\0\0\0\0\0\0\0", inner)
    return inner


number = element(9, struct.pack("<d", 2.0))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (file(matrix(number), order=b"XX"), "want a .mat file of version 5 to 7"),
        (file(number), "want a matrix, got the element type 9"),
        (file(matrix(number), matrix(number)), "a: want the variable once, got it twice"),
        (file(matrix(number, shape=(1, 2))), r"a: want \[1, 2\] numbers, got 1"),
        (file(matrix(number, shape=(-1, -1))), r"a: want \[-1, -1\] numbers"),
        (file(matrix(element(8, bytes(8)))), "want numbers, got the element type 8"),
        (file(matrix(element(9, bytes(7)))), "want whole numbers of bytes"),
        (file(matrix(number)[:-4]), "want a whole .mat file, got one that ends early"),
        (file(matrix(struct.pack("<I", 7 << 16 | 9) + bytes(12))), "want a whole .mat file"),
        (file(packed(matrix(number))[:-5]), "want a whole .mat file"),
        (file(struct.pack("<II", 15, 8) + b"no zlib."), "want a whole .mat file, got a damaged one"),
        (file(matrix(small(5, struct.pack("<i", 8)), array=2)), "want the fields of a struct"),
        (file(struct_of(b"x", number, length=0)), "want names of fields"),
        (file(deep()), "want structs in structs to a depth of 20 at most"),
    ],
)  # fmt: skip
def test_damage_is_refused(data: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        variables(data)


def test_a_variable_that_unpacks_to_gigabytes_is_not_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffproj.files.mat5.MOST_BYTES", 1000)
    with pytest.raises(ValueError, match="want variables of at most 1000 bytes, got a larger one"):
        variables(file(packed(matrix(element(2, bytes(5000)), shape=(1, 5000)))))
