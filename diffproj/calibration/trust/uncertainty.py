"""The covariance of a fit, whatever was minimised, and the noise of a corner.

With J the derivatives of a corner's residual e by all parameters, n corners and p parameters:

    least squares      H = sum w J^T J          M = s^2 H           s^2 = sum w |e|^2 / (2 n - p)
    robust loss        H = a sum w J^T J        M = k^2 q sum w J^T J           (Huber 1981, section 7.6)
                       a = mean of the score's derivative, q = sum w |rho' e|^2 / (2 n - p)
    plane objective    H = sum w J^T J          M = s^2 sum w^2 J^T D D^T J     s in pixels, D = d(xy) / d(uv)
    both               H, M summed over the corners' own derivatives and scores (White 1980)

and the covariance is `phi H^-1 M H^-1`, phi the dispersion. Variances are pooled over all corners of a camera. A
sandwich summed over the scores of the few corners of each view is right on average too, but for the pose in a view it
is as noisy as a covariance in six dimensions from so few: its inverse is far too large. Of a view whose corners err
clearly more than the others', the pose gets a variance of its own (`noisy_views.py`).
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.least_squares.losses import slope_and_bend
from diffproj.calibration.least_squares.normal_equations import Equations
from diffproj.calibration.results import covariance as covariances
from diffproj.calibration.results.covariance import Covariance, Scores
from diffproj.calibration.trust.dispersion import dispersion
from diffproj.calibration.trust.noise import Noise, pooled
from diffproj.calibration.trust.noisy_views import widened_poses


def covariance_of(found: Fit, known: Noise | None = None, phi: Tensor | None = None) -> Covariance:
    """The joint covariance of shared parameters and poses of P cameras.

    Args:
        found: the fit.
        known: the noise that a calibration before had, where the shared parameters are held.
        phi: and its dispersion `(P,)`; that of the fit if left out.
    """
    task = found.task
    if phi is None:  # a noise that was given is the whole error
        phi = torch.ones_like(found.solution.cost) if found.knows_noise else dispersion(found)
    precision = found.measured_precision()
    common = {
        "names": task.names,
        "basis": task.basis,
        "precision": precision,
        "dispersion": phi,
        "shares": task.shares,
        **found.frame(),
    }
    if task.objective == "plane":
        equations, scores = _on_the_plane(found)
        if task.prior is not None and precision is not None and precision is not task.prior.precision:
            # What only restrains is as uncertain as the residuals say.
            scale = found.residual_variance().nan_to_num(0.0)[:, None, None]
            common["precision"] = precision + scale * (task.prior.precision - precision)
        whole = covariances.covariance(equations, variance=torch.ones_like(phi), scores=scores, **common)
        # With a robust loss each view's scores are its own.
        return whole if task.loss is not None else widened_poses(whole, found, found.pixel_sigma().square())
    if task.loss is None:
        equations, factor, variance = found.solution.equations, 1.0, found.residual_variance()
    else:
        equations, factor, variance = _robust(found)
    if known is not None and task.weights is None:
        variance = pooled(Noise(variance, found.degrees_of_freedom().to(variance)), known).variance
    whole = covariances.covariance(equations, variance=factor * variance, **common)
    # What a located view's corners scatter more than its calibration's, `mismatch` tells, and `measure` counts.
    return whole if known is not None else widened_poses(whole, found, variance)


def _robust(found: Fit) -> tuple[Equations, Tensor, Tensor]:
    """The normal equations with the score's mean derivative a, this, and the variance in the place of `s^2`."""
    rows, residual, weight = _panel(found)
    squared = residual.square().sum(2)
    slope, bend = slope_and_bend(found.task.loss, squared)
    used = _counted(found, squared)
    n = used.sum((-2, -1)).clamp(min=1)
    spare = found.degrees_of_freedom()

    def mean(values: Tensor) -> Tensor:
        return (values * used).sum((-2, -1)) / n

    # Of a corner's two components, the score's derivative is rho' across the residual and rho' + 2 rho'' e^2 along it.
    a = mean(slope + bend * squared).clamp(min=1e-3)
    a_squared = mean(slope.square() + 2 * slope * bend * squared + 2 * (bend * squared).square())
    k = 1 + (1 - spare / (2 * n)) * (a_squared / a.square() - 1).clamp(min=0)
    q = torch.where(spare > 0, (weight * slope.square() * squared * used).sum((-2, -1)) / spare, torch.nan)
    return _equations(found, rows, weight * a[:, None, None]), a, k.square() * q / a.square()


def _counted(found: Fit, like: Tensor) -> Tensor:
    """How much each corner counts `(P, V, N)`: those of views that are alike, as one."""
    used = found.task.used.to(like)
    return used if found.task.shares is None else used * found.task.shares.unsqueeze(-1)


def _on_the_plane(found: Fit) -> tuple[Equations, Scores]:
    rows, residual, weight = _panel(found)
    if found.task.loss is None:
        # A residual e on the image is r = -D e on the plane, its derivatives alike: D from those by the translation.
        used = found.task.used
        image = replace(found.task, objective="image").problem.linearise(*_state(found))[:, :, -4:-1]
        gram = torch.einsum("pvsin,pvsjn->pvnij", image, image)
        gram = torch.where(used[..., None, None], gram, torch.eye(2, dtype=gram.dtype, device=gram.device))
        D = torch.linalg.solve(gram, torch.einsum("pvsin,pvsjn->pvnij", image, rows[:, :, -3:])).mT
        sigma = found.pixel_sigma()
        pulls = torch.einsum("pvsin,pvnij->pvsjn", rows, D) * (weight * sigma[:, None, None])[:, :, None, None]
        pulls = torch.where(used[:, :, None, None], pulls, 0.0).flatten(-2)
        return _equations(found, rows, weight), _scores(found, pulls @ pulls.mT)
    score = (rows * residual.unsqueeze(2)).sum(3)  # (P, V, s + 6, N): per corner, unweighted
    squared = residual.square().sum(2)
    slope, bend = slope_and_bend(found.task.loss, squared)
    both = (weight * slope).unsqueeze(2)
    n, spare = _counted(found, squared).sum((-2, -1)), found.degrees_of_freedom()
    spread = torch.where(spare > 0, 2 * n / spare, torch.nan)
    M = (score * both.square()) @ score.mT * spread[:, None, None, None]
    curved = (score * (2 * weight * bend).unsqueeze(2)) @ score.mT
    return _equations(found, rows, weight * slope, curved), _scores(found, M)


def _panel(found: Fit) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives `(P, V, s + 6, 2, N)`, residuals `(P, V, 2, N)` and weights `(P, V, N)`."""
    problem, state = found.task.problem, _state(found)
    panel = problem.every_row(problem.linearise(*state), state[1])
    rows, residual = panel[:, :, :-1], panel[:, :, -1]
    weight = found.task.weights
    return rows, residual, torch.ones_like(residual[:, :, 0]) if weight is None else weight


def _state(found: Fit) -> tuple[Tensor, tuple[Tensor, ...]]:
    return found.solution.shared.detach(), tuple(z.detach() for z in found.solution.local)


def _equations(found: Fit, rows: Tensor, weight: Tensor, more: Tensor | None = None) -> Equations:
    """The normal equations with these weights `(P, V, N)`, and more of the matrix `(P, V, s + 6, s + 6)`."""
    flat, s = rows.flatten(-2), len(found.task.names)
    H = (flat * weight.unsqueeze(2).repeat(1, 1, 1, 2)) @ flat.mT
    H = H if more is None else H + more
    U = H[..., :s, :s]
    U = (U if found.task.shares is None else U * found.task.shares[..., None, None]).sum(1)
    prior = found.task.whole_prior
    U = U if prior is None else U + prior.whole
    return Equations(U, H[..., :s, s:], H[..., s:, s:], *found.solution.equations[3:])


def _scores(found: Fit, M: Tensor) -> Scores:
    s = len(found.task.names)
    return Scores(M[..., :s, :s], M[..., :s, s:], M[..., s:, s:])
