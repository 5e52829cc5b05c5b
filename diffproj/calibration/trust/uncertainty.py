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
clearly more than the others', the pose gets a variance of its own (`noisy_views.py`), and what few corners tell under a
robust loss heeds the wrong ones of them (`robust_loss.py`).
"""

from dataclasses import replace

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.least_squares.normal_equations import Equations
from diffproj.calibration.results import covariance as covariances
from diffproj.calibration.results.covariance import Covariance, Scores
from diffproj.calibration.trust.corner_scores import CornerScores, state_of
from diffproj.calibration.trust.dispersion import dispersion, pulls_of
from diffproj.calibration.trust.noise import Noise, with_known
from diffproj.calibration.trust.noisy_views import widened_poses
from diffproj.calibration.trust.own_intrinsics import with_own_focal
from diffproj.calibration.trust.robust_loss import with_own_scores


def covariance_of(found: Fit, known: Noise | None = None, phi: Tensor | None = None) -> Covariance:
    """The joint covariance of shared parameters and poses of P cameras.

    Args:
        found: the fit.
        known: the noise that a calibration before had, where the shared parameters are held.
        phi: and its dispersion `(P,)`; that of the fit if left out.
    """
    if phi is not None:
        return pooled_covariance_of(found, known, phi)
    pulls = pulls_of(found)
    # A noise that was given is the whole error of a corner, and focal lengths that differ are none of it.
    phi = None if found.knows_noise else dispersion(found, pulls)
    return with_own_focal(pooled_covariance_of(found, known, phi), found, pulls)


def pooled_covariance_of(found: Fit, known: Noise | None = None, phi: Tensor | None = None) -> Covariance:
    """The same with what views contradict each other about spread over all directions of the parameters."""
    task = found.task
    if phi is None:
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
        corners = CornerScores(found)
        means = corners.moments(corners.counted, found.degrees_of_freedom())
        factor, variance = means.slope, means.variance
        equations = _equations(found, corners.rows, corners.weight * factor[:, None, None])
    variance = with_known(Noise(variance, found.degrees_of_freedom().to(variance)), known, found).variance
    whole = covariances.covariance(equations, variance=factor * variance, **common)
    if task.loss is not None:
        return with_own_scores(whole, found, phi, known)
    # What a located view's corners scatter more than its calibration's, `mismatch` tells, and `measure` counts.
    return whole if known is not None else widened_poses(whole, found, variance)


def _on_the_plane(found: Fit) -> tuple[Equations, Scores]:
    corners = CornerScores(found)
    rows, weight = corners.rows, corners.weight
    if found.task.loss is None:
        # A residual e on the image is r = -D e on the plane, its derivatives alike: D from those by the translation.
        used = found.task.used
        image = replace(found.task, objective="image").problem.linearise(*state_of(found))[:, :, -4:-1]
        gram = torch.einsum("pvsin,pvsjn->pvnij", image, image)
        gram = torch.where(used[..., None, None], gram, torch.eye(2, dtype=gram.dtype, device=gram.device))
        D = torch.linalg.solve(gram, torch.einsum("pvsin,pvsjn->pvnij", image, rows[:, :, -3:])).mT
        sigma = found.pixel_sigma()
        pulls = torch.einsum("pvsin,pvnij->pvsjn", rows, D) * (weight * sigma[:, None, None])[:, :, None, None]
        pulls = torch.where(used[:, :, None, None], pulls, 0.0).flatten(-2)
        return _equations(found, rows, weight), _scores(found, pulls @ pulls.mT)
    both, pulls = (weight * corners.slope).unsqueeze(2), corners.pulls
    n, spare = corners.counted.sum((-2, -1)), found.degrees_of_freedom()
    spread = torch.where(spare > 0, 2 * n / spare, torch.nan)
    M = (pulls * both.square()) @ pulls.mT * spread[:, None, None, None]
    curved = (pulls * (2 * weight * corners.bend).unsqueeze(2)) @ pulls.mT
    return _equations(found, rows, weight * corners.slope, curved), _scores(found, M)


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
