"""`adjust`: where a camera is and how it looks, from any evidence, by least squares; differentiable if asked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.arguments import called, flag, listing, whole_number, words
from diffproj.calibration.adjustment import Adjustment, pose_covariance
from diffproj.calibration.constraints import Priors
from diffproj.calibration.covariance import Covariance, zero_where_infinite
from diffproj.calibration.evidence import Evidence, Losses, jacobian
from diffproj.calibration.knowledge import Knowledge, knowledge, prior_shapes
from diffproj.calibration.losses import check_loss
from diffproj.calibration.observation import Observation
from diffproj.calibration.observations import Seen
from diffproj.calibration.parametrisation import POSE
from diffproj.calibration.pose_parameters import PoseParameters
from diffproj.calibration.result import Calibration, CalibrationError
from diffproj.calibration.robust import robust_factors
from diffproj.calibration.search import starts
from diffproj.calibration.solver import Prior, Status, solve
from diffproj.calibration.undetermined import Lacking, described, inverse, natural, undetermined, units
from diffproj.geometry.camera import Camera, as_camera
from diffproj.targets.views import Views

NEGLIGIBLE = 1e-18
"""Cost, in squared deviations, that counts as zero: of evidence without noise."""
POOR = 9.0
"""Cost per spare residual from which on other starts are tried."""
RESTRAINT = 1e-8
"""Weight of the start on each parameter in its natural unit: so small that it decides only what nothing else does."""
HAIR = 1e-4
"""Cost of half a turn away from the camera's own direction, over 4."""
TRIED, FEW = 8, 8
"""How many of them are followed, for how many steps before the best is followed to its minimum."""


def adjust(
    camera: Camera | PinholeCamera | Calibration,
    observations: Sequence[Observation] | Observation = (),
    *,
    priors: Priors | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    tied_focal: bool = True,
    differentiable: bool = False,
    max_iterations: int = 100,
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
        fixed: names of the pose that keep the camera's values.
        free: intrinsics that are to be found too, such as `"focal"`. All others keep the camera's values.
        tied_focal: `f_x : f_y` keeps the camera's ratio where `focal` is free.
        differentiable: carry gradients through the minimum, those with respect to the observations' tensors, the
            camera's and those among the priors (implicit function theorem, exact Hessian). To first order.
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
        9.98 m ahead ± 0.44
    """
    known, calibration = camera, None
    if isinstance(camera, Calibration):
        calibration = camera
        known = camera.cameras[..., 0] if isinstance(camera, Adjustment) else camera.camera
    start = as_camera(known).upright()  # type: ignore[arg-type]
    given = (observations,) if isinstance(observations, Observation) else listing("observations", observations, _WANT)
    pieces = tuple(_checked(one) for one in given)
    fixed, free = words("fixed", fixed, "several names"), words("free", free, "several names")
    tied, through = flag("tied_focal", tied_focal), flag("differentiable", differentiable)
    steps = whole_number("max_iterations", max_iterations, "a whole number of steps", least=0)
    throw = flag("throw", throw)
    start = start.to(torch.float64)
    known_of = knowledge(start, priors, fixed, free, tied)
    batch = _batch(start, pieces, known_of)
    task = _Task(pieces, start.expand(*batch), batch, known_of)
    with torch.no_grad():
        found = _best(task, steps)
    return _outcome(task, found, calibration, through, throw)


_WANT = "observations such as [dp.Seen(landmarks, pixels), dp.Horizon(pixels)]"


@dataclass(frozen=True)
class _Task:
    """What is to be found of P cameras of batch shape `*B`.

    Attributes:
        pieces: the observations.
        camera: the given one, with its graph.
        batch: `*B`.
        known: which parameters move, and what is known of them.
    """

    pieces: tuple[Observation, ...]
    camera: Camera
    batch: tuple[int, ...]
    known: Knowledge

    def own(self) -> Tensor:
        """The camera's values `(P, q)`, with their graph."""
        R = self.camera.R.reshape(-1, 3, 3)
        packed = self.known.parameters(R).pack(self.camera)
        return packed.reshape(-1, packed.shape[-1])

    def evidence(
        self, parameters: PoseParameters, more: tuple[int, ...] = (), columns: Sequence[int] | None = None
    ) -> Evidence:
        """The problem, with an axis of starts in front of the batch."""
        columns = self.known.columns if columns is None else columns
        return Evidence(self.pieces, parameters, (*more, *self.batch), self.camera.size, tuple(columns))


@dataclass(frozen=True)
class _Found:
    """Where the solver ended.

    Attributes:
        parameters: with the rotations that turns are about.
        basis: of the directions in which they move `(P, q, r)`.
        prior: on the parameters.
        values: `(P, q)`.
        status: `(P,)`.
        iterations: `(P,)`.
        cost: `(P,)`.
    """

    parameters: PoseParameters
    basis: Tensor
    prior: Prior
    values: Tensor
    status: Tensor
    iterations: Tensor
    cost: Tensor


def _checked(observation: object) -> Observation:
    if isinstance(observation, type) or not isinstance(observation, Observation):
        raise TypeError(f"observations: want {_WANT}, got {called(observation)}")
    check_loss(getattr(observation, "loss", None))
    return observation


def _batch(camera: Camera, pieces: Sequence[Observation], known: Knowledge) -> tuple[int, ...]:
    shapes = [camera.batch_shape, *prior_shapes(known)]
    with torch.no_grad():
        for piece in pieces:
            found = piece.residuals(camera)
            if not isinstance(found, Tensor) or found.ndim < 2 or not found.is_floating_point():
                name = type(piece).__name__
                raise ValueError(f"{name}.residuals: want a tensor (*B, M, k) of numbers, got {called(found)}")
            shapes.append(found.shape[:-2])
    try:
        return tuple(torch.broadcast_shapes(*shapes))
    except RuntimeError:
        listed = ", ".join(str(tuple(shape)) for shape in shapes)
        raise ValueError(f"batch shapes of camera, priors and observations do not broadcast: {listed}") from None


def _best(task: _Task, steps: int) -> _Found:
    """The minimum from the camera's own pose; where it explains little, the best from other poses too."""
    own, R = task.own(), task.camera.R.reshape(-1, 3, 3)
    prior = task.known.prior(own, task.batch)
    begin = task.known.begin(own, prior)
    found = _descended(task, R, begin, prior, (), steps)
    if not task.pieces or steps == 0:
        return found
    spare = _spare(task, found)
    poor = (found.status == Status.DIVERGED) | ~(2 * found.cost <= POOR * spare.clamp(min=1))
    if not bool(poor.any()):
        return found
    camera = task.known.parameters(R).unpack(begin, (len(begin),), task.camera.size)
    rotations, values = starts(task.pieces, task.known, camera, begin, task.batch)
    K, P = values.shape[:2]
    flat = rotations.flatten(0, 1)
    blocks = task.evidence(task.known.parameters(flat), (K,), ()).residuals(values.flatten(0, 1))
    cost = blocks.square().sum(-1).log1p().sum(-1).reshape(K, P).nan_to_num(torch.inf, torch.inf)  # mild on outliers
    first = task.known.parameters(R).rotation(begin)
    rows = (cost + _away(rotations, first)).topk(min(TRIED, K), dim=0, largest=False).indices
    k, each = len(rows), torch.arange(P, device=rows.device)
    many = Prior(*(part.expand(k, *part.shape).flatten(0, 1) for part in prior[:2]))
    near = _descended(task, rotations[rows, each].flatten(0, 1), values[rows, each].flatten(0, 1), many, (k,), FEW)
    away = _away(near.parameters.rotation(near.values), first.repeat(k, 1, 1))
    chosen = (near.cost + away).nan_to_num(torch.inf).reshape(k, P).argmin(0) * P + each
    R = R if near.parameters.start is None else near.parameters.start[chosen]
    other = _descended(task, R, near.values[chosen], prior, (), steps)
    ends = [torch.where(one.status == Status.CONVERGED, one.cost, torch.inf) for one in (other, found)]
    better = poor & (ends[0] < ends[1])
    start = None
    if found.parameters.start is not None and other.parameters.start is not None:
        start = torch.where(better[:, None, None], other.parameters.start, found.parameters.start)
    parts = {
        name: torch.where(better.reshape(-1, *(1,) * (old.ndim - 1)), getattr(other, name), old)
        for name, old in ((name, getattr(found, name)) for name in _STATE)
    }
    return replace(found, parameters=replace(found.parameters, start=start), **parts)


def _away(R: Tensor, first: Tensor) -> Tensor:
    """A hair of cost for turns from the camera's own direction: of poses that explain as much, the nearer one."""
    return HAIR * (3 - (R * first).sum((-2, -1)))


_STATE = ("values", "status", "iterations", "cost")


def _descended(task: _Task, R: Tensor, begin: Tensor, prior: Prior, more: tuple[int, ...], steps: int) -> _Found:
    parameters = task.known.parameters(R)
    evidence = task.evidence(parameters, more)
    basis = task.known.basis(begin)
    losses = [getattr(piece, "loss", None) for piece in task.pieces]
    loss = None
    if any(one is not None for one in losses):
        counts = [block.shape[1] for block in evidence.blocks(begin)]
        loss = Losses(tuple(zip(counts, losses, strict=True)))
    found = solve(
        evidence,
        begin,
        (),
        local_size=0,
        loss=loss,
        prior=_restrained(task, begin, prior),
        basis=basis,
        max_iterations=steps,
        negligible=NEGLIGIBLE,
    )
    return _Found(parameters, basis, prior, found.shared, found.status, found.iterations, found.cost)


def _restrained(task: _Task, begin: Tensor, prior: Prior) -> Prior:
    """The prior with a hair's weight on what nothing tells, which then stays where it began."""
    own = prior.precision.diagonal(dim1=-2, dim2=-1)
    hair = RESTRAINT * natural(begin, _reach(task, begin)).square().reciprocal()
    mean = torch.where(own > 0, prior.mean, begin)
    return Prior(mean, torch.diag_embed(torch.where(own > 0, own, hair)))


def _spare(task: _Task, found: _Found) -> Tensor:
    """How many more residuals and priors there are than unknowns `(P,)`."""
    blocks = task.evidence(found.parameters).blocks(found.values)
    seen = sum((block.detach() != 0).any(-1).sum(-1) * block.shape[-1] for block in blocks)
    known = (found.prior.precision.detach().diagonal(dim1=-2, dim2=-1) > 0).sum(-1)
    return seen + known - found.basis.shape[-1]


def _outcome(
    task: _Task, found: _Found, calibration: Calibration | None, differentiable: bool, throw: bool
) -> Adjustment:
    batch = task.batch

    def shaped(tensor: Tensor) -> Tensor:
        return tensor.reshape((*batch, *tensor.shape[1:]))

    with torch.no_grad():
        covariance, names = _covariance(task, found, calibration)
        parts = tuple(shaped(block) for block in task.evidence(found.parameters).blocks(found.values))
        spare = _spare(task, found)
    lacking = torch.tensor([bool(each.names) for each in names], device=found.status.device)
    status = torch.where(lacking & (found.status != Status.DIVERGED), Status.DEGENERATE, found.status)
    causes = tuple(
        described(each) if each.names and code == Status.DEGENERATE else ""
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
        spare=shaped(spare),
        cost=shaped(found.cost),
        unknown=tuple(each.names for each in names),
    )
    if throw and bool((status != Status.CONVERGED).any()):
        raise CalibrationError(f"adjust: {adjusted.message}", adjusted)
    return adjusted


def _same(covariance: Covariance) -> Covariance:
    return covariance


def _covariance(task: _Task, found: _Found, calibration: Calibration | None) -> tuple[Covariance, list[Lacking]]:
    """The covariance of intrinsics and pose, and what nothing tells of each camera."""
    parameters, values, T = found.parameters, found.values, found.basis
    s, P = parameters.camera.size, len(values)
    known = None
    if calibration is not None and calibration.has_covariance:
        known = calibration.covariance_of_kept_poses.shared[..., :s, :s]
        known = zero_where_infinite(known).expand(*task.batch, s, s).reshape(P, s, s)
    columns = sorted({*task.known.columns, *(range(s) if known is not None else ())})
    H, M = _normal_matrices(task, found, columns)
    precision = found.prior.precision.detach()
    scale = natural(values, _reach(task, values))
    Hr, lost, vectors = inverse(T.mT @ (H + precision) @ T, units(T, scale))
    C = T @ Hr @ (T.mT @ (M + precision) @ T) @ Hr @ T.mT
    if known is not None:
        # Intrinsics that are held err as the calibration says, and what is found follows them.
        held = torch.tensor([at not in task.known.columns for at in range(s)], device=values.device).to(values)
        follow = torch.nn.functional.pad(torch.diag(held), (0, 0, 0, POSE)) - T @ Hr @ (T.mT @ H[..., :s] * held)
        C = C + follow @ known @ follow.mT
    unknown, names = undetermined(parameters, values, T, scale, lost, vectors)
    names = [
        each if code != Status.DIVERGED else Lacking() for each, code in zip(names, found.status.tolist(), strict=True)
    ]
    camera = parameters.unpack(values, (P,), None)
    middle = camera.center.mean(0)
    R = camera.R

    def pose(step: Tensor) -> Tensor:
        again = parameters.unpack(torch.cat([values[:, :-POSE], values[:, -POSE:] + step], dim=-1), (P,), None)
        turn = again.R @ R.mT
        omega = torch.stack(
            [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], -1
        )
        return torch.cat([omega / 2, (again.R @ (middle - again.center).unsqueeze(-1)).squeeze(-1)], dim=-1)

    J = jacobian(pose, values.new_zeros(P, POSE))[1].permute(1, 2, 0)
    to_pose = torch.eye(values.shape[-1], dtype=values.dtype, device=values.device).repeat(P, 1, 1)
    to_pose[:, -POSE:, -POSE:] = J
    C = to_pose @ C @ to_pose.mT
    lacking = torch.cat([unknown[:, :s], unknown[:, s:].any(-1, keepdim=True)], dim=-1)
    gone = torch.cat([lacking[:, :s], lacking[:, s:].expand(-1, POSE)], dim=-1)
    C = torch.where(gone.unsqueeze(-1) | gone.unsqueeze(-2), 0.0, C)
    batch = task.batch
    joint, arm, lacking = (
        part.reshape((*batch, *part.shape[1:]))
        for part in ((C + C.mT) / 2, (R @ middle.unsqueeze(-1)).squeeze(-1), lacking)
    )
    return pose_covariance(parameters.camera.names, joint, arm, middle, lacking), names


def _normal_matrices(task: _Task, found: _Found, columns: Sequence[int]) -> tuple[Tensor, Tensor]:
    """`H` and `M` of all parameters `(P, q, q)` without the priors: see `robust.py`."""
    evidence = task.evidence(found.parameters, (), columns)
    P, q = found.values.shape
    H = found.values.new_zeros(P, q, q)
    if not task.pieces:
        return H, H
    value, slopes = evidence.along(found.values)
    rows = value.new_zeros(P, q, *value.shape[1:])
    rows[:, list(columns)] = slopes.movedim(0, 1)
    M, start = H, 0
    for piece, block in zip(task.pieces, evidence.blocks(found.values), strict=True):
        count = block.shape[1]
        part = rows[:, :, start : start + count].flatten(-2)
        a, b = robust_factors(getattr(piece, "loss", None), block)
        gram = part @ part.mT
        H, M, start = H + a[:, None, None] * gram, M + b[:, None, None] * gram, start + count
    sound = H.isfinite().all(-1).all(-1)[:, None, None]
    return torch.where(sound, H, 0.0), torch.where(sound, M, 0.0)


def _reach(task: _Task, values: Tensor) -> Tensor:
    """The distance of what was seen `(P,)`: of surveyed points, else the height of the camera."""
    center = values[:, -3:]
    seen = [piece.points.detach().to(center) for piece in task.pieces if isinstance(piece, Seen)]
    height = center[:, 2].abs().clamp(min=1e-9)
    if not seen:
        return height
    return (torch.cat(seen) - center.unsqueeze(1)).norm(dim=-1).median(-1).values.maximum(1e-3 * height)


def differentiated(task: _Task, found: _Found) -> Tensor:
    """The values `(P, q)` with their derivatives by everything that carries a graph: see `implicit.py`."""
    T, solution = found.basis, found.values.detach()
    with torch.enable_grad():
        own = task.own()
        moving = torch.zeros(own.shape[-1], dtype=torch.bool, device=own.device)
        moving[list(task.known.columns)] = True
        base = torch.where(moving, solution, own)
        prior = task.known.prior(own, task.batch)
        theta = solution.new_zeros(len(solution), T.shape[-1], requires_grad=True)
        values = base + (T @ theta.unsqueeze(-1)).squeeze(-1)
        off = values - torch.where(prior.precision.diagonal(dim1=-2, dim2=-1) > 0, prior.mean, values.detach())
        cost = (off.unsqueeze(-2) @ prior.precision @ off.unsqueeze(-1)).flatten() / 2
        for piece, block in zip(task.pieces, task.evidence(found.parameters).blocks(values), strict=True):
            squared, loss = block.square().sum(-1), getattr(piece, "loss", None)
            cost = cost + (squared if loss is None else loss.value(squared)).sum(-1) / 2
        gradient = torch.autograd.grad(cost.sum(), theta, create_graph=True)[0]
        rows = [torch.autograd.grad(part.sum(), theta, retain_graph=True)[0] for part in gradient.unbind(-1)]
        step = -torch.linalg.solve_ex(torch.stack(rows, dim=-2).detach(), gradient.unsqueeze(-1))[0]
        return base + (T @ (step - step.detach())).squeeze(-1)
