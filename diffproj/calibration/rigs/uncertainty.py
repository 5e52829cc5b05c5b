"""The joint covariance of a rig: intrinsics and places of all cameras, and the target's pose at each moment.

The forms are those of `trust/uncertainty.py`, with the noise of a corner estimated for each camera: where the corners
of one scatter more than another's, the covariance of the scores is not a multiple of the normal matrix, but sums up
each camera's share. With s_c the noise of camera c, and all views of a moment one group,

    H = sum_c sum w J^T J       M = sum_c s_c^2 sum w J^T J       covariance = phi H^-1 M H^-1

where the corners of a camera clearly scatter more at a moment than at others, their own noise stands for s_c there
(`noisy_views.py`). A corner that a robust loss holds for wrong counts as if it had not been seen, and so do all of a
moment whose pose the others do not tell. What the loss lets through of its pull goes into the pose alone, as in
`trust/robust_loss.py`, so that a moment of few corners has the covariance of the right ones. phi is the dispersion
(`dispersion.py`): how much the moments contradict each other. Errors that all corners of a view share are a part of M
of their own (`common_errors.py`), and phi multiplies the corners' part by what these leave of the dispersion.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.least_squares.eliminated import local_inverse, reduced
from diffproj.calibration.least_squares.losses import Loss, slope_and_bend
from diffproj.calibration.least_squares.normal_equations import Equations
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results.covariance import Covariance, Scores, covariance, points_turned, reshaped
from diffproj.calibration.rigs.common_errors import CommonErrors
from diffproj.calibration.rigs.fit import RigFit
from diffproj.calibration.rigs.held_errors import following
from diffproj.calibration.rigs.problem import RigProblem
from diffproj.calibration.trust.dispersion import FEW_VIEWS, FEW_VIEWS_OF_A_SHAPE, believed, contradiction
from diffproj.calibration.trust.noisy_views import beyond_chance
from diffproj.geometry.cayley import cross_matrix

DISPERSION_STEPS = 10
"""Towards the dispersion where views share errors: each comes closer to it severalfold."""
LEAST = 1e-3
"""Dispersion, anywhere below 1, that is as good as any."""


class CameraNoise(NamedTuple):
    """What the residuals of each camera tell of the noise of its corners `(C,)`.

    Attributes:
        variance: of a residual component, of weight 1.
        pixel_variance: of a coordinate in px^2.
        freedom: degrees of freedom that they are from.
        bend: the mean derivative of the score, 1 for least squares.
        inflation: what a robust loss loses: 1 for least squares.
    """

    variance: Tensor
    pixel_variance: Tensor
    freedom: Tensor
    bend: Tensor
    inflation: Tensor


def camera_noise(found: RigFit) -> CameraNoise:
    """The noise of each camera; NaN where there are no degrees of freedom."""
    views, names = found.views, found.views.names
    count = torch.zeros(len(names), len(views.moments), dtype=torch.float64, device=found.shared.device)
    for c, name in enumerate(names):
        count[c, views.where[name]] = found.used[name].sum(-1).to(count)
    # A moment's pose takes six degrees of freedom, from each of its cameras by its corners.
    of_poses = POSE * (count / count.sum(0).clamp(min=1)).sum(-1)
    free = torch.ones_like(found.shared[0]) if found.basis is None else found.basis[0].abs().sum(-1)
    parameters = found.parameters
    free = free * told_of_cameras(found)
    own = torch.stack(
        [free[parameters.columns(c)[: None if c else parameters.kinds[0].size]].sum() for c in range(len(names))]
    )
    spare = 2 * count.sum(-1) - of_poses - own - told_of_shape(found) * count.sum(-1) / count.sum().clamp(min=1)
    lost = torch.full_like(spare, torch.nan)
    rows = []
    for c, (name, residual) in enumerate(found.by_camera.items()):
        used, squared = found.used[name], residual.square().sum(-1)
        weights = views.data[name].weights
        weight = used.to(squared) if weights is None else weights[0] * used
        plain = torch.where(spare[c] > 0, squared.sum() / spare[c], lost[c])
        bend, inflation = torch.ones_like(plain), torch.ones_like(plain)
        if found.loss is None:
            level = torch.where(spare[c] > 0, (weight * squared).sum() / spare[c], lost[c])
        else:
            slope, curve = slope_and_bend(found.loss, squared)
            n = used.sum().clamp(min=1)

            def mean(values: Tensor, used: Tensor = used, n: Tensor = n) -> Tensor:
                return (values * used).sum() / n

            bend = mean(slope + curve * squared).clamp(min=1e-3)
            square = mean(slope.square() + 2 * slope * curve * squared + 2 * (curve * squared).square())
            inflation = (1 + (1 - spare[c] / (2 * n)) * (square / bend.square() - 1).clamp(min=0)).square()
            level = torch.where(spare[c] > 0, (weight * slope.square() * squared).sum() / spare[c], lost[c])
            plain = (1.4826 * residual[used].abs().flatten().median()).square() if bool(used.any()) else lost[c]
        rows.append((level, plain, spare[c], bend, inflation))
    return CameraNoise(*(torch.stack(column) for column in zip(*rows, strict=True)))


def told_of_cameras(found: RigFit) -> Tensor:
    """The part of each shared unknown that the corners tell, and not what is known beforehand `(s,)`."""
    told = found.problem.precision(found.shared)
    if told is None:
        return torch.ones_like(found.shared[0])
    basis = found.basis
    S, told = reduced(found.equations, basis, None)[0], told if basis is None else basis.mT @ told @ basis
    scale = S.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt().unsqueeze(-1)
    known = torch.linalg.pinv(S * scale * scale.mT, hermitian=True) @ (told * scale * scale.mT)
    told_by_corners = (1 - known.diagonal(dim1=-2, dim2=-1)[0]).clamp(0, 1)
    return told_by_corners if basis is None else basis[0] @ told_by_corners


def told_of_shape(found: RigFit) -> float:
    """How many unknowns of the target's shape the corners tell, and neither the frame nor a prior.

    Of a coordinate that both tell, the part that the corners do: what is left of the trace of the prior's precision
    over all precision.
    """
    if found.parameters.bow:
        free = found.shared.new_ones(2) if found.basis is None else found.basis[0, -2:].abs().sum(-1)
        return float(free.sum())
    if found.restraint is None:
        return 0.0
    few, basis, restraint = found.parameters.few, found.basis, found.restraint
    free = ~restraint.unknown[0]
    if basis is not None:
        free = free & (basis[0, few:].abs().sum(-1) > 0)
    if not bool((restraint.printed > 0).any()):
        root = restraint.root[0, free]
        return float(free.sum()) - float(torch.linalg.matrix_rank(root / root.norm().clamp(min=1e-300)))
    S, told = reduced(found.equations, basis, None)[0], torch.nn.functional.pad(restraint.precision, (few, 0, few, 0))
    told = told if basis is None else basis.mT @ told @ basis
    scale = S.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt().unsqueeze(-1)
    L, failed = torch.linalg.cholesky_ex(S * scale * scale.mT)
    if bool(failed.any()):
        return float(free.sum())
    every = 3 * found.parameters.points if basis is None else int((basis[0, few:].abs().sum(0) > 0).sum())
    return every - float(torch.cholesky_solve(told * scale * scale.mT, L).diagonal(dim1=-2, dim2=-1).sum())


def pooled_variance(noise: CameraNoise) -> Tensor:
    """The variance of a residual component of weight 1, if it is one for all cameras."""
    freedom = noise.freedom.clamp(min=0)
    return torch.where(freedom > 0, noise.variance * freedom, 0.0).sum() / freedom.sum().clamp(min=1)


def plain_covariance(found: RigFit, noise: CameraNoise) -> Covariance:
    """The covariance for one noise of all cameras and independent corners: what verdicts go by."""
    pooled = pooled_variance(noise)
    frame: dict[str, Any] = {}
    if found.restraint is not None:
        few, restraint = found.parameters.few, found.restraint
        wide = (few, 0, few, 0)
        frame = {
            "frame": torch.nn.functional.pad(restraint.frame, wide),
            "printed": torch.nn.functional.pad(restraint.measured, wide),
        }
    return covariance(
        found.equations, found.parameters.names, pooled.unsqueeze(0), basis=found.basis, unseen=unseen(found), **frame
    )


def unseen(found: RigFit) -> Tensor | None:
    """The shared unknowns that nothing tells `(1, s)`; `None` where no points are free."""
    if found.restraint is None:
        return None
    return torch.nn.functional.pad(found.restraint.unknown, (found.parameters.few, 0))


def rig_covariance(
    found: RigFit, noise: CameraNoise, common: CommonErrors | None, wrong: Mapping[str, Tensor] | None = None
) -> Covariance:
    """The joint covariance, without batch axes; poses are the target's in the rig.

    Args:
        found: the fit.
        noise: of its cameras.
        common: errors that all corners of a view share.
        wrong: corners that a robust loss holds for wrong `(V_c, N)`, by camera.
    """
    state = found.shared, found.local, None
    known = found.problem.precision(found.shared)
    scale = (noise.variance * noise.inflation).nan_to_num(0.0)
    _, M = found.problem.totals(*state, scale=scale, by_moment=True)
    phi, of_corners = _dispersion(found, M, None if common is None else common.scores)
    pulls = None
    if found.loss is not None and wrong is not None and any(bool(part.any()) for part in wrong.values()):
        pulls = wrong_pulls(found, found.loss, wrong)
        found = of_right_corners(found, wrong)
        noise = camera_noise(found)
        scale = (noise.variance * noise.inflation).nan_to_num(0.0)
    H, noisy = found.curvature(noise.bend), noisy_moments(found, noise)
    if pulls is not None or bool((noisy > 1).any()):
        _, M = found.problem.totals(*state, scale=scale.unsqueeze(-1) * noisy, by_moment=True)
    scores = Scores(M.U, M.E, M.W)
    if common is not None:  # of all dispersion, the part that common errors do not explain is the corners'
        scores = Scores(*((of_corners * a + b) / phi for a, b in zip(scores, common.scores, strict=True)))
    precision = (
        None if known is None else found.prior_variance * known
    )  # of its own scores, in the unit of the corners'
    if found.restraint is not None and bool((found.restraint.printed > 0).any()):
        few = found.parameters.few
        printed = torch.nn.functional.pad(found.prior_variance * found.restraint.measured, (few, 0, few, 0))
        precision = printed if precision is None else precision + printed
    found_one = covariance(
        H,
        found.parameters.names,
        torch.ones_like(phi),
        basis=found.basis,
        precision=precision,
        scores=scores,
        dispersion=phi,
        unseen=unseen(found),
    )
    if found.held_errors is not None and found.basis is not None:
        found_one = following(found_one, H, found.basis, found.held_errors)
    if pulls is not None:
        inverse, _ = local_inverse(H.W)
        found_one = replace(found_one, _alone=found_one._alone + of_corners * inverse @ pulls @ inverse)
    middle, axes = found.views.middle, found.views.frame.axes
    if axes is not None:
        found_one = points_turned(found_one, axes.mT, found.parameters.few + 2 * found.parameters.bow)
    R, _ = found.views.frame.world_pose(found.local[0][0], found.local[1][0])
    return replace(reshaped(found_one, ()), middle=middle, _arm=R @ middle)


def without(found: RigFit, wrong: Mapping[str, Tensor]) -> RigFit:
    """The fit as if some corners `(V_c, N)` had not been seen, at the minimum with them."""
    used = {name: part & ~wrong[name] for name, part in found.used.items()}
    problem = RigProblem(found.views, found.parameters, found.problem.base[0], used, found.problem.known)
    return replace(found, problem=problem, used=used)


def of_right_corners(found: RigFit, wrong: Mapping[str, Tensor]) -> RigFit:
    """The fit as if wrong corners `(V_c, N)` had not been seen, nor moments whose pose the others do not tell."""
    found = without(found, wrong)
    _, H = found.problem.totals(found.shared, found.local, None)
    _, unknown = local_inverse(H.W)
    return without(found, {name: unknown[0, found.views.where[name], None] & part for name, part in found.used.items()})


def wrong_pulls(found: RigFit, loss: Loss, wrong: Mapping[str, Tensor]) -> Tensor:
    """What a loss lets through of wrong corners' `(V_c, N)` pulls at poses: a part of their covariance `(1, M, 6, 6)`.

    They count by their own size, taken to be of any direction.
    """
    views = found.views
    strength = found.shared.new_zeros(len(views.names), len(views.moments))
    for c, (name, residual) in enumerate(found.by_camera.items()):
        squared, weights = residual.square().sum(-1), views.data[name].weights
        pull = squared * slope_and_bend(loss, squared)[0].square() / 2
        pull = (pull if weights is None else pull * weights[0]) * wrong[name]
        strength[c, views.where[name]] = pull.sum(-1) / wrong[name].sum(-1).clamp(min=1)
    problem = RigProblem(views, found.parameters, found.problem.base[0], wrong)
    _, M = problem.totals(found.shared, found.local, None, scale=strength, by_moment=True)
    return M.W


def noisy_moments(found: RigFit, noise: CameraNoise) -> Tensor:
    """The factor on the variance of each camera's corners at each moment `(C, M)`: see `noisy_views.py`."""
    views, names = found.views, found.views.names
    count = torch.zeros(len(names), len(views.moments), dtype=torch.float64, device=found.shared.device)
    squares = torch.zeros_like(count)
    for c, (name, residual) in enumerate(found.by_camera.items()):
        used, squared = found.used[name], residual.square().sum(-1)
        weights = views.data[name].weights
        weight = used.to(squared) if weights is None else weights[0] * used
        if found.loss is None:
            total = (weight * squared).sum(-1)
        else:
            slope, bend = slope_and_bend(found.loss, squared)
            mean = ((slope + bend * squared) * used).sum(-1) / used.sum(-1).clamp(min=1)
            total = (weight * slope.square() * squared).sum(-1) * (noise.bend[c] / mean.clamp(min=1e-3)).square()
        count[c, views.where[name]], squares[c, views.where[name]] = used.sum(-1).to(count), total
    # The pose of a moment takes from each of its cameras by its corners, and all else by all.
    spare = 2 * count - POSE * count / count.sum(0).clamp(min=1)
    spare = spare * (noise.freedom / spare.sum(-1).clamp(min=1)).clamp(0, 1).unsqueeze(-1)
    level = noise.variance.unsqueeze(-1)
    known = (level > 0) & (spare >= 1)
    ratio = torch.where(known, squares / spare.clamp(min=1) / torch.where(known, level, 1.0), 1.0)
    excess, believed = beyond_chance(ratio, spare)
    return 1 + excess * believed


def _dispersion(found: RigFit, M: Equations, common: Scores | None) -> tuple[Tensor, Tensor]:
    """How much more the moments contradict each other than independent corners would `(1,)`.

    And by what the corners' part of the covariance of the scores is to be multiplied beside that of common errors.
    Free points follow what the moments want: what is compared is how these pull at the cameras with the points held.
    """
    few, none = found.parameters.few + 2 * found.parameters.bow, torch.ones_like(M.h[:, 0, 0])
    kept = slice(0, few)
    basis = found.basis
    if basis is not None:
        basis = basis[:, :few, basis[0, :few].abs().sum(0) > 0]
    if basis is not None and basis.shape[-1] == 0:
        return none, none
    seen = torch.stack([_seen(found, name) for name in found.views.names]).any(0)
    if found.free == 0 or int(seen.sum()) < 2:
        return none, none
    with torch.inference_mode():
        _, own = found.problem.totals(found.shared, found.local, found.loss, by_moment=True)
        inverse, _ = local_inverse(own.W)
        F = own.E @ inverse
        u = own.g - (F @ own.h.unsqueeze(-1)).squeeze(-1)
        S = own.U - F @ own.E.mT

        def of_pulls(scores: Equations | Scores) -> Tensor:
            leaning = F @ scores.E.mT
            return (scores.U - leaning - leaning.mT + F @ scores.W @ F.mT)[..., kept, kept]

        K, L = of_pulls(M), None if common is None else of_pulls(common)
        u, S = u[..., kept], S[..., kept, kept]
        total, pull = S.sum(1), u.sum(1)
        if found.problem.known is not None:  # pulls along, and what it determines costs no degree of freedom
            off, rows = found.problem.known.rows(found.shared, *found.problem.places(found.shared))
            rows = rows[..., kept]
            total, pull = total + rows.mT @ rows, pull + (rows.mT @ off.unsqueeze(-1)).squeeze(-1)
        if basis is not None:
            T = basis.mT.unsqueeze(1)
            u, S = (T @ u.unsqueeze(-1)).squeeze(-1), T @ S @ T.mT
            K, L = T @ K @ T.mT, None if L is None else T @ L @ T.mT
            total, pull = basis.mT @ total @ basis, (basis.mT @ pull.unsqueeze(-1)).squeeze(-1)
        share = seen.to(u).unsqueeze(0)
        shaped = found.restraint is not None and found.views.spread is None
        few_views = FEW_VIEWS_OF_A_SHAPE if shaped else FEW_VIEWS
        told = contradiction(u, S, K, share, total, pull)
        whole = believed(told, few_views).clone()
        if L is None:
            return whole, whole
        phi = torch.ones_like(told.phi)
        for _ in range(DISPERSION_STEPS):
            told = contradiction(u, S, phi[:, None, None, None] * K + L, share, total, pull)
            phi = (phi * told.phi).clamp(min=LEAST)
        return whole, believed(told._replace(phi=phi), few_views).clone()


def _seen(found: RigFit, name: str) -> Tensor:
    """Moments at which a camera saw the target `(M,)`."""
    seen = torch.zeros(len(found.views.moments), dtype=torch.bool, device=found.shared.device)
    seen[found.views.where[name]] = found.used[name].any(-1)
    return seen


def of_camera(found: RigFit, joint: Covariance, camera: int) -> Covariance:
    """The covariance of one camera and the target's pose in each of its views, with all else that is shared behind.

    The pose in a view is composed of the camera's place in the rig and the target's: `dz_v = A_v dx_c + B_v dz_m`.
    """
    views, parameters = found.views, found.parameters
    name, s = views.names[camera], parameters.size
    own, place = parameters.intrinsics(camera), parameters.pose(camera)
    where = views.where[name]
    R, _ = found.problem.cameras(found.shared)
    R_c, R_m, t_m = R[camera], found.local[0][0, where], found.local[1][0, where]
    arm = (R_c @ t_m.unsqueeze(-1)).squeeze(-1)
    B = torch.block_diag(R_c, R_c)
    follow, mixed, alone = B @ joint._follow[where], B @ joint._mixed[where], B @ joint._alone[where] @ B.mT
    if camera:
        A = torch.eye(POSE, dtype=B.dtype, device=B.device).repeat(len(where), 1, 1)
        A[:, 3:, :3] = -cross_matrix(arm)
        follow = follow.clone()
        follow[:, :, place] -= A
    few = parameters.few
    others = [i for i in range(few) if not own.start <= i < own.stop]
    order = [*range(own.start, own.stop), *range(few, s), *others]  # its own, the shape, those of others
    names = tuple(
        joint.names[i].removeprefix(f"{name}.") if own.start <= i < own.stop else joint.names[i] for i in order
    )
    rows = torch.tensor(order, device=B.device)
    unknown = joint.undetermined_views[where]
    middle = views.middle
    return Covariance(
        names,
        joint.shared[rows][:, rows],
        joint.undetermined[rows],
        unknown,
        joint.dispersion,
        follow[..., rows],
        mixed[..., rows],
        alone,
        middle,
        (R_c @ views.frame.world_pose(R_m, t_m)[0]) @ middle,
    )
