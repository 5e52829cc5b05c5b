"""The poses of views of which something is known: how the camera is mounted, for certain or with deviations.

Each view is adjusted from the target's points and from what is known, as `adjust` does it: the same names, the same
solver, the same covariance. It starts from the poses that the points alone tell, of which a plane has two, and from the
camera's own.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from diffproj._core.copying import ordinary, with_ordinary
from diffproj.calibration.evidence.adjusted_covariance import pose_errors
from diffproj.calibration.evidence.best import best
from diffproj.calibration.evidence.descent import Found, Task, descended, spare
from diffproj.calibration.evidence.knowledge import Knowledge, knowledge, prior_shapes
from diffproj.calibration.evidence.observations import Seen
from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.fit import MAX_REJECTION_ROUNDS, Fit, inliers
from diffproj.calibration.fitting.options import Options
from diffproj.calibration.fitting.surveyed import in_common, whitening
from diffproj.calibration.fitting.task import Task as Seeing
from diffproj.calibration.least_squares.solver import Solution, Status, equations_at
from diffproj.calibration.outcome import outcome
from diffproj.calibration.problem.constraints import Priors
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results.ambiguity import OtherPoses, difference
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.remark import Kind, Remark, Remarks
from diffproj.calibration.trust.noise import level, noise_of, own_noise
from diffproj.calibration.trust.other_poses import APART
from diffproj.geometry.camera import Camera

OTHER_STEPS = 30
"""Steps to the other pose of a view, which few that it is one need."""
CONTRADICTION = 1e-3
"""Probability below which residuals so large for the noise and the priors are no chance."""


def known_poses(
    data: Data,
    camera: Camera,
    alone: Calibration,
    calibration: Calibration | None,
    options: Options,
    fixed: Sequence[str],
    priors: Priors | None,
) -> Calibration:
    """The poses from points and knowledge.

    Args:
        data: the views.
        camera: whose intrinsics are held, upright, batch shape broadcasting to `*B`, at the pose of which the knowledge
            is.
        alone: the poses that the points alone tell.
        calibration: whose intrinsics they are, if any; its covariance goes along.
        options: those of `locate`.
        fixed: names of the pose that keep the camera's values.
        priors: on the pose, by name.

    Raises:
        TypeError: priors are no mapping, or hold no numbers.
        ValueError: names or values that cannot be, or options that do not go together.
        CalibrationError: a view did not converge.
    """
    batch = (*data.batch, len(data.views))
    if torch.is_inference_mode_enabled():  # which has no derivatives
        with torch.inference_mode(False):
            return known_poses(data, camera, alone, calibration, options, fixed, priors)
    camera = ordinary(camera.to(torch.float64))[..., None].expand(*batch).detach()
    known = _checked(data, camera, alone, options, fixed, priors)
    single = _single(data, known)

    def seen_by(used: Tensor) -> tuple[Seen, tuple[Found, ...], Fit]:
        piece = with_ordinary(_seen(data, used.reshape(*batch, -1)))
        ends = _ends(camera, alone, known, piece, options.max_iterations)
        return piece, ends, _fit(data, single, used, ends[0])

    used = single.used
    piece, ends, fit = seen_by(used)
    for _ in range(MAX_REJECTION_ROUNDS):
        if options.outlier_limit is None:
            break
        near = inliers(single, used, fit.solution, options.outlier_limit)
        kept = near & (near.sum(-1, keepdim=True) >= 4)
        if bool((kept == used).all()):
            break
        used = kept
        piece, ends, fit = seen_by(used)
    found = ends[0]
    whole = _joined(data, fit)
    plain = outcome("locate", data, whole, camera.size or data.views.size, throw=False, known=calibration)
    before = None if calibration is None else noise_of(calibration, data.batch)
    task = Task((piece,), camera, batch, known)
    phi = None if calibration is None or not calibration.has_covariance else calibration.covariance.dispersion
    scale = torch.ones_like(whole.solution.cost) if whole.knows_noise else level(whole, before).variance
    scale = scale if phi is None else scale * phi.expand(data.batch).reshape(-1)
    scale = scale.repeat_interleave(len(data.views))
    located = replace(
        plain,
        _covariance=partial(_covariance, data, whole, task, found, calibration, scale),
        _others=partial(_others, data, whole, ends),
        _remarks=partial(_remarks, data, task, found, plain),
        _mismatch=None,
    )
    if options.throw and bool((located.status != Status.CONVERGED).any()):
        raise CalibrationError(f"locate: {located.message}", located)
    return located


def _checked(
    data: Data, camera: Camera, alone: Calibration, options: Options, fixed: Sequence[str], priors: Priors | None
) -> Knowledge:
    # How steeply a camera without a pose looks, the corners tell.
    identity = torch.eye(3, dtype=camera.dtype, device=camera.device)
    bare = (identity == camera.R).all(-1).all(-1) & (camera.t == 0).all(-1)
    R = torch.where(bare[..., None, None], alone.cameras.R.detach().to(camera.R), camera.R)
    looking = Camera.unchecked(camera.K, R, camera.t, camera.distortion, camera.size)
    known = knowledge(looking, priors, fixed, (), tied_focal=True)
    few = known.camera.size
    names = {one.name: min(one.where) for one in known.priors}
    for name, first in names.items():
        if first < few:
            raise ValueError(
                f"priors: want names of the pose, got {name!r}, which locate holds; dp.refine finds it from views, and "
                "dp.adjust from any evidence"
            )
    said = [*fixed, *(one.name for one in known.priors if one.mean is None)]
    if said and bool(bare.any()):
        option = "fixed" if fixed else "priors"
        raise ValueError(
            f"{option}: want a camera at the pose that {said[0]!r} is of, such as dp.Camera.mounted(...) or "
            "camera.at(R, t), got one without a pose; or give priors={name: (mean, deviation)}"
        )
    if options.loss is not None:
        raise ValueError("loss: want none beside fixed and priors, got one; dp.adjust takes dp.Seen(..., loss=...)")
    if options.pixel_sigma is None and (known.priors or data.spread is not None):
        what = "priors" if known.priors else "landmarks with a sigma"
        raise ValueError(
            f"pixel_sigma: want the noise of the pixels beside {what}, for they weigh against it, got none"
        )
    for shape in prior_shapes(known):
        try:
            fits = torch.broadcast_shapes(shape, camera.batch_shape) == camera.batch_shape
        except RuntimeError:
            fits = False
        if not fits:
            raise ValueError(f"priors: want values that broadcast to {tuple(camera.batch_shape)}, got {tuple(shape)}")
    own = known.parameters(camera.R.reshape(-1, 3, 3)).pack(camera)
    return known.about(own.reshape(-1, own.shape[-1]), camera.batch_shape)


def _single(data: Data, known: Knowledge) -> Seeing:
    """Each view as a problem of its own."""
    lens = known.camera.lens
    told = POSE - len(known.columns) + len({at for one in known.priors for at in one.where})
    task = data.task(lens, skew=known.camera.skew, pose_known=told)
    parts = {
        name: None if (part := getattr(task, name)) is None else part.flatten(0, 1).unsqueeze(1)
        for name in ("pixels", "used", "weights")
    }
    return replace(task, **parts, basis=data.pixels.new_zeros(data.used[..., 0].numel(), known.camera.size, 0))


def _seen(data: Data, used: Tensor) -> Seen:
    pixels = torch.where(used.unsqueeze(-1), data.pixels.reshape(*used.shape, 2), torch.nan)
    sigma = pixels.new_tensor(1.0)
    if data.weights is not None:
        sigma = torch.where(used, data.weights.reshape(used.shape), 1.0).rsqrt()
    piece = Seen(data.given_points.detach(), pixels, pixel_sigma=sigma)
    if data.spread is not None:
        piece.covariances = data.target.covariances.detach().to(pixels)  # type: ignore[attr-defined]
    return piece


def _ends(
    camera: Camera,
    alone: Calibration,
    known: Knowledge,
    piece: Seen,
    steps: int,
) -> tuple[Found, ...]:
    """Where each start leads, the lowest first."""
    batch = camera.batch_shape
    task = Task((piece,), camera, batch, known)
    if known.angles or known.turns_freely:
        other = alone.has_alternatives and bool(alone.likelihood_ratio.isfinite().any())
        starts = [alone.cameras, *([alone.alternatives] if other else [])]
    else:
        starts = []
    own = task.own()
    held = [at for at in range(own.shape[-1]) if at not in known.columns]
    prior = known.prior(own, batch)
    angles = torch.zeros_like(own)
    if known.angles:
        angles[:, -POSE:-3] = (prior.precision.diagonal(dim1=-2, dim2=-1) > 0)[:, -POSE:-3].to(own)
    found = []
    for start in starts:
        start = Camera.unchecked(camera.K, start.R.to(camera.K), start.t.to(camera.K), camera.distortion, camera.size)
        start = ordinary(start)
        R = start.R.reshape(-1, 3, 3)
        begin = known.parameters(R).pack(start).reshape(own.shape)
        begin[:, held] = own[:, held]
        begin = torch.where(begin.isfinite(), begin, own)
        begin = begin + angles * 360 * ((prior.mean - begin) / 360).round()  # an angle is known to be near that
        found.append(descended(task, R, begin, prior, (), min(steps, OTHER_STEPS) if found else steps))
    if not found or bool((torch.stack([one.status for one in found]) != Status.CONVERGED).all(0).any()):
        found.append(best(task, steps))
    cost = torch.stack([torch.where(one.status == Status.CONVERGED, one.cost, torch.inf) for one in found])
    order = cost.argsort(0)
    return tuple(_chosen(found, row) for row in order)


def _chosen(found: Sequence[Found], which: Tensor) -> Found:
    """Of several ends for each camera that one `(P,)`."""
    each = torch.arange(len(which), device=which.device)

    def pick(name: str) -> Tensor:
        return torch.stack([getattr(one, name) for one in found])[which, each]

    first = found[0]
    start = None
    if first.parameters.start is not None:
        start = torch.stack([one.parameters.start for one in found])[which, each]  # type: ignore[arg-type]
    state = {name: pick(name) for name in ("values", "status", "iterations", "cost")}
    return replace(first, parameters=replace(first.parameters, start=start), **state)


def _poses(data: Data, found: Found) -> tuple[Tensor, Tensor]:
    """The poses of the own frame `(P, 3, 3)` and `(P, 3)`."""
    camera = found.parameters.unpack(found.values, (len(found.values),), None)
    return data.frame.pose(camera.R, camera.t)


def _fit(data: Data, single: Seeing, used: Tensor, found: Found) -> Fit:
    """What was found, as the fit of each view."""
    poses = tuple(z.unsqueeze(1) for z in _poses(data, found))
    shared = found.values[:, : found.parameters.camera.size]
    task = replace(single, used=used)
    if data.spread is not None:
        task = replace(task, whitening=whitening(task, shared, poses, torch.ones_like(shared[:, 0])))
    equations = equations_at(task.problem, shared, poses, POSE, task.weights)
    status = torch.where(used.any(-1).squeeze(1), found.status, Status.CONVERGED)
    return Fit(
        task, Solution(shared, poses, equations.c.sum(-1), status, found.iterations, equations), single.used & ~used
    )


def _joined(data: Data, fit: Fit) -> Fit:
    """The views of each camera together again."""
    shape = data.used.shape[:2]

    def together(part: Tensor) -> Tensor:
        return part.squeeze(1).unflatten(0, shape)

    task = fit.task
    parts = {name: None if (z := getattr(task, name)) is None else together(z) for name in ("used", "whitening")}
    few = data.pixels.new_zeros(shape[0], task.parameters.size, 0)
    whole = replace(task, pixels=data.pixels, weights=data.weights, basis=few, **parts)
    each = fit.solution
    equations = type(each.equations)(
        U=each.equations.U.unflatten(0, shape).sum(1),
        E=together(each.equations.E),
        W=together(each.equations.W),
        g=each.equations.g.unflatten(0, shape).sum(1),
        h=together(each.equations.h),
        c=each.equations.c.reshape(shape),
    )
    solution = Solution(
        each.shared.unflatten(0, shape)[:, 0],
        tuple(together(z) for z in each.local),
        each.cost.reshape(shape).sum(-1),
        each.status.reshape(shape).amax(-1),
        each.iterations.reshape(shape).amax(-1),
        equations,
    )
    return Fit(whole, solution, together(fit.rejected))


def _covariance(
    data: Data, whole: Fit, task: Task, found: Found, calibration: Calibration | None, scale: Tensor
) -> Covariance:
    s, batch = found.parameters.camera.size, tuple(data.batch)
    before = None if calibration is None or not calibration.has_covariance else calibration.covariance_of_kept_poses
    with torch.inference_mode(False), torch.no_grad():
        errors = pose_errors(task, found, data.middle, follows=before is not None, level=scale)
    V = len(data.views)

    def each(part: Tensor) -> Tensor:
        return part.reshape(*batch, V, *part.shape[1:])

    alone, follow = each(errors.own[:, s:, s:]), each(errors.follow[:, s:])
    shared = alone.new_zeros(*batch, s, s)
    common = in_common(
        whole.task,
        whole.solution.shared,
        whole.solution.local,
        errors.own[:, s:, s:].reshape(*whole.task.used.shape[:2], 6, 6),
    )
    lacking = each(errors.lacking[:, -1]) & data.used.any(-1).reshape(*batch, V)
    own = Covariance(
        found.parameters.camera.names,
        shared,
        torch.zeros_like(shared[..., 0], dtype=torch.bool),
        lacking,
        torch.ones_like(shared[..., 0, 0]) if before is None else before.dispersion.expand(batch).clone(),
        -follow,
        torch.zeros_like(follow),
        (alone + alone.mT) / 2,
        data.middle,
        each(errors.arm),
        None if common is None else common.reshape(*batch, *common.shape[1:]),
    )
    return own if before is None else own.following(before)


def _others(data: Data, whole: Fit, ends: Sequence[Found]) -> OtherPoses:
    """The other end of each view, as far as it is another pose, and its odds with all that is known."""
    shape = data.used.shape[:2]
    kept, other = (
        tuple(z.reshape(*shape, *z.shape[1:]) for z in _poses(data, end))
        for end in (ends[0], ends[min(1, len(ends) - 1)])
    )
    cost, there = (end.cost.reshape(shape) for end in (ends[0], ends[min(1, len(ends) - 1)]))
    noise = own_noise(whole)
    variance, freedom = (z.unsqueeze(-1) for z in noise)
    step = difference(kept, other, whole.task.points.mean(0))
    apart = (step.unsqueeze(-2) @ whole.solution.equations.W @ step.unsqueeze(-1)).squeeze(-1).squeeze(-1)
    variance = variance.clamp(min=1e-18)
    another = (apart > APART**2 * variance) & (ends[min(1, len(ends) - 1)].status.reshape(shape) == Status.CONVERGED)
    excess = 2 * (there - cost).clamp(min=0) / (variance * freedom)
    ratio = torch.where(another & data.used.any(-1), (freedom / 2 * excess.log1p()).exp(), torch.inf)
    R, t = data.frame.world_pose(*other)
    keep_R, keep_t = data.frame.world_pose(*kept)
    R = torch.where(another[..., None, None], R, keep_R)
    t = torch.where(another[..., None], t, keep_t)
    parts = R, t, ratio
    return OtherPoses(*(part.reshape(*data.batch, *part.shape[1:]) for part in parts))


def _remarks(data: Data, task: Task, found: Found, plain: Calibration) -> tuple[Remarks, ...]:
    """Those on the residuals; and where residuals and priors together contradict the deviations."""
    told = list(plain.findings)
    if not task.known.priors:
        return tuple(told)
    seen = data.used.any(-1)
    cost, left = (torch.where(seen, z.reshape(seen.shape), 0).sum(-1) for z in (found.cost, spare(task, found)))
    chance = torch.special.gammaincc(left.clamp(min=1).to(cost) / 2, cost)
    for p in ((chance < CONTRADICTION) & (left > 0)).nonzero().flatten().tolist():
        if all(one.kind in (Kind.BELOW, Kind.TOLD_APART) for one in told[p]) and plain.converged.flatten()[p]:
            times = float((2 * cost[p] / left[p]).sqrt())
            reason = f"residuals and priors are {times:.2g} times what their deviations say"
            sentence = (
                f"{reason}, more than chance allows: look for a wrong prior or landmark, or give larger deviations"
            )
            told[p] = (Remark(sentence, Kind.CONTRADICTION, reason), *told[p])
    return tuple(told)
