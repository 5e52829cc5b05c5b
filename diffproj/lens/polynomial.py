"""Polynomials by Horner's rule, and sums with a product in one operation: of tensors, or of NumPy's arrays."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def polynomial(x: Any, coefficients: Sequence[Any]) -> Any:
    """`c0 + c1 x + c2 x^2 + ...` for coefficients that broadcast against `x`; `c0` itself if it is the only one."""
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


def plus_product(total: Any, a: Any, b: Any) -> Any:
    """`total + a b`."""
    return torch.addcmul(total, a, b) if isinstance(a, Tensor) else total + a * b


def plus_quotient(total: Any, a: Any, b: Any) -> Any:
    """`total + a / b`."""
    return torch.addcdiv(total, a, b) if isinstance(a, Tensor) else total + a / b


def minus_product(total: Any, a: Any, b: Any) -> Any:
    """`total - a b`.

    In a compiled graph, where operations are fused anyway, it is written as two: PyTorch 2.13 crashes there on the
    forward derivative of `addcmul` with `value`.
    """
    if isinstance(a, Tensor) and not torch.compiler.is_compiling():
        return torch.addcmul(total, a, b, value=-1)
    return total - a * b
