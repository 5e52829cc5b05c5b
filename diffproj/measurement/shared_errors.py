"""Which measurements have errors in common, so far as it can be seen from them.

What was found once is off in the same way wherever it is used: numbers that are equal to the last bit, and uncertain,
are one estimate. So photographs of one calibration share its intrinsics, also where a fleet holds it, a file brought it
back, or a focal length was adjusted afterwards; frames of a camera that stands still share its pose; the cameras of a
rig share all that was calibrated with it; and cameras that were found by the same uncertain landmarks share those.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.problem.parametrisation import POSE, Parametrisation
from diffproj.measurement.measurement import Measurement


class _Estimates(NamedTuple):
    """What a measurement knows of its camera, and how surely.

    Attributes:
        intrinsics: focal lengths, principal point and lens, each `(*B,)` with its variance.
        pose: R `(*B, 3, 3)` and t `(*B, 3)`.
        unsure: whether the pose is uncertain `(*B,)`.
        lens: the kind of lens.
    """

    intrinsics: list[tuple[Tensor, Tensor]]
    pose: tuple[Tensor, Tensor]
    unsure: Tensor
    lens: type

    @classmethod
    def of(cls, one: Measurement) -> "_Estimates | None":
        """Those of a measurement; `None` where the camera counts as exact."""
        camera, q = one._sight.camera, one._sight.by_theta.shape[-1]
        if q == 0:
            return None
        variances = one._noise.sigma.detach().diagonal(dim1=-2, dim2=-1)[..., :q]
        values = Parametrisation.of(camera).pack(camera).detach().unbind(-1)
        intrinsics = list(zip(values, variances.unbind(-1)[:-POSE], strict=False))
        pose = camera.R.detach(), camera.t.detach()
        return cls(intrinsics, pose, (variances[..., -POSE:] > 0).any(-1), type(camera.distortion))


def sharing(found: Sequence[Measurement], batch: Sequence[int]) -> Tensor:
    """For each measurement how many have errors in common with it, itself among them, `(*B, C)`."""
    known = [_Estimates.of(one) for one in found]
    device = found[0].points.device

    def common(first: int, second: int) -> Tensor:
        one, other = found[first], found[second]
        same = one is other or _of_one_source(one, other) or _alike(known[first], known[second])
        return torch.as_tensor(same, device=device).expand(tuple(batch))

    each = range(len(found))
    return torch.stack([torch.stack([common(one, other) for other in each]).sum(0) for one in each], dim=-1)


def _of_one_source(one: Measurement, other: Measurement) -> bool:
    """Whether both were found by the same uncertain landmarks, or with one rig."""
    a, b = one._sight, other._sight
    same_rig = a.rig is not None and a.rig == b.rig
    return bool(a.landmarks & b.landmarks) or (same_rig and one.includes_intrinsics and other.includes_intrinsics)


def _alike(ours: _Estimates | None, theirs: _Estimates | None) -> Tensor | bool:
    """Whether an uncertain number of both is the same, or the pose, in each element of the batch."""
    if ours is None or theirs is None:
        return False
    count = min(len(ours.intrinsics), len(theirs.intrinsics)) if ours.lens is theirs.lens else 4
    (R, t), (S, s) = ours.pose, theirs.pose
    found = (R == S).all(-1).all(-1) & (t == s).all(-1) & ours.unsure & theirs.unsure
    for (x, spread), (y, other) in zip(ours.intrinsics[:count], theirs.intrinsics[:count], strict=True):
        found = found | ((x == y) & (spread > 0) & (other > 0))
    return found
