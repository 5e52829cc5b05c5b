"""`PlaneLoss`: a loss in world units over the points that are valid."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from diffproj._core.arguments import Array, booleans, number
from diffproj._core.numerics import check_tensor, has_values
from diffproj.calibration.least_squares.losses import Loss, check_loss


class CountedLoss(NamedTuple):
    """A loss, and how many points it was about.

    Attributes:
        loss: a tensor without axes.
        invalid: the number of points that were not valid, a tensor without axes.
        total: the number of all points.
    """

    loss: Float[Tensor, ""]
    invalid: Int[Tensor, ""]
    total: int


class PlaneLoss(nn.Module):
    """Mean squared or robust distance between points, in world units, to which invalid points add nothing.

    The sum over the valid points is divided by the number of all points, valid or not. So when a point becomes invalid,
    its own term goes, and neither the terms nor the gradients of the others change.

    A batch without a valid point would then look like a perfect one. With `pull`, each invalid point adds the angle by
    which its ray misses the plane (`PlaneProjector.miss`), whose gradient leads back to the plane; `counted` says how
    many points are not valid.

    Args:
        loss: a robust loss such as `dp.Huber(5.0)`, its scale in world units (in pixels with `resolution`); squared
            distances if left out.
        pull: what an invalid point adds for each radian by which its ray misses the plane, in the unit of the loss.

    Raises:
        TypeError: `loss` is not a robust loss (`diffproj.calibration.least_squares.losses.Loss`), or `pull` no number.
        ValueError: `pull` is negative or not finite.

    Example:
        >>> points = torch.tensor([[3.0, 4.0, 0.0], [9.0, 9.0, 9.0]])
        >>> PlaneLoss()(points, torch.zeros(2, 3), torch.tensor([True, False]))
        tensor(12.5000)
        >>> PlaneLoss(pull=8.0)(points, torch.zeros(2, 3), torch.tensor([True, False]), miss=torch.tensor([0.0, 0.5]))
        tensor(14.5000)
    """

    def __init__(self, loss: Loss | None = None, pull: float = 0.0) -> None:
        super().__init__()
        check_loss(loss)
        self.loss = loss
        self.pull = number("pull", pull, "a number that is not negative, of the loss for each radian", least=0)

    def forward(
        self,
        points: Float[Tensor, "*batch n 3"] | Array,
        target: Float[Tensor, "*#batch n 3"] | Array,
        valid: Bool[Tensor, "*#batch n"] | Array | None = None,
        weights: Float[Tensor, "*#batch n"] | Array | None = None,
        resolution: Float[Tensor, "*#batch n"] | Array | None = None,
        miss: Float[Tensor, "*#batch n"] | Array | None = None,
    ) -> Float[Tensor, ""]:
        """The loss, a tensor without axes, in squared world units (in squared pixels with `resolution`).

        Args:
            points: `(*B, N, 3)`, in world units.
            target: where they should be; it broadcasts to `points`.
            valid: which points count `(*B, N)`; all if left out. Points that do not count may be NaN or infinite.
            weights: a factor for each point `(*B, N)`, not negative; 1 if left out.
            resolution: world units per pixel at each point `(*B, N)`, positive, as `ground_resolution` gives it:
                distances are divided by it, so that far points, which one pixel moves further, count as much as near
                ones. No gradient flows through it.
            miss: the angles in radians by which rays miss the plane `(*B, N)`, as `PlaneProjector.miss` and
                `PlaneMap.miss` give them; needed with `pull`, and looked at where a point is not valid.

        Weights and resolution may be anything where a point does not count. Their values are checked on a CPU, outside
        of `torch.compile` and `vmap`; a GPU would have to be waited for.

        Without points the loss is 0.

        Raises:
            TypeError: points, target, weights or resolution that are no floating-point tensors, or a mask that is not
                boolean.
            ValueError: points or target without three coordinates, something that does not broadcast to the points, or
                weights or a resolution that cannot be, at a point that counts; or no `miss` for a loss that pulls.
        """
        return self.counted(points, target, valid, weights, resolution, miss).loss

    def counted(
        self,
        points: Float[Tensor, "*batch n 3"] | Array,
        target: Float[Tensor, "*#batch n 3"] | Array,
        valid: Bool[Tensor, "*#batch n"] | Array | None = None,
        weights: Float[Tensor, "*#batch n"] | Array | None = None,
        resolution: Float[Tensor, "*#batch n"] | Array | None = None,
        miss: Float[Tensor, "*#batch n"] | Array | None = None,
    ) -> CountedLoss:
        """The loss, and how many points are not valid; arguments as for the call.

        Example:
            >>> points = torch.zeros(4, 3)
            >>> PlaneLoss().counted(points, points, torch.tensor([True, False, False, True]))
            CountedLoss(loss=tensor(0.), invalid=tensor(2), total=4)
        """
        points = check_tensor("points", points, "N", 3, like=target if isinstance(target, Tensor) else None)
        target = _fitting("target", check_tensor("target", target, "N", 3, like=points), points, points.shape)
        each = points.shape[:-1]
        if valid is None:
            counts = torch.ones_like(points[..., 0], dtype=torch.bool)
        else:
            counts = _fitting("valid", booleans("valid", valid, points.device), points, each)
        off = torch.where(counts.unsqueeze(-1), points - target.to(points), 0.0)
        if resolution is not None:
            resolution = _fitting("resolution", check_tensor("resolution", resolution, like=points), points, each)
            resolution = torch.where(counts, resolution, 1.0).detach()
            _check_values("resolution", resolution, math.ulp(0.0), "positive finite numbers")
            off = off / resolution.unsqueeze(-1).to(off)
        value = off.square().sum(-1)
        value = value if self.loss is None else self.loss.value(value)
        if weights is not None:
            weights = _fitting("weights", check_tensor("weights", weights, like=points), points, each)
            weights = torch.where(counts, weights, 0.0)
            _check_values("weights", weights, 0.0, "finite numbers that are not negative")
            value = value * weights.to(value)
        if self.pull:
            if miss is None:
                raise ValueError("miss: want angles (*B, N) for a loss that pulls, got None; projector.miss(pixels)")
            miss = _fitting("miss", check_tensor("miss", miss, like=points), points, each)
            value = value + self.pull * torch.where(counts, 0.0, miss.to(value))
        total = value.numel()
        return CountedLoss(value.sum() / max(total, 1), (~counts).expand(each).sum(), total)

    if TYPE_CHECKING:  # PyTorch types the call of a module as Any
        __call__ = forward


def _fitting(name: str, tensor: Tensor, points: Tensor, shape: Sequence[int]) -> Tensor:
    """A tensor on the points' device that broadcasts to a shape, along its last axis only from one number for all.

    Raises:
        ValueError: it does not, or would stretch the points; or it is elsewhere.
    """
    if tensor.shape != shape:
        whole = tensor.ndim < 1 or tensor.shape[-1] == shape[-1]
        behind, want = tensor.shape[::-1], shape[::-1]
        if not whole or len(behind) > len(want) or any(a not in (1, b) for a, b in zip(behind, want, strict=False)):
            got = tuple(tensor.shape)
            raise ValueError(f"{name}: want a shape that broadcasts to {tuple(shape)} as points has, got {got}")
    if tensor.device != points.device:
        raise ValueError(f"{name}: want device {points.device} as points has, got {tensor.device}")
    return tensor


def _check_values(name: str, values: Tensor, least: float, want: str) -> None:
    """That values lie between `least` and infinity.

    Raises:
        ValueError: some do not.
    """
    if values.device.type != "cpu" or not values.numel() or not has_values(values):
        return
    low, high = (float(limit) for limit in values.detach().aminmax())
    if not (low >= least and high < math.inf):
        got = low if not low >= least else high
        raise ValueError(f"{name}: want {want} at the points that count, got {got:g}; `valid` leaves points out")
