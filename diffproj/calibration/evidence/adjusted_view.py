"""What `adjust` found from landmarks, as the calibration of the view that shows them."""

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj.calibration.evidence.adjustment import Adjustment
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.remark import Remarks
from diffproj.targets.landmarks import Landmarks
from diffproj.targets.views import Views


def of_view(
    adjusted: Adjustment, views: Views, landmarks: Landmarks, pixel_sigma: Float[Tensor, "..."] | float
) -> Calibration:
    """The same camera, pose and covariance with the view of landmarks that they were found from, among other evidence.

    Args:
        adjusted: of one camera.
        views: one view, `(1, N, 2)`.
        landmarks: the N that it shows.
        pixel_sigma: the deviation of their pixels that was counted with, a number or `(N,)`.
    """
    used = views.visible
    each = torch.as_tensor(pixel_sigma, dtype=torch.float64, device=views.device).expand(used.shape)
    return Calibration(
        adjusted.camera,
        adjusted.cameras,
        views.to(torch.float64),
        landmarks.points.detach().to(torch.float64),
        used,
        torch.zeros_like(used),
        adjusted.status,
        adjusted.iterations,
        causes=adjusted.causes,
        pixel_sigma=each[used].square().mean().sqrt(),
        degrees_of_freedom=torch.full_like(each[0, 0], torch.inf),
        skew=adjusted.skew,
        landmarks=landmarks.names,
        _covariance=partial(getattr, adjusted, "covariance"),
        _remarks=partial(_remarks, adjusted),
    )


def _remarks(adjusted: Adjustment) -> tuple[Remarks, ...]:
    """What residuals speak against, and how the camera stands to the landmarks."""
    return tuple((*one, *other) for one, other in zip(adjusted.contradictions, adjusted.findings, strict=True))
