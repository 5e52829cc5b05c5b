"""`CalibrationPrior`: how firmly a calibration holds a camera where it found it."""

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor, nn

from diffproj._core.numerics import in_float64
from diffproj.calibration.parametrisation import Parametrisation
from diffproj.calibration.result import Calibration
from diffproj.geometry.camera import Camera, as_camera


class CalibrationPrior(nn.Module):
    """How far a camera has moved from its calibration, in the calibration's own deviations: `1/2 d^T C^-1 d`.

    Added to a loss that is a negative log-likelihood, it makes the calibration's data count along with the new.

    Args:
        calibration: of one camera, with its covariance.
        view: the view whose pose counts as well; none if left out.

    Raises:
        ValueError: many cameras, or a calibration without covariance.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> prior = CalibrationPrior(calibration, view=0)
        >>> prior(calibration.cameras[0]).item()
        0.0
    """

    center: Tensor
    precision: Tensor
    R_0: Tensor

    def __init__(self, calibration: Calibration, view: int | None = None) -> None:
        super().__init__()
        if calibration.views.batch_shape or not calibration.has_covariance:
            raise ValueError("calibration: want one camera with its covariance, as calibrate gives it")
        camera = calibration.camera if view is None else calibration.cameras[view]
        known = calibration.covariance
        C = known.shared if view is None else known.view(view)
        bows = [i for i, name in enumerate(known.names) if name.startswith("bow")]
        kept = [i for i in range(len(C)) if i not in bows and bool(C[i, i].isfinite()) and float(C[i, i]) > 0]
        C = C[kept][:, kept].detach()
        scale = C.diagonal().rsqrt()
        inverse = torch.linalg.inv(C * scale * scale.unsqueeze(-1)) * scale * scale.unsqueeze(-1)
        size = len(known.shared) - len(bows) + (0 if view is None else 6)
        where = torch.tensor([i - sum(b < i for b in bows) for i in kept])
        precision = C.new_zeros(size, size)
        precision[where.unsqueeze(-1), where] = inverse
        self.posed = view is not None
        self.register_buffer("R_0", in_float64(camera.R.detach()).clone())
        self.register_buffer("center", self._vector(camera.detach()).clone())
        self.register_buffer("precision", precision)

    def forward(self, camera: Camera | PinholeCamera) -> Float[Tensor, "*batch"]:
        """`1/2 d^T C^-1 d` of a camera of batch shape `*B`, such as `projector.camera`; in float64."""
        off = self._vector(as_camera(camera)) - self.center
        return (off * (self.precision * off.unsqueeze(-2)).sum(-1)).sum(-1) / 2

    def _vector(self, camera: Camera) -> Tensor:
        parts = [in_float64(Parametrisation.of(camera).pack(camera))]
        if self.posed:
            turned = (in_float64(camera.R).unsqueeze(-3) * self.R_0.unsqueeze(-2)).sum(-1).mT  # R R_0^T
            omega = rotation_matrix_to_axis_angle(turned.reshape(-1, 3, 3)).reshape(*turned.shape[:-2], 3)
            parts += [omega, in_float64(camera.t)]
        return torch.cat([part.expand(*camera.batch_shape, part.shape[-1]) for part in parts], dim=-1)
