"""`PlaneLoss`: a loss in world units over the points that are valid."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from diffproj._core.numerics import check_tensor
from diffproj.calibration.losses import Loss


class PlaneLoss(nn.Module):
    """Mean squared or robust distance between points, in world units, to which invalid points add nothing.

    The sum over the valid points is divided by the number of all points, valid or not. So when a point becomes invalid,
    its own term goes, and neither the terms nor the gradients of the others change.

    Args:
        loss: a robust loss such as `dp.Huber(5.0)`, its scale in world units (in pixels with `resolution`); squared
            distances if left out.

    Raises:
        TypeError: `loss` is not a robust loss (`diffproj.calibration.losses.Loss`).

    Example:
        >>> points = torch.tensor([[3.0, 4.0, 0.0], [9.0, 9.0, 9.0]])
        >>> PlaneLoss()(points, torch.zeros(2, 3), torch.tensor([True, False]))
        tensor(12.5000)
    """

    def __init__(self, loss: Loss | None = None) -> None:
        super().__init__()
        if loss is not None and not isinstance(loss, Loss):
            raise TypeError(f"loss: want one such as dp.Huber(5.0), got {type(loss).__name__}")
        self.loss = loss

    def forward(
        self,
        points: Float[Tensor, "*batch n 3"],
        target: Float[Tensor, "*#batch n 3"],
        valid: Bool[Tensor, "*#batch n"] | None = None,
        weights: Float[Tensor, "*#batch n"] | None = None,
        resolution: Float[Tensor, "*#batch n"] | None = None,
    ) -> Float[Tensor, ""]:
        """The loss, a tensor without axes, in squared world units (in squared pixels with `resolution`).

        Args:
            points: `(*B, N, 3)`, in world units.
            target: where they should be; it broadcasts to `points`.
            valid: which points count `(*B, N)`; all if left out. Points that do not count may be NaN or infinite.
            weights: a factor for each point `(*B, N)`; 1 if left out.
            resolution: world units per pixel at each point `(*B, N)`, as `ground_resolution` gives it: distances are
                divided by it, so that far points, which one pixel moves further, count as much as near ones. No
                gradient flows through it.

        Without points the loss is 0.

        Raises:
            TypeError: points, target, weights or resolution that are no floating-point tensors, or a mask that is not
                boolean.
            ValueError: points or target without three coordinates, or something that does not broadcast to the points.
        """
        points, target = check_tensor("points", points, "N", 3), check_tensor("target", target, "N", 3)
        _check_fits("target", target, points.shape)
        counts = torch.ones_like(points[..., 0], dtype=torch.bool) if valid is None else valid
        if counts.dtype != torch.bool:
            raise TypeError(f"valid: want booleans, got {counts.dtype}")
        for name, tensor in (("valid", counts), ("weights", weights), ("resolution", resolution)):
            if tensor is not None:
                _check_fits(name, tensor, points.shape[:-1])
        off = torch.where(counts.unsqueeze(-1), points - target.to(points), 0.0)
        if resolution is not None:
            off = off / torch.where(counts, resolution, 1.0).detach().unsqueeze(-1).to(off)
        value = off.square().sum(-1)
        value = value if self.loss is None else self.loss.value(value)
        if weights is not None:
            value = value * torch.where(counts, weights, 0.0).to(value)
        return value.sum() / max(value.numel(), 1)


def _check_fits(name: str, tensor: Tensor, shape: Sequence[int]) -> None:
    """Check that a tensor broadcasts to a shape, along its last axis only from one number for all.

    Raises:
        ValueError: it does not, or would stretch the points.
    """
    whole = tensor.ndim < 1 or tensor.shape[-1] == shape[-1]
    behind = tensor.shape[::-1]
    if not whole or len(behind) > len(shape) or any(a not in (1, b) for a, b in zip(behind, shape[::-1], strict=False)):
        raise ValueError(f"{name}: want a shape that broadcasts to {tuple(shape)}, got {tuple(tensor.shape)}")
