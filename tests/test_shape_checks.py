"""The checks of annotations that all other tests run under: they see what is wrong, and leave alone what is right."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

import diffproj as dp
from diffproj._core.numerics import transform
from tests.shape_checks import checked

Points = Float[Tensor, "n 3"]


@checked
def paired(points: Points, weights: Float[Tensor, " n"] | float, rows: int = 3) -> Float[Tensor, "3 n"]:
    return (points * torch.as_tensor(weights)[..., None]).mT.expand(3, -1)[:rows]


@checked
@dataclasses.dataclass
class Pair:
    first: Points
    second: Points
    scale: float = 1

    @checked
    def other(self, pair: "Pair") -> "Pair":
        return pair

    @property
    @checked
    def size(self) -> int:
        return "many"  # type: ignore[return-value]

    @classmethod
    @checked
    def of(cls, points: Points) -> Any:
        return cls(points, points)


@checked
def counted(points: Points) -> Iterator[int]:
    yield len(points)


def zeros(*shape: int) -> Tensor:
    return torch.zeros(*shape)


def test_what_is_right_passes() -> None:
    assert paired(zeros(4, 3), zeros(4)).shape == (3, 4)
    assert paired(zeros(4, 3), 2).shape == (3, 4)  # an int stands for a float
    pair = Pair.of(zeros(2, 3))
    assert pair.other(pair) is pair
    assert list(counted(zeros(5, 3))) == [5]


@pytest.mark.parametrize(
    "call",
    [
        lambda: paired(zeros(4, 2), 2.0),
        lambda: paired(zeros(4, 3), zeros(5)),
        lambda: paired(zeros(4, 3).long(), 2.0),
        lambda: paired(np.zeros((4, 3)), 2.0),  # type: ignore[arg-type]
        lambda: paired(zeros(4, 3), "2"),  # type: ignore[arg-type]
        lambda: paired(zeros(4, 3), 2.0, rows=2.0),  # type: ignore[arg-type]
        lambda: Pair(zeros(4, 3), zeros(5, 3)),
        lambda: Pair(zeros(4, 3), zeros(4, 3), "x"),  # type: ignore[arg-type]
        lambda: Pair.of(zeros(4, 2)),
        lambda: Pair.of(zeros(4, 3)).other("pair"),  # type: ignore[arg-type]
        lambda: Pair.of(zeros(4, 3)).size,
        lambda: counted(zeros(4, 2)),
    ],
)
def test_what_is_wrong_is_seen(call: Callable[[], Any]) -> None:
    with pytest.raises(TypeError, match="violates|Type-check error"):
        call()


def test_sizes_are_those_of_one_call() -> None:
    paired(zeros(4, 3), zeros(4))
    paired(zeros(5, 3), zeros(5))
    with pytest.raises(TypeError, match="violates"):
        paired(zeros(4, 3), zeros(4), rows=2)
    paired(zeros(6, 3), zeros(6))


@pytest.mark.parametrize("call", [lambda: dp.Plane.from_points(5), lambda: transform(zeros(3, 3), "x")])
def test_the_package_is_checked(call: Callable[[], Any]) -> None:
    with pytest.raises(TypeError, match="violates"):
        call()
