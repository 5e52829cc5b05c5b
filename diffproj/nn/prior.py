"""`CalibrationPrior`: how far a camera may move from its calibration, given the calibration's covariance."""

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import Tensor

from diffproj._core.numerics import in_float64
from diffproj._core.warn import warn_caller
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results.calibration import Calibration, as_calibration
from diffproj.geometry.camera import Camera, as_camera
from diffproj.lens.models import model_of
from diffproj.nn.partial import GeometryModule
from diffproj.targets.views import view_number

RANK_TOLERANCE = 1e-13
"""Eigenvalue of the correlation matrix at and below which it is rounding error. Measured on the bundled views with
every Brown-Conrady lens: at most 2e-15 along a tied direction, at least 5e-11 along any other."""


class CalibrationPrior(GeometryModule):
    """The negative log-likelihood of a camera under its calibration, `1/2 d^T C^-1 d`, up to a constant.

    `d` is how far the camera is from the calibrated one: focal lengths and principal point in pixels, the coefficients
    of the lens, and with `view` the pose, as rotation vector of `R R_0^T` and shift of the target's middle along the
    camera's axes. `C` is the covariance of these in the calibration. Added to a loss that is a negative log-likelihood
    itself, the prior makes the calibration's corners count along with the new data.

    Directions without a finite, positive variance add nothing, however far the camera moves along them: what the
    calibration held fixed, the ratio of focal lengths that it tied (`tied_focal=True`), and what the corners did not
    determine. To keep what was fixed, do not learn it.

    Pixels are those of the calibration's image: a camera of that image resized or cropped counts in others, and a
    warning says so.

    Everything is in float64, whatever the dtype of the network around it: the covariance of a lens is too close to
    singular for less.

    Args:
        calibration: of one camera, with its covariance.
        view: the number or the name of the view whose pose counts as well; none if left out.

    Raises:
        TypeError: it is no calibration, or the view neither a number nor a name.
        ValueError: more than one camera, a calibration without covariance, or no such view.

    Example:
        >>> import diffproj as dp
        >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
        >>> prior, start = CalibrationPrior(calibration, view=0), calibration.cameras[0]
        >>> prior(start).item(), prior(start.at(start.R, 1.01 * start.t)).item() > 10
        (0.0, True)
    """

    lowest_precision = torch.float64

    center: Tensor
    precision: Tensor
    R_0: Tensor
    middle: Tensor

    def __init__(self, calibration: Calibration, view: int | str | None = None) -> None:
        super().__init__()
        if as_calibration(calibration).views.batch_shape or not calibration.has_covariance:
            got = f"{tuple(calibration.views.batch_shape)} of them; index it" * bool(calibration.views.batch_shape)
            raise ValueError(
                f"calibration: want one camera with its covariance, as calibrate gives it, got {got or 'one without'}"
            )
        view = None if view is None else view_number(view, calibration.views.names)
        camera = (calibration.camera if view is None else calibration.cameras[view]).detach()
        known, parameters = calibration.covariance.about_middle, calibration.parameters.of_camera
        middle = calibration.covariance.middle
        C = (known.shared if view is None else known.view(view)).detach()
        # The rows of C are the camera's parameters, the target's shape, which is none of the camera's, and the pose.
        of_pose = range(len(known.names), len(known.names) + (0 if view is None else POSE))
        rows = torch.tensor([*range(parameters.size), *of_pose], device=C.device)
        self.parametrisation, self.with_pose, self.size = parameters, view is not None, camera.size
        self.register_buffer("R_0", in_float64(camera.R).clone())
        self.register_buffer("middle", torch.zeros_like(self.R_0[0]) if middle is None else middle.clone())
        self.register_buffer("center", self._vector(camera).clone())
        self.register_buffer("precision", _precision(in_float64(C[rows.unsqueeze(-1), rows])))

    def forward(self, camera: Camera | PinholeCamera) -> Float[Tensor, "*batch"]:
        """`1/2 d^T C^-1 d` of a camera of batch shape `*B`, such as `projector.camera`; `(*B,)` in float64.

        Args:
            camera: with the calibration's lens model and an upper triangular K, whose skew counts where the calibration
                has it.

        Raises:
            TypeError: not a camera, or one whose lens is of another package.
            ValueError: another lens model.
        """
        camera = as_camera(camera)
        lens, wanted = model_of(camera.distortion).name, self.parametrisation.lens
        if lens != wanted:
            raise ValueError(f"camera: want the calibration's lens model {wanted!r}, got {lens!r}")
        if camera.device != self.center.device:
            raise ValueError(f"camera: want device {self.center.device} as the prior has, got {camera.device}")
        own, its = self.size, camera.size
        if own is not None and its is not None and own != its and not torch.compiler.is_compiling():
            warn_caller(
                f"CalibrationPrior: the calibration's image has {own[0]} x {own[1]} px, and the camera's {its[0]} x "
                f"{its[1]}: where it was "
                "resized or cropped, its focal lengths and principal point are no more comparable; learn the camera of "
                "the calibration, and resize or crop what it gives"
            )
        off = self._vector(camera) - self.center
        return (off * (self.precision * off.unsqueeze(-2)).sum(-1)).sum(-1) / 2

    if TYPE_CHECKING:  # PyTorch types the call of a module as Any
        __call__ = forward

    def _vector(self, camera: Camera) -> Tensor:
        """The parameters of a camera `(*B, p)`: intrinsics and lens, with a pose its turn from R_0 and its place."""
        parts = [in_float64(self.parametrisation.pack(camera))]
        if self.with_pose:
            turn = (in_float64(camera.R).unsqueeze(-3) * self.R_0.unsqueeze(-2)).sum(-1).mT  # R R_0^T
            omega = rotation_matrix_to_axis_angle(turn.reshape(-1, 3, 3)).reshape(*turn.shape[:-2], 3)
            parts += [omega, in_float64(camera.t) + (in_float64(camera.R) * self.middle).sum(-1)]
        return torch.cat([part.expand(*camera.batch_shape, part.shape[-1]) for part in parts], dim=-1)


def _precision(C: Tensor) -> Tensor:
    """The inverse of a covariance `(p, p)` on the directions with a finite, positive variance, zero on the others."""
    variance = C.diagonal()
    determined = variance.isfinite() & (variance > 0)
    scale = torch.where(determined, variance, torch.inf).rsqrt()
    values, vectors = torch.linalg.eigh(torch.where(C.isfinite(), C, 0.0) * scale * scale.unsqueeze(-1))
    lost = values <= RANK_TOLERANCE
    inverse = (vectors * torch.where(lost, 0.0, torch.where(lost, 1.0, values).reciprocal())) @ vectors.mT
    return inverse * scale * scale.unsqueeze(-1)
