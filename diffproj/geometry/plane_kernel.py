"""What is done to every point: `X = A p / (b . p)` where `b . p > s . |p|`, for a matrix `[A; b; s] (5, 3)`.

It stands here twice, for two readers. `recorded` takes steps that every tool of PyTorch can follow: derivatives of any
order and mode, `vmap`, compilers, export. `direct` takes as few as possible, for short calls cost their number; where a
gradient is asked, the backward pass is written by hand. A derivative of that gradient is taken through `recorded`.

Of few points on a CPU `direct` takes the same steps in NumPy (`plane_kernel_short.py`): each takes half the time there.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from diffproj._core.numerics import all_true, entries, interleaved, is_short, linear
from diffproj._core.torch_private import has_storage
from diffproj.geometry.plane_kernel_short import divided, gradient


def components(p: Tensor) -> list[Tensor | None]:
    """The three components of vectors `(*B, N, 3)`, or of `(*B, N, 2)` and a constant 1, for which `None` stands."""
    return [*p.unbind(-1), *[None] * (3 - p.shape[-1])]


# ---------------------------------------------------------------------------------------------------------- recorded


def recorded(p: Tensor, matrix: Tensor, seen: Tensor | None) -> tuple[Tensor, Tensor]:
    """Points `(*B, N, 3)`, zero where not valid, and `valid (*B, N)`.

    Args:
        p: centred pixels `(*B, N, 2)`, or directions `(*B, N, 3)`.
        matrix: `[A; b; s] (*B, 5, 3)`.
        seen: where the lens has an inverse `(*B, N)`; `None`: everywhere.
    """
    _, points, _, valid = intersection(p, matrix, seen)
    return interleaved(points), valid


def intersection(
    p: Tensor, matrix: Tensor, seen: Tensor | None
) -> tuple[list[Tensor | None], list[Tensor], Tensor, Tensor]:
    """The components of `p`, those of the points, `1 / (b . p)`, and which are valid; 0 where they are not."""
    *rows, _ = entries(matrix)
    sight = components(p)
    denominator, threshold = denominator_and_threshold(matrix, sight)
    valid = denominator > threshold  # false for NaN, too
    if seen is not None:
        valid = valid & seen
    # Where there is no point, the denominator becomes infinite and p finite before anything is divided, so that
    # neither values nor gradients of infinite or parallel rays ever arise.
    sight = [component if component is None else torch.where(valid, component, 0.0) for component in sight]
    *numerators, denominator = linear(rows, sight)
    inverse = torch.where(valid, denominator, torch.inf).reciprocal()
    return sight, [numerator * inverse for numerator in numerators], inverse, valid


def denominator_and_threshold(matrix: Tensor, sight: Sequence[Tensor | None]) -> tuple[Tensor, Tensor]:
    """`b . p`, and `s . |p|`, the size below which rounding decides its sign."""
    *_, b, size = entries(matrix)
    terms = [component if component is None else component.detach().abs() for component in sight]
    return linear([b], sight)[0], linear([[part.detach() for part in size]], terms)[0]


# ------------------------------------------------------------------------------------------------------------ direct


def direct(p: Tensor, matrix: Tensor, seen: Tensor | None) -> tuple[Tensor, Tensor]:
    """The same as `recorded` where values can be read and nothing but a gradient may be asked."""
    if torch.is_grad_enabled() and (p.requires_grad or matrix.requires_grad):
        return _WithGradient.apply(p, matrix, seen)  # type: ignore[no-any-return]
    points, valid, _, _ = _divided(p, matrix, seen)
    return points, valid


def _divided(p: Tensor, matrix: Tensor, seen: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """The points, which are valid, `b . p`, and which are not valid (`None`: all are)."""
    if is_short(p):
        return divided(p, matrix, seen)
    x, y, *z = p.unsqueeze(-3).unbind(-1)
    products = _times(matrix.narrow(-2, 0, 4), x, y, *z)
    threshold = _times(matrix.narrow(-2, 4, 1), x.abs(), y.abs(), *(part.abs() for part in z))
    numerators, denominator = products.narrow(-2, 0, 3), products.narrow(-2, 3, 1)
    valid = (denominator > threshold).squeeze(-2)  # false for NaN, too
    if seen is not None:
        valid = valid & seen
    points = p.new_empty((*p.shape[:-1], 3))
    torch.div(numerators, denominator, out=points.mT)
    denominator = denominator.squeeze(-2)
    if all_true(valid):  # the usual case
        return points, valid, denominator, None
    hidden = ~valid
    points.masked_fill_(hidden.unsqueeze(-1), 0.0)
    return points, valid, denominator.masked_fill_(hidden, torch.inf), hidden


def _times(matrix: Tensor, x: Tensor, y: Tensor, *z: Tensor) -> Tensor:
    """Products `(*B, m, N)` of matrices `(*B, m, 3)` and vectors of components `(*B, 1, N)`; z is 1 if left out."""
    by_x, by_y, rest = matrix.unsqueeze(-1).unbind(-2)
    products = (rest * z[0]).addcmul_(x, by_x) if z else torch.addcmul(rest, x, by_x)
    return products.addcmul_(y, by_y)


class _WithGradient(torch.autograd.Function):
    """`direct` with its gradient: by `dX = (A dp - X (b . dp)) / (b . p)`, and 0 where there is no point."""

    @staticmethod
    def forward(ctx: Any, p: Tensor, matrix: Tensor, seen: Tensor | None) -> tuple[Tensor, Tensor]:
        points, valid, denominator, hidden = _divided(p, matrix, seen)
        ctx.save_for_backward(p, matrix, seen, denominator, hidden)
        ctx.mark_non_differentiable(valid)
        return points, valid

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        by_points = grad_outputs[0]
        p, matrix, seen, denominator, hidden = ctx.saved_tensors
        of_p, of_matrix, _ = ctx.needs_input_grad
        if torch.is_grad_enabled():
            by_p, by_matrix = _recorded_gradient(p, matrix, seen, by_points, (of_p, of_matrix))
            return by_p, by_matrix, None
        if is_short(p) and has_storage(by_points):
            by_p, by_matrix = gradient(p, matrix, hidden, denominator, by_points, (of_p, of_matrix))
            return by_p, by_matrix, None
        if hidden is not None:
            p, by_points = (tensor.masked_fill(hidden.unsqueeze(-1), 0.0) for tensor in (p, by_points))
        x, y, *z = p.unsqueeze(-3).unbind(-1)
        inverse = denominator.reciprocal().unsqueeze(-2)
        by_numerators = by_points.mT * inverse  # (*B, 3, N)
        rows = [_by_columns(by_numerators, x, y, *z)] if of_matrix else []
        # By p through the numerators; along p this is what the denominator takes back.
        through = _times(matrix.narrow(-2, 0, 3).mT, *by_numerators.unsqueeze(-3).unbind(-2))
        del by_numerators  # for the memory at the peak
        by_x, by_y, by_z = (through.narrow(-2, axis, 1) for axis in range(3))
        along = (by_z * z[0]).addcmul_(by_x, x) if z else torch.addcmul(by_z, by_x, x)
        by_denominator = along.addcmul_(by_y, y).mul_(inverse).neg_()
        by_p = by_matrix = None
        if of_matrix:
            rows.append(_by_columns(by_denominator, x, y, *z))
            by_matrix = torch.cat([*rows, torch.zeros_like(rows[1])], dim=-2).sum_to_size(matrix.shape)  # s is constant
        if of_p:
            length = p.shape[-1]
            b = matrix[..., 3, :length].unsqueeze(-1)
            by_p = through.narrow(-2, 0, length).addcmul_(by_denominator, b).mT
        return by_p, by_matrix, None


def _by_columns(by_products: Tensor, *components: Tensor) -> Tensor:
    """The gradient `(*B, m, 3)` by a matrix from that by its products `(*B, m, N)`."""
    columns = [(by_products * component).sum(-1) for component in components]
    return torch.stack(columns if len(columns) == 3 else [*columns, by_products.sum(-1)], dim=-1)


def _recorded_gradient(
    p: Tensor, matrix: Tensor, seen: Tensor | None, by_points: Tensor, wanted: tuple[bool, bool]
) -> tuple[Tensor | None, Tensor | None]:
    """The gradient by p and by the matrix, as a function that can be differentiated again."""
    p, matrix = p.view_as(p), matrix.view_as(matrix)  # so that one does not count as a part of the other
    points, _ = recorded(p, matrix, seen)
    chosen = [one for one, want in zip((p, matrix), wanted, strict=True) if want]
    found = iter(torch.autograd.grad(points, chosen, by_points, create_graph=True))
    return next(found) if wanted[0] else None, next(found) if wanted[1] else None
