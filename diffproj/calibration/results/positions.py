"""`Positions`: where the camera stood in each view, and how surely."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.copying import Copied
from diffproj._core.shown import Shown, counted, number
from diffproj.calibration.results.covariance import Covariance
from diffproj.geometry.camera import Camera


@dataclass(frozen=True, eq=False, repr=False)
class Positions(Copied, Shown):
    """Centres of projection in the world, one for each view.

    Attributes:
        points: `(*B, V, 3)` in world units.
        covariance: of each `(*B, V, 3, 3)`, infinite where the corners do not determine the pose.
        names: of the views.
    """

    points: Float[Tensor, "*batch v 3"]
    covariance: Float[Tensor, "*batch v 3 3"]
    names: tuple[str, ...] = ()

    @property
    def deviations(self) -> Float[Tensor, "*batch v 3"]:
        """Standard deviations of x, y and z `(*B, V, 3)` in world units."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()  # of what was held, rounding is left

    def to_dict(self) -> dict[str, list[Any]]:
        """The positions as columns of Python's own numbers, of many cameras one after the other, for `pandas`."""
        columns = zip("xyz", self.points.unbind(-1), self.deviations.unbind(-1), strict=True)
        found: dict[str, list[Any]] = {"view": list(self.names) * self.points.shape[:-2].numel()}
        for axis, values, spread in columns:
            found[axis] = values.detach().flatten().tolist()
            found[f"{axis}_deviation"] = spread.detach().flatten().tolist()
        return found

    def _facts(self) -> list[str]:
        worst = number(self.deviations.amax(-1), ".3g") if self.points.numel() else "?"
        return [counted(self.points.shape[:-1], "view"), f"largest deviation {worst}"]

    def _columns(self) -> dict[str, list[Any]]:
        return self.to_dict()


def positions(cameras: Camera, covariance: Covariance, names: tuple[str, ...]) -> Positions:
    """The centres of cameras at poses `(*B, V)`, with the covariance of these.

    With the pose about the target's middle m, the centre is `m - R^T t`, and a step `R <- exp(omega) R`, `t <- t + tau`
    moves it by `-R^T (t x omega + tau)`.
    """
    middle = torch.zeros_like(cameras.t[..., 0, :]) if covariance.middle is None else covariance.middle
    R = cameras.R
    # From the world's origin both terms may be far larger than their sum.
    t = cameras.t + (R @ middle.unsqueeze(-1)).squeeze(-1) if middle.ndim == 1 else cameras.t
    x, y, z = t.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    step = -R.mT @ torch.cat([cross, torch.eye(3, dtype=t.dtype, device=t.device).expand_as(cross)], dim=-1)
    known = covariance.about_middle.poses
    lost = known.diagonal(dim1=-2, dim2=-1).isinf().any(-1)[..., None, None]
    spread = step @ torch.where(lost, 0.0, known) @ step.mT
    infinite = torch.diag_embed(torch.full_like(t, torch.inf))
    return Positions(cameras.center, torch.where(lost, infinite, spread), names)
