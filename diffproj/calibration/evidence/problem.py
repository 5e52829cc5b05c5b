"""`Evidence`: observations of P cameras as a problem of the solver, with all derivatives by autograd."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffproj._core.arguments import called
from diffproj._core.copying import ordinary
from diffproj.calibration.evidence.observation import Observation
from diffproj.calibration.evidence.pose_parameters import PoseParameters
from diffproj.calibration.least_squares.losses import Loss
from diffproj.calibration.least_squares.solver import LocalState


def jacobian(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """Values `(P, ...)` of P functions of q numbers each, and their derivatives `(q, P, ...)`.

    The derivative of `v . J` by v, in reverse mode twice: forward mode has one state for the whole process.
    """
    with torch.inference_mode(False), torch.enable_grad():
        at = ordinary(at.detach()).requires_grad_()
        value = function(at)
        if value.grad_fn is None or value.numel() == 0:
            return value.detach(), value.detach().new_zeros(at.shape[-1], *value.shape)
        v = torch.zeros_like(value, requires_grad=True)
        (pulled,) = torch.autograd.grad(value, at, v, create_graph=True)
        if not pulled.requires_grad:
            return value.detach(), value.detach().new_zeros(at.shape[-1], *value.shape)
        slopes = [torch.autograd.grad(each.sum(), v, retain_graph=True)[0] for each in pulled.unbind(-1)]
    return value.detach(), torch.stack(slopes) if slopes else value.detach().new_zeros(0, *value.shape)


@dataclass(frozen=True)
class Evidence:
    """The residuals of some observations as the solver asks for them, all cameras in one batch.

    Attributes:
        observations: what was seen.
        parameters: of the cameras.
        batch: the shape of the P cameras.
        size: of their images.
        columns: the parameters by which derivatives are asked; they are 0 by the others.
    """

    observations: Sequence[Observation]
    parameters: PoseParameters
    batch: tuple[int, ...]
    size: tuple[int, int] | None
    columns: tuple[int, ...]

    def blocks(self, values: Tensor) -> list[Tensor]:
        """The residuals of each observation `(P, M, k)`."""
        camera = self.parameters.unpack(values, self.batch, self.size)
        P = len(values)
        return [found.reshape(P, *found.shape[-2:]) for found in (self._asked(o, camera) for o in self.observations)]

    def _asked(self, observation: Observation, camera: object) -> Tensor:
        found = observation.residuals(camera)  # type: ignore[arg-type]
        if isinstance(found, Tensor) and found.ndim >= 2 and found.is_floating_point():
            try:
                return found.to(torch.float64).expand(*self.batch, *found.shape[-2:])
            except RuntimeError:
                pass
        raise ValueError(
            f"{type(observation).__name__}.residuals: want a tensor (*B, M, k) for cameras of batch shape "
            f"{self.batch}, got {called(found)}"
        )

    def residuals(self, values: Tensor) -> Tensor:
        """All of them together `(P, N, k)`, 0 where an observation has fewer components."""
        blocks = self.blocks(values)
        k = max((block.shape[-1] for block in blocks), default=1)
        padded = [torch.nn.functional.pad(block, (0, k - block.shape[-1])) for block in blocks]
        return torch.cat(padded, dim=1) if padded else values.new_zeros(len(values), 0, k)

    def along(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals `(P, N, k)` and their derivatives by the columns `(len(columns), P, N, k)`."""
        rows = torch.eye(values.shape[-1], dtype=values.dtype, device=values.device)[list(self.columns)]
        start = values.new_zeros(len(values), len(self.columns))
        return jacobian(lambda step: self.residuals(values + step @ rows), start)

    def linearise(self, shared: Tensor, local: LocalState) -> Tensor:  # noqa: ARG002
        """See `solver.Problem`; one block without unknowns of its own."""
        value, slopes = self.along(shared)
        P, N, k = value.shape
        panel = value.new_zeros(P, 1, shared.shape[-1] + 1, k, N)
        panel[:, 0, list(self.columns)] = slopes.permute(1, 0, 3, 2)
        panel[:, 0, -1] = value.mT
        return panel

    def retract(self, local: LocalState, step: Tensor) -> LocalState:  # noqa: ARG002
        """See `solver.Problem`."""
        return local


@dataclass(frozen=True)
class Losses:
    """The losses of several observations as one, for residuals `(..., N)` in their order.

    Attributes:
        parts: how many items each has, and its loss.
    """

    parts: tuple[tuple[int, Loss | None], ...]

    def value(self, squared: Tensor) -> Tensor:
        """See `Loss`."""
        found = squared.split([count for count, _ in self.parts], dim=-1)
        return torch.cat(
            [e2 if loss is None else loss.value(e2) for e2, (_, loss) in zip(found, self.parts, strict=True)], -1
        )

    def weight(self, squared: Tensor) -> Tensor:
        """See `Loss`."""
        found = squared.split([count for count, _ in self.parts], dim=-1)
        weights = (
            torch.ones_like(e2) if loss is None else loss.weight(e2)
            for e2, (_, loss) in zip(found, self.parts, strict=True)
        )
        return torch.cat(list(weights), dim=-1)
