"""How doubtful a pose is of which there are two: the other pose, the odds, and what they add to the error bars.

Seen from afar, a plane has two poses that explain its corners, some ten degrees apart (Schweighofer and Pinz 2006). The
one that fits better is kept. That it is the right one has the probability `ratio / (1 + ratio)`, with the ratio of
likelihoods of the two. Where the noise is known, that is `exp((S2 - S1) / 2 sigma^2)`, with S the sums of squared
residuals; where it is estimated from n degrees of freedom, sigma is averaged over, which gives

    ratio = (1 + (S2 - S1) / (n sigma^2)) ^ (n / 2)

so that few corners claim no more than they know. Under a robust loss some corners may be wrong: the likelihood of each
is then Student's of few degrees of freedom. Either pose has an error bar of its own, which tells nothing of the other:
with p the other's probability and d the step that leads to it, the mean square of the kept pose's error is

    C + p d d^T
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor

from diffproj.calibration.problem.parametrisation import Pose
from diffproj.calibration.results.covariance import Covariance

SURE = 100.0
"""Ratio of likelihoods from which on the kept pose counts as certain: below it, its chance to be wrong exceeds 1 %."""
MAX_NAMES = 10
"""Names of ambiguous views in a message."""


class AmbiguousPoseWarning(UserWarning):
    """The corners of a view fit two poses about equally well, so that the one kept may be the wrong one.

    Example:
        Where a doubtful pose is of no use, turn it into an error.

        >>> import warnings
        >>> with warnings.catch_warnings():
        ...     warnings.simplefilter("error", AmbiguousPoseWarning)  # ... and locate(...) here
    """


@dataclass(frozen=True, eq=False)
class OtherPoses:
    """The other pose of each view.

    Attributes:
        R, t: `(*B, V, 3, 3)` and `(*B, V, 3)`; the kept pose where there is no other.
        ratio: of the likelihoods of the kept pose and of the other `(*B, V)`; infinite where there is none. At least 1,
            but after `adjust`, which keeps the pose that it was led to unless the other is much likelier.
    """

    R: Float[Tensor, "*batch v 3 3"]
    t: Float[Tensor, "*batch v 3"]
    ratio: Float[Tensor, "*batch v"]

    @property
    def probability(self) -> Float[Tensor, "*batch v"]:
        """That the other pose is the right one `(*B, V)`."""
        return 1 / (1 + self.ratio)


def difference(kept: Pose, other: Pose, middle: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 6"]:
    """The step `(omega, tau)` of a pose that leads to another `(*B, 6)`, for points around the target's middle.

    The turn is not small, so the points that it takes along are chosen: the middle goes where the other pose has it.
    """
    (R, t), (S, s) = kept, other
    turn = S @ R.mT
    omega = rotation_matrix_to_axis_angle(turn.reshape(-1, 3, 3)).reshape(t.shape)
    here = (R @ middle.unsqueeze(-1)).squeeze(-1)
    there = (S @ middle.unsqueeze(-1)).squeeze(-1)
    return torch.cat([omega, there + s - here - t - torch.linalg.cross(omega, here)], dim=-1)


def widened(covariance: Covariance, kept: Pose, others: OtherPoses, middle: Tensor) -> Covariance:
    """The covariance with the doubt between the two poses of each view in it."""
    about = torch.zeros_like(middle) if covariance.middle is None else covariance.middle  # what its poses turn about
    one, other = ((R.detach(), t.detach() + R.detach() @ about) for R, t in (kept, (others.R, others.t)))
    step = difference(one, other, middle.detach() - about) * others.probability.sqrt().unsqueeze(-1)
    return replace(covariance, _alone=covariance._alone + step.unsqueeze(-1) * step.unsqueeze(-2))


def described(ambiguous: Bool[Tensor, "*batch v"], names: tuple[str, ...]) -> str:
    """Which views are ambiguous, in words; empty where none is."""
    doubtful = [
        f"{names[view]}{f' of camera {tuple(camera)}' * bool(camera)}" for *camera, view in ambiguous.nonzero().tolist()
    ]
    if not doubtful:
        return ""
    more = f" and {len(doubtful) - MAX_NAMES} more views" if len(doubtful) > MAX_NAMES else ""
    return f"two poses fit {', '.join(doubtful[:MAX_NAMES])}{more}, and the one that was kept may be the wrong one"
