"""`adjust`: where a camera is and how it looks, from any evidence, by least squares; differentiable if asked."""

from collections.abc import Sequence
from functools import partial
from typing import TypeVar

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.arguments import called, flag, listing, whole_number, words
from diffproj._core.copying import ordinary, with_ordinary
from diffproj._core.numerics import check_untransformed
from diffproj.calibration.evidence.adjusted_covariance import covariance_of
from diffproj.calibration.evidence.adjustment import Adjustment
from diffproj.calibration.evidence.best import best
from diffproj.calibration.evidence.descent import Found, Task, differentiated, spare
from diffproj.calibration.evidence.knowledge import Knowledge, knowledge, prior_shapes
from diffproj.calibration.evidence.observation import Observation
from diffproj.calibration.evidence.observations import Seen
from diffproj.calibration.evidence.pose_parameters import PLACE
from diffproj.calibration.evidence.rivals import Rivals
from diffproj.calibration.evidence.undetermined import described
from diffproj.calibration.least_squares.losses import check_loss
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.constraints import Priors
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.calibration.results.remark import Kind, Remark, Remarks
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.float32 import looks_at_rounding, warn_of_rounding
from diffproj.targets.views import Views

T = TypeVar("T")

UPRIGHT = 0.2
"""Cosine between z and up in the photograph from which on a camera below landmarks may look at a ceiling."""
LEVEL = 0.1
"""Relief of landmarks, as a part of their extent, below which they lie on a ground; below a facade one stands anyway,
also with the camera on its side."""
BELOW = "the camera is below all landmarks and not upright"
WHY_BELOW = (
    "are x and y exchanged, has one of them the wrong sign, or do pixels count from another corner? z is up, as with x "
    "east and y north"
)
"""What is said of a camera that sees level ground from below."""


def adjust(
    camera: Camera | PinholeCamera | Calibration,
    observations: Sequence[Observation] | Observation = (),
    *,
    priors: Priors | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    tied_focal: bool = True,
    differentiable: bool = False,
    max_iterations: int = 300,
    throw: bool = True,
) -> Adjustment:
    """Find a camera's pose, and what is free of its intrinsics, from any evidence: a least-squares adjustment.

    The world is that of `Camera.mounted`: z up, the ground z = 0; heights over it, tilt, roll and heading in degrees.
    Without observations the priors alone are the evidence: a mounted camera with deviations.

    Args:
        camera: the start, of batch shape `*B`, such as `Camera.mounted(...)`; a calibration, whose covariance of the
            intrinsics goes along. Its pose may be far off, where observations tell a better one.
        observations: `Seen` landmarks, `Horizon`, `Heights`, `Lengths`, `VanishingPoints`, `Coplanar`, or an
            `Observation` of your own; their batch shapes broadcast.
        priors: what is known beforehand, by name: a standard deviation about the camera's own value, or a tuple `(mean,
            standard deviation)`; numbers or tensors `(*B,)`. Names are `height`, `tilt`, `roll`, `heading`, `position`
            (`x` and `y`), `focal`, `principal_point`, `distortion`, `f_x`, `k1` and so on; `turn_x`, `turn_y` and
            `turn_z` are degrees about the camera's own axes in the place of the three angles. What has a prior is free.
            A camera that looks straight down may lean beyond the vertical: as `Camera.mounting` has it, its tilt then
            folds back below 90, and roll and heading, be they known, are told half a turn further.
        fixed: names of the pose that keep the camera's values.
        free: intrinsics that are to be found too, such as `"focal"`. All others keep the camera's values.
        tied_focal: `f_x : f_y` keeps the camera's ratio where `focal` is free.
        differentiable: carry gradients through the minimum, those with respect to the observations' tensors, the
            camera's and those among the priors (implicit function theorem, exact Hessian). To first order, and
            `create_graph=True` is warned of.
        max_iterations: of the solver.
        throw: raise where a camera did not converge, or the evidence does not determine it; if False, look at `status`.

    Returns:
        The camera with its covariance, in float64: `measure` takes it, with a `pixel_sigma`.

    Raises:
        TypeError: no camera, no observations, or an argument of the wrong kind.
        ValueError: an unknown name, values that cannot be, or shapes that do not fit.
        CalibrationError: the evidence does not determine the camera, and the message says what is missing; or the
            solver did not converge.

    Example:
        >>> import diffproj as dp
        >>> mast = dp.Camera.mounted(2.18, 14.0, focal=800.0, size=(640, 480))
        >>> known = dp.adjust(mast, priors={"height": 0.02, "tilt": 0.5}, fixed=("roll", "heading", "position"))
        >>> ahead = dp.measure([[320.0, 216.2]], known, dp.Plane.z(0.0), pixel_sigma=1.0)
        >>> print("{:.2f} m ahead ± {:.2f}".format(ahead.points[0, 1], ahead.deviations[0, 1]))
        9.97 m ahead ± 0.43
    """
    check_untransformed(
        "adjust",
        "cameras of a batch are adjusted side by side, and differentiable=True carries gradients for "
        "torch.autograd.grad",
    )
    with torch.inference_mode(False):  # which has no derivatives
        known, calibration = camera, None
        if isinstance(camera, Calibration):
            calibration = camera
            known = camera.cameras[..., 0] if isinstance(camera, Adjustment) else camera.camera
        start = ordinary(as_camera(known).upright())  # type: ignore[arg-type]
        given = (
            (observations,) if isinstance(observations, Observation) else listing("observations", observations, _WANT)
        )
        pieces = tuple(_checked(one) for one in given)
        fixed, free = words("fixed", fixed, "several names"), words("free", free, "several names")
        tied, through = flag("tied_focal", tied_focal), flag("differentiable", differentiable)
        steps = whole_number("max_iterations", max_iterations, "a whole number of steps", least=0)
        throw = flag("throw", throw)
        if 0 in start.batch_shape:
            raise ValueError(f"camera: want at least one, got batch shape {tuple(start.batch_shape)}")
        given, start = start, start.to(torch.float64)
        known_of = knowledge(start, priors, fixed, free, tied)
        if {"mounting", "position", *PLACE} & {*fixed, *(priors or ())} and looks_at_rounding(given.t):
            center = given.detach().center
            warn_of_rounding(center.norm(dim=-1), center[..., 2].abs())
        batch = _batch(start, pieces, known_of)
        task = Task(pieces, start.expand(*batch), batch, known_of)
        with torch.no_grad():
            found = best(task, steps)
        return _outcome(task, found, calibration, through, throw)


_WANT = "observations such as [dp.Seen(landmarks, pixels), dp.Horizon(pixels)]"


def _checked(observation: object) -> Observation:
    residuals = getattr(observation, "residuals", None)
    if isinstance(observation, type) or not isinstance(observation, Observation) or not callable(residuals):
        raise TypeError(f"observations: want {_WANT}, got {called(observation)}")
    check_loss(getattr(observation, "loss", None))
    return with_ordinary(observation)


def _batch(camera: Camera, pieces: Sequence[Observation], known: Knowledge) -> tuple[int, ...]:
    shapes = [camera.batch_shape, *prior_shapes(known)]
    parameters = known.parameters(camera.R.detach().reshape(-1, 3, 3))
    with torch.enable_grad():
        values = parameters.pack(camera.detach()).reshape(-1, len(parameters.names)).requires_grad_()
        moving = parameters.unpack(values, camera.batch_shape, camera.size)
        for piece in pieces:
            found, name = _residuals(piece, moving), type(piece).__name__
            if not isinstance(found, Tensor) or found.ndim < 2 or not found.is_floating_point():
                raise ValueError(f"{name}.residuals: want a tensor (*B, M, k) of numbers, got {called(found)}")
            if moving.K.requires_grad and not found.requires_grad and bool((found != 0).any()):
                raise ValueError(
                    f"{name}.residuals: want numbers that follow from the camera by PyTorch's functions, got a tensor "
                    "without a gradient, which tells nothing of the camera: no NumPy, float(), .item() or .detach() on "
                    "the way, torch.where in the place of if, and 0 where there is no observation"
                )
            shapes.append(found.shape[:-2])
    try:
        batch = tuple(torch.broadcast_shapes(*shapes))
    except RuntimeError:
        listed = ", ".join(str(tuple(shape)) for shape in shapes)
        raise ValueError(f"batch shapes of camera, priors and observations do not broadcast: {listed}") from None
    if 0 in batch:
        raise ValueError(f"priors, observations: want them of at least one camera, got batch shape {batch}")
    return batch


def _residuals(piece: Observation, camera: Camera) -> Tensor:
    try:
        return piece.residuals(camera)
    except RuntimeError as error:
        if "nference tensor" not in str(error):
            raise
        raise ValueError(
            f"{type(piece).__name__}.residuals: want tensors with derivatives, got some made in inference_mode, "
            "which have none: make its tensors outside of inference_mode, or clone() them in residuals"
        ) from error


def _outcome(
    task: Task, found: Found, calibration: Calibration | None, differentiable: bool, throw: bool
) -> Adjustment:
    batch = task.batch

    def shaped(tensor: Tensor) -> Tensor:
        return tensor.reshape((*batch, *tensor.shape[1:]))

    with torch.no_grad():
        covariance, names = covariance_of(task, found, calibration)
        parts = tuple(shaped(block) for block in task.evidence(found.parameters).blocks(found.values))
        left = spare(task, found)
    lacking = torch.tensor([bool(each.names) for each in names], device=found.status.device)
    status = torch.where(lacking & (found.status != Status.DIVERGED), Status.DEGENERATE, found.status)
    parameters = found.parameters.names
    said = {parameters[at] for known in task.known.priors for at in known.where}
    causes = tuple(
        described(each, said) if each.names and code == Status.DEGENERATE else ""
        for each, code in zip(names, status.tolist(), strict=True)
    )
    values = differentiated(task, found) if differentiable else found.values
    camera = found.parameters.unpack(values, batch, task.camera.size)
    posed = camera[..., None] if batch else Camera.stack([camera])
    views = Views.unchecked(
        values.new_zeros(*batch, 1, 0, 2),
        torch.zeros(*batch, 1, 0, dtype=torch.bool, device=values.device),
        ("camera",),
        camera.size,
    )
    rivals = None if found.rival is None else Rivals.of(*found.rival, batch)
    known = covariance.shared.diagonal(dim1=-2, dim2=-1)
    others = None if rivals is None or bool((known != 0).any()) else rivals.as_other_poses(posed)
    adjusted = Adjustment(
        camera.without_pose(),
        posed,
        views,
        values.new_zeros(0, 3),
        views.visible,
        views.visible,
        shaped(status),
        shaped(found.iterations),
        causes=causes,
        skew=found.parameters.camera.skew,
        _covariance=partial(_same, covariance),
        observations=task.pieces,
        parts=parts,
        spare=shaped(left),
        cost=shaped(found.cost),
        unknown=tuple(each.names for each in names),
        rivals=rivals,
        _others=None if others is None else partial(_same, others),
        _remarks=partial(_from_below, posed, task.pieces, shaped(status)),
    )
    if throw and bool((status != Status.CONVERGED).any()):
        raise CalibrationError(f"adjust: {adjusted.message}", adjusted)
    return adjusted


def _from_below(posed: Camera, pieces: Sequence[Observation], status: Tensor) -> tuple[Remarks, ...]:
    """For each camera a remark where it stands below level ground, and not upright, as where x and y are exchanged."""
    seen = [piece.points.detach() for piece in pieces if isinstance(piece, Seen)]
    center, R = posed.center.detach().reshape(-1, 3), posed.R.detach().reshape(-1, 3, 3)
    if not seen:
        return ((),) * len(center)
    low, high = torch.cat(seen).to(center).aminmax(dim=0)
    extent = high - low
    below = (center[:, 2] < low[2]) & (extent[2] < LEVEL * extent[:2].amax())
    wrong = below & (-R[:, 1, 2] < UPRIGHT) & (status.flatten() == Status.CONVERGED)
    said = Remark(f"{BELOW}: {WHY_BELOW}", Kind.BELOW, BELOW)
    return tuple((said,) if each else () for each in wrong.tolist())


def _same(found: T) -> T:
    return found
