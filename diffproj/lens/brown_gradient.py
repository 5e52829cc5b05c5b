"""Derivatives of the inverse of a Brown-Conrady lens at a point that was found.

`recorded` takes two more Newton steps with autograd looking on, which every tool of PyTorch can follow: at the
solution, one step has the exact first derivative of the inverse function, two have the second. `with_gradient` gives
the first derivative in closed form and keeps little; a derivative of that is taken through `recorded`.
"""

from itertools import islice
from typing import Any

import torch
from torch import Tensor

from diffproj._core.numerics import has_values
from diffproj._core.torch_private import in_forward_mode
from diffproj.lens.brown_equations import UNTILTED, Terms, bend_off, columns_by_coefficients
from diffproj.lens.brown_inverse import newton, untilted


def recorded(coefficients: Tensor, points: Tensor, x: Tensor, y: Tensor, valid: Tensor) -> Tensor:
    """The undistorted points `(*B, N, 2)` with their derivatives, none where not valid.

    Args:
        coefficients: `(*B, k)`.
        points: distorted ones `(*B, N, 2)`.
        x: of the undistorted points, found without a graph, 0 where not valid `(*B, N)`.
        y: the same.
        valid: `(*B, N)`.
    """
    terms = Terms.of(coefficients)
    target = untilted(terms, torch.where(valid.unsqueeze(-1), points, 0))
    return torch.stack(newton(terms, target, x, y, steps=2), dim=-1)


def follows_gradient(points: Tensor, coefficients: Tensor) -> bool:
    """Whether `with_gradient` is enough here: for reverse mode, and lenses without tilt."""
    return coefficients.shape[-1] <= UNTILTED and has_values(points, coefficients) and not in_forward_mode()


def with_gradient(coefficients: Tensor, points: Tensor, x: Tensor, y: Tensor, valid: Tensor) -> Tensor:
    """The same, for reverse mode."""
    return _Inverse.apply(coefficients, points, x, y, valid)  # type: ignore[no-any-return]


class _Inverse(torch.autograd.Function):
    """By the implicit function theorem: `F(xy, k) = points` gives `dxy = J^-1 (dpoints - dF/dk dk)`."""

    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, points: Tensor, x: Tensor, y: Tensor, valid: Tensor) -> Tensor:
        ctx.save_for_backward(coefficients, points, x, y, valid)
        return torch.stack((x, y), dim=-1)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, None]:
        by_xy = grad_outputs[0]
        coefficients, points, x, y, valid = ctx.saved_tensors
        wanted = ctx.needs_input_grad[:2]
        if torch.is_grad_enabled():
            return *_recorded_gradient(coefficients, points, (x, y, valid), by_xy, wanted), None, None, None
        terms, zero = Terms.of(coefficients), torch.zeros_like(x)
        jacobian = bend_off(terms, (zero, zero), x, y)[2]
        by_x, by_y = torch.where(valid.unsqueeze(-1), by_xy, 0).unbind(-1)
        determinant = jacobian.xx * jacobian.yy - jacobian.xy * jacobian.yx
        u = (jacobian.yy * by_x - jacobian.yx * by_y) / determinant
        v = (jacobian.xx * by_y - jacobian.xy * by_x) / determinant
        by_coefficients = None
        if wanted[0]:
            columns = islice(columns_by_coefficients(terms, x, y), coefficients.shape[-1])
            sums = [torch.addcmul(u * along_x, v, along_y).sum(-1) for along_x, along_y in columns]
            by_coefficients = -torch.stack(sums, dim=-1).sum_to_size(coefficients.shape)
        return by_coefficients, torch.stack((u, v), dim=-1) if wanted[1] else None, None, None, None


def _recorded_gradient(
    coefficients: Tensor,
    points: Tensor,
    found: tuple[Tensor, Tensor, Tensor],
    by_xy: Tensor,
    wanted: tuple[bool, bool],
) -> tuple[Tensor | None, Tensor | None]:
    """The gradient by coefficients and points, as a function that can be differentiated again."""
    coefficients, points = coefficients.view_as(coefficients), points.view_as(points)  # neither a part of the other
    xy = recorded(coefficients, points, *found)
    chosen = [one for one, want in zip((coefficients, points), wanted, strict=True) if want]
    slopes = iter(torch.autograd.grad(xy, chosen, by_xy, create_graph=True))
    return next(slopes) if wanted[0] else None, next(slopes) if wanted[1] else None
