"""`Mismatch`: how far the corners of a located view are from what the calibration behind it expects, and what is said.

The wrong camera file, another zoom or focus, and a photograph that was turned or mirrored all give a pose, and error
bars that look as good as ever. What tells is that the corners do not lie where that camera would see them.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

MAX_NAMES = 5
"""Names of views in a message."""


class CameraMismatchWarning(UserWarning):
    """The corners of a photograph do not lie where the calibrated camera sees them: is it that camera's?"""


class CameraDisagreementWarning(UserWarning):
    """Cameras that measured the same points disagree by more than their deviations explain."""


class Mismatch(NamedTuple):
    """Located views against the calibration that they were located with.

    Attributes:
        ratio: the residuals of a view, in times those of the calibration `(*B, V)`: about 1 if all is well. Each is a
            root mean square over degrees of freedom. Of a camera of which nothing else is known, in times what other
            intrinsics would leave, NaN where there is no doubt.
        doubtful: whether that is no chance, and none of what the calibration leaves open `(*B, V)`.
        scale: the factor on deviations that makes the residuals of a doubtful view usual ones `(*B, V)`; 1 for others.
    """

    ratio: Tensor
    doubtful: Tensor
    scale: Tensor


def described(found: Mismatch, names: tuple[str, ...], calibrated: bool = True) -> str:
    """What is to be said of the doubtful views, in a sentence; empty where there are none.

    `calibrated` is whether they were compared with a calibration, and not with a camera alone.
    """
    which = found.doubtful.nonzero().tolist()
    if not which:
        return ""
    ratios = [float(found.ratio[tuple(place)]) for place in which]
    named = [f"{names[view]}{f' of camera {tuple(camera)}' * bool(camera)}" for *camera, view in which]
    listed = [f"{name} ({_times(ratio)})" for name, ratio in zip(named[:MAX_NAMES], ratios, strict=False)]
    more = f" and {len(which) - MAX_NAMES} more views" if len(which) > MAX_NAMES else ""
    usual = "the calibration's" if calibrated else "what other intrinsics would leave"
    told = (
        f"the residuals of {named[0]} are {_times(ratios[0])} {usual}"
        if len(which) == 1
        else f"the residuals of {', '.join(listed)}{more} exceed {usual}"
    )
    if calibrated:
        return f"{told}: another camera, zoom or focus, or a resized, turned, mirrored or blurred photograph?"
    return (
        f"{told}: are K and lens those of this camera, zoom and focus, in pixels of photographs of this size, are "
        "these neither turned, cropped nor undistorted, and are all points of the target right?"
    )


def _times(ratio: float) -> str:
    if ratio >= 1000:
        return "1000 times and more"
    return f"{ratio:.1f} times" if ratio < 10 else f"{ratio:.0f} times"


def none_at_all(used: Bool[Tensor, "*batch v n"]) -> Mismatch:
    """Where nothing is known to compare with."""
    unknown = torch.full_like(used.any(-1), torch.nan, dtype=torch.float64)
    return Mismatch(unknown, torch.zeros_like(used.any(-1)), torch.ones_like(unknown))
