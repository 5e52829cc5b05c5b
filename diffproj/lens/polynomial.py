"""Polynomials by Horner's rule, and `total - a b` in one operation."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def polynomial(x: Any, coefficients: Sequence[Any]) -> Any:
    """`c0 + c1 x + c2 x^2 + ...` for coefficients that broadcast against `x`; `c0` itself if it is the only one.

    Of tensors, or of NumPy's arrays.
    """
    total = coefficients[-1]
    if not isinstance(x, Tensor):
        for coefficient in reversed(coefficients[:-1]):
            total = total * x + coefficient
        return total
    for number, coefficient in enumerate(reversed(coefficients[:-1])):
        # With two columns among its arguments `addcmul` takes twice the time of two operations.
        total = torch.addcmul(coefficient, total, x) if number else total * x + coefficient
    return total


def series(x: Tensor, coefficients: Sequence[float]) -> Tensor:
    """The same for at least two coefficients that are numbers."""
    total = x * coefficients[-1] + coefficients[-2]
    for coefficient in reversed(coefficients[:-2]):
        total = total * x + coefficient
    return total


def minus_product(total: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """`total - a b`, in one operation.

    In a compiled graph, where operations are fused anyway, it is written as two: PyTorch 2.13 crashes there on the
    forward derivative of `addcmul` with `value`.
    """
    return total - a * b if torch.compiler.is_compiling() else torch.addcmul(total, a, b, value=-1)
