"""Which measurements have errors in common, so far as it can be seen from them.

What was found once is off in the same way wherever it is used: numbers that are equal to the last bit, and uncertain,
are one estimate. So photographs of one calibration share its intrinsics, also where a fleet holds it, a file brought it
back, or a focal length was adjusted afterwards; frames of a camera that stands still share its pose; the cameras of a
rig share all that was calibrated with it; and cameras that were found by the same uncertain landmarks share those.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from diffproj.calibration.problem.parametrisation import POSE, Parametrisation
from diffproj.measurement.measurement import Measurement


def sharing(found: Sequence[Measurement], batch: Sequence[int]) -> Tensor:
    """For each measurement how many have errors in common with it, itself among them, `(*B, C)`."""
    counts = []
    for one in found:
        common = [torch.as_tensor(_share(one, other), device=one.points.device).expand(tuple(batch)) for other in found]
        counts.append(torch.stack(common).sum(0))
    return torch.stack(counts, dim=-1)


def _share(one: Measurement, other: Measurement) -> Tensor | bool:
    """Whether both have errors in common, in each element of the batch."""
    a, b = one._sight, other._sight
    if one is other or a.landmarks & b.landmarks:
        return True
    if one.includes_intrinsics and other.includes_intrinsics and a.rig is not None and a.rig == b.rig:
        return True
    if not (a.by_theta.shape[-1] and b.by_theta.shape[-1]):
        return False  # cameras without a covariance are exact
    ours, theirs = _intrinsics(one), _intrinsics(other)
    count = min(len(ours), len(theirs)) if type(a.camera.distortion) is type(b.camera.distortion) else 4
    found = torch.zeros((), dtype=torch.bool, device=one.points.device)
    for (x, its), (y, of_other) in zip(ours[:count], theirs[:count], strict=True):
        found = found | ((x == y) & (its > 0) & (of_other > 0))
    stands = (a.camera.R == b.camera.R).all(-1).all(-1) & (a.camera.t == b.camera.t).all(-1)
    return found | (stands & _pose_variance(one) & _pose_variance(other))


def _intrinsics(one: Measurement) -> list[tuple[Tensor, Tensor]]:
    """Focal lengths, principal point and lens, each `(*B,)` with its variance."""
    camera = one._sight.camera
    values = Parametrisation.of(camera).pack(camera).detach().unbind(-1)
    return list(zip(values, _variances(one).unbind(-1)[:-POSE], strict=False))


def _pose_variance(one: Measurement) -> Tensor:
    """Whether the pose is uncertain `(*B,)`."""
    return (_variances(one)[..., -POSE:] > 0).any(-1)


def _variances(one: Measurement) -> Tensor:
    """Of all parameters of the camera and of its pose `(*B, q)`."""
    return one._noise.sigma.detach().diagonal(dim1=-2, dim2=-1)[..., : one._sight.by_theta.shape[-1]]
