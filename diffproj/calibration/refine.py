"""`refine`: a camera that is known roughly, refined on the corners of a target; differentiable if asked."""

from dataclasses import replace
from functools import partial
from typing import Unpack

from kornia.geometry.camera import PinholeCamera

from diffproj._core.arguments import flag
from diffproj.calibration.circle_centres import with_true_centres
from diffproj.calibration.fitting import start
from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.free_points import with_free_points
from diffproj.calibration.fitting.implicit import check_differentiable, differentiated
from diffproj.calibration.fitting.options import CalibrationOptions, calibration_options
from diffproj.calibration.other_starts import lowest, with_rivals
from diffproj.calibration.outcome import begun, outcome
from diffproj.calibration.results.calibration import Calibration
from diffproj.geometry.camera import Camera, as_camera
from diffproj.targets.target import Target
from diffproj.targets.views import Views


def refine(
    views: Views,
    target: Target,
    camera: Camera | PinholeCamera,
    *,
    differentiable: bool = False,
    **options: Unpack[CalibrationOptions],
) -> Calibration:
    """Refine a camera on the corners of a target.

    Few corners have several minima. Where up to 40 corners of up to four views hardly outnumber the unknowns, lie
    nearly on a line or are explained badly, other poses and focal lengths are started from, too, and the lowest minimum
    is taken, which mostly takes 10 to 200 ms a camera. A remark tells of one nearly as likely. Not so where the camera
    brings poses, with the objective `"plane"`, or with fewer than 40 `max_iterations`.

    Args:
        views: corners `(*B, V, N, 2)`.
        target: a board, `Landmarks`, or anything with `.points (N, 3)`.
        camera: the start: its lens says which lens is fitted, and fixed parameters keep its values. With a batch shape
            that broadcasts to `*B`, poses are found from the corners; with another that broadcasts to `(*B, V)`, its
            poses are the start, and its intrinsics are those of the first view. Where its image is turned, the camera
            that is turned itself is fitted, which sees the same (`Camera.upright`).
        differentiable: carry gradients through the minimum: those of cameras and the target's shape by the views'
            pixels, the target's points, the weights and tensors among the priors are those of the minimiser (implicit
            function theorem, exact Hessian). To first order, and `create_graph=True` is warned of. What is known of
            points, by priors or as the sigma of landmarks, needs `pixel_sigma` then, so that the minimum is that of one
            cost. Gradients by the camera's own values, too, where these hold or weigh: what `fixed` keeps, the ratio of
            tied focal lengths, skew that is not fitted, and what priors without a mean are about; elsewhere they are
            only a start, and have none. Skew of 0 that is not fitted stays 0, and has none either. Not by a landmark's
            sigma.
        options: as in `calibrate`: see `CalibrationOptions`.

    Returns:
        The calibration, in float64.

    Raises:
        TypeError: views are no `dp.Views`, the camera has a lens of another library, or an option is unknown.
        ValueError: views, target, camera and options do not fit together, the image is turned against a tilted
            sensor, or a minimum whose cost depends on itself is to be differentiated.
        CalibrationError: a camera did not converge, or its views do not determine it.

    Example:
        >>> import torch, diffproj as dp
        >>> views, board = dp.example_views("left"), dp.Chessboard()
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
        >>> rough = dp.Camera(K, distortion=dp.BrownConrady(torch.zeros(5, dtype=torch.float64)), size=(640, 480))
        >>> print(f"{dp.refine(views, board, rough).rms:.3f}")
        0.158
    """
    if isinstance(views, Camera | PinholeCamera):
        raise TypeError("refine: want (views, target, camera) in this order, got the camera first")
    if isinstance(camera, Calibration):
        raise TypeError(
            "camera: want dp.Camera, got Calibration; "
            "give calibration.camera, or calibration.cameras to start from its poses"
        )
    differentiable = flag("differentiable", differentiable)
    chosen = calibration_options("refine", options)
    beginning = as_camera(camera)

    def fit(views: Views) -> Calibration:
        data = Data(views, target, chosen.weights, chosen.pixel_sigma)
        data.check_options(chosen.objective, chosen.shape, (*chosen.fixed, *(chosen.priors or ())))
        if differentiable:
            check_differentiable(data, chosen)
        own, local, parameters = start.from_camera(beginning, data, chosen.bow, chosen.skew)
        own = own if differentiable else own.detach()
        begin = begun(data, chosen, parameters, own.detach(), local, own)
        posed = not start.broadcasts(beginning.batch_shape, tuple(data.batch))
        found, rivals = (begin.minimum(chosen), None) if posed else lowest(begin, chosen)
        found, prior = with_free_points(found, data, chosen, begin.prior)
        if differentiable:
            found = differentiated(found, data, prior, chosen, own)
        refined = outcome("refine", data, found, beginning.size or views.size, chosen.throw)
        said = refined._remarks
        if rivals is None or said is None or found.task.free:
            return refined
        return replace(refined, _remarks=partial(with_rivals, said, found.solution.shared.detach()[:, 0], rivals))

    return with_true_centres(fit, views, target)
