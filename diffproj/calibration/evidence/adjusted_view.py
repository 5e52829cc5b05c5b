"""What `adjust` found from landmarks, as the calibration of the view that shows them."""

from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj.calibration.evidence.adjustment import Adjustment
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.remark import Kind, Remark, Remarks
from diffproj.calibration.results.source import told_of_intrinsics
from diffproj.targets.exif import Told
from diffproj.targets.landmarks import Landmarks
from diffproj.targets.one_camera import of_another_camera
from diffproj.targets.views import Views


def of_view(
    adjusted: Adjustment,
    views: Views,
    landmarks: Landmarks,
    pixel_sigma: Float[Tensor, "..."] | float,
    calibration: Calibration | None = None,
    *,
    held: bool = False,
) -> Calibration:
    """The same camera, pose and covariance with the view of landmarks that they were found from, among other evidence.

    Args:
        adjusted: of one camera.
        views: one view, `(1, N, 2)`.
        landmarks: the N that it shows.
        pixel_sigma: the deviation of their pixels that was counted with, a number or `(N,)`.
        calibration: whose camera it is, if any, with its covariance.
        held: whether all intrinsics are those of the calibration.
    """
    used = views.visible
    before = () if calibration is None else told_of_intrinsics(calibration)
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
        lens_region=calibration.region if held and calibration is not None else None,
        calibrated_on=before if held else None,
        _covariance=partial(getattr, adjusted, "covariance_of_kept_poses"),
        _others=adjusted._others,
        _remarks=partial(_remarks, adjusted, views, before),
    )


def _remarks(adjusted: Adjustment, views: Views, before: Sequence[Told]) -> tuple[Remarks, ...]:
    """What files and residuals speak against, another pose, and how the camera stands to the landmarks."""
    apart = of_another_camera(before, views.names, views.told)
    files = (Remark(apart, Kind.TOLD_APART, apart),) if apart else ()
    return ((*files, *adjusted.contradictions[0], *adjusted.rival_remarks, *adjusted.findings[0]),)
