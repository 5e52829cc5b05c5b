"""Checks of arguments: messages that name the argument and all that was given."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj._core.arguments import called, first_of, listing, number, numbers, whole_number


@pytest.mark.parametrize(
    ("value", "error"), [([0, math.inf, 1], ValueError), ([0, "x", 1], TypeError), ((1, 2), ValueError)]
)
def test_one_wrong_number_of_several_is_told_with_what_was_wanted(value: object, error: type[Exception]) -> None:
    with pytest.raises(error, match="^extent: want three numbers, got"):
        numbers("extent", value, "three numbers", 3)


def test_several_numbers() -> None:
    assert numbers("extent", [0, 1.5, 2], "three numbers", 3) == (0.0, 1.5, 2.0)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "None"),
        ("x", "'x'"),
        (2.5, "2.5"),
        (np.float64(2.5), "2.5"),
        ("x" * 99, "a long str"),
        (torch.Tensor, "the class Tensor"),
        (torch.zeros(2, 3), "Tensor of shape (2, 3)"),
        (np.zeros(4), "ndarray of shape (4,)"),
        ([1, 2], "list"),
        ({}, "dict"),
    ],
)
def test_what_a_message_calls_a_value(value: object, text: str) -> None:
    assert called(value) == text


@pytest.mark.parametrize("value", [2.5, np.float32(2.5), np.array(2.5), torch.tensor(2.5)])
def test_a_number_comes_in_many_forms(value: object) -> None:
    assert number("step", value, "a number") == 2.5
    with pytest.raises(ValueError, match="^step: want a number, got"):
        number("step", value, "a number", above=2.5)
    with pytest.raises(ValueError, match="^step: want a number, got"):
        number("step", value, "a number", most=2.4)


@pytest.mark.parametrize(
    "value", [None, True, "2", [2.5], np.array([2.5]), np.array(True), torch.tensor([2.5]), torch.tensor(True), 1j]
)
def test_what_is_no_number_is_named(value: object) -> None:
    with pytest.raises(TypeError, match="^step: want a number, got"):
        number("step", value, "a number")


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (-0.1, "-0.1"),
        ([-0.1], "-0.1"),
        ([1.0, -2.0, -3.0], "-2 at 1"),
        ([[1.0, 2.0], [-0.1, -5.0]], "-0.1 at (1, 0)"),
    ],
)
def test_the_first_wrong_value_of_several_is_told_with_its_place(values: object, text: str) -> None:
    given = torch.tensor(values, dtype=torch.float64)
    assert first_of(given, given < 0) == text


THIN = {
    "sparse": (lambda tensor: tensor.to_sparse(), "layout torch.sparse_coo; .to_dense"),
    "by rows": (lambda tensor: tensor.to_sparse_csr(), "layout torch.sparse_csr; .to_dense"),
    "quantised": (lambda tensor: torch.quantize_per_tensor(tensor, 0.1, 0, torch.quint8), "torch.quint8; .dequantize"),
}


@pytest.mark.plain
@pytest.mark.filterwarnings("ignore")  # PyTorch's own: both are on their way in, or out
@pytest.mark.parametrize(("made", "got"), THIN.values(), ids=THIN.keys())
def test_tensors_that_are_not_dense_are_named(made: Callable[[torch.Tensor], torch.Tensor], got: str) -> None:
    thin = made(torch.ones(2, 2))
    views, board = dp.example_views("left"), dp.Chessboard()
    calls: list[tuple[str, Callable[[], object]]] = [
        ("origin", lambda: dp.geotransform((0, 0, 1, 1), 0.5, thin)),
        ("sigma", lambda: dp.Landmarks(board.points, sigma=thin)),
        ("image 1", lambda: dp.detect(thin, board)),
        ("squared", lambda: dp.Huber(1.0).value(thin)),
        ("squared", lambda: dp.Cauchy(1.0).weight(thin)),
        ("visible", lambda: dp.Views(views.pixels, thin)),
        ("pixels", lambda: dp.Views(thin)),
        ("normal", lambda: dp.Plane(thin)),
        ("weights", lambda: dp.calibrate(views, board, weights=thin)),
    ]
    for name, call in calls:
        with pytest.raises(TypeError, match=f"^{name}: want a dense tensor, got {got}"):
            call()


@pytest.mark.parametrize("value", ["x", 2.0, None, torch.zeros(2), torch.zeros(2, dtype=torch.int64), np.zeros(2, int)])
def test_what_is_no_whole_number_is_refused_by_name(value: object) -> None:
    with pytest.raises(TypeError, match="^count: want a whole number, got"):
        whole_number("count", value)


def test_what_fails_inside_a_generator_is_not_said_of_the_argument() -> None:
    def photographs() -> Iterator[int]:
        yield 1
        raise TypeError("of its own")

    with pytest.raises(TypeError, match="^of its own$"):
        listing("photographs", photographs(), "files")
