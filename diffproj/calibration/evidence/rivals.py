"""`Rivals`: the pose that explains the evidence of `adjust` second best."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.batched import index_batch
from diffproj.calibration.results.ambiguity import OtherPoses
from diffproj.geometry.camera import Camera
from diffproj.geometry.mounting import mounting_from_rotation

BEHIND = (0, 0, 0, 0, 0, 2, 1)
"""How many axes the tensors of `Rivals` have behind those of the batch."""


class Rivals(NamedTuple):
    """The pose of each camera that explains its evidence second best, with batch shape `*B`.

    Attributes:
        ratio: how many times more likely the pose is that was kept; infinite where there is no other.
        height: of the camera in the other pose.
        tilt: there, in degrees.
        roll: there, in degrees.
        heading: there, in degrees.
        R: from the world there `(*B, 3, 3)`.
        t: there `(*B, 3)`.
    """

    ratio: Float[Tensor, "*batch"]
    height: Float[Tensor, "*batch"]
    tilt: Float[Tensor, "*batch"]
    roll: Float[Tensor, "*batch"]
    heading: Float[Tensor, "*batch"]
    R: Float[Tensor, "*batch 3 3"]
    t: Float[Tensor, "*batch 3"]

    @classmethod
    def of(cls, above: Tensor, R: Tensor, place: Tensor, batch: tuple[int, ...]) -> "Rivals":
        """Of poses `(P, 3, 3)` at places `(P, 3)` that cost so much more `(P,)`."""
        R, place = R.detach(), place.detach()
        tilt, roll, heading = mounting_from_rotation(R)
        t = -(R @ place.unsqueeze(-1)).squeeze(-1)
        parts = above.detach().exp(), place[:, 2], tilt, roll, heading, R, t
        return cls(*(part.reshape((*batch, *part.shape[1:])) for part in parts))

    def as_other_poses(self, kept: Camera) -> OtherPoses:
        """The same as the other poses of one view, where that was kept; with what is kept where there is no other."""
        none = self.ratio.isinf()
        R = torch.where(none[..., None, None], kept.R[..., 0, :, :].detach(), self.R)
        t = torch.where(none[..., None], kept.t[..., 0, :].detach(), self.t)
        return OtherPoses(R.unsqueeze(-3), t.unsqueeze(-2), self.ratio.unsqueeze(-1))

    def chosen(self, index: Any) -> "Rivals":
        """Those of some cameras of the batch."""
        return Rivals(*(index_batch(part, index, behind) for part, behind in zip(self, BEHIND, strict=True)))
