"""Whether located views could be those of the camera that they were located with.

Two tests of the residuals of each view, whose pose was free, by the covariance of the calibration and its noise.

* All of them, without what the calibration leaves open: with J the derivatives by the intrinsics, the pose eliminated,
  and Sigma their covariance, `r^T (v I + J Sigma J^T)^-1 r` is `v` times chi-squared, v the noise.
* Those that other intrinsics would explain: their pull `u = J^T r` has the covariance `phi v S + S Sigma S`, with
  `S = J^T J` and phi the dispersion, by which views of one camera contradict each other. Noise that is larger in this
  photograph than in the calibration's counts as noise: it is taken from what other intrinsics would not explain.

The second is sharp: of 13 photographs by the other camera of a stereo pair, whose focal length differs by 1 %, it knows
every one, and none of the camera's own 13, each left out of the calibration. Their residuals alone overlap: 1.35 to 3.2
times those of the calibration against up to 1.43.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.least_squares.eliminated import local_inverse
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.covariance import zero_where_infinite
from diffproj.calibration.results.mismatch import Mismatch, none_at_all
from diffproj.calibration.trust.leftover import f_deviations
from diffproj.calibration.trust.noise import Noise, noise_of

FINEST_PX = 0.05
"""Noise of a corner's coordinate below which a calibration's is not counted on in another photograph: there, what a
detector does at another distance or blur, or that the corners are simulated, makes more of a difference."""
LARGE, VARIED = 1.7, 1.4
"""Times the calibration's residuals from which on those of a view are doubtful, whatever they look like; and up to
which the noise of photographs by one camera varies, so that chance alone has to be beyond that."""
NOTABLE = 1.25
"""The same for residuals that other intrinsics would explain."""
CHANCE, RARE = 2.33, 3.09
"""Standard deviations that a normal variable exceeds by chance in 1 % and in 0.1 % of all cases."""
FEWEST_VIEWS = 3
"""Views of a calibration below which nothing is known of how far views contradict each other."""
SINGULAR = 1e-9
"""Eigenvalue of S, relative to the largest, below which the view says nothing in this direction."""


def mismatch(found: Fit, known: Calibration, batch: Sequence[int]) -> Mismatch:
    """How the located views of the cameras `*B` compare with what `known` says.

    Of weighted corners nothing is said, for their noise is not the calibration's.
    """
    noise = noise_of(known, batch)
    if noise is None or found.task.weights is not None:
        return none_at_all(found.task.used.unflatten(0, tuple(batch)) if batch else found.task.used.squeeze(0))
    with torch.no_grad():
        compared = _compared(found, known, noise, tuple(batch))
    return Mismatch(*(part.reshape(*batch, part.shape[-1]) for part in compared))


def _compared(found: Fit, known: Calibration, usual: Noise, batch: tuple[int, ...]) -> Mismatch:
    def of_each(value: Tensor, behind: int = 0) -> Tensor:
        """A number or a matrix of the calibrations for each of the P cameras, `(P, 1)` or `(P, 1, n, n)`."""
        shape = value.shape[value.ndim - behind :]
        return value.detach().to(torch.float64).expand((*batch, *shape)).reshape(-1, 1, *shape)

    used = found.task.used
    rows, pose, residual = derivatives(found)
    variance, freedom = usual.variance.clamp(min=FINEST_PX**2).unsqueeze(-1), usual.freedom.unsqueeze(-1)
    squares = residual.square().sum((-2, -1))
    total = squares / variance
    spare = (2 * used.sum(-1) - POSE).to(total)
    counted = (spare > 0) & total.isfinite()
    spare = spare.clamp(min=1)
    ratio = torch.where(counted, (squares / spare / usual.variance.unsqueeze(-1)).sqrt(), torch.nan)
    notable = total / spare
    beside, elsewhere, scale = total, torch.zeros_like(counted), notable.sqrt()
    if known.has_covariance:
        covariance = known.covariance_of_kept_poses
        s = rows.shape[2]
        Sigma, phi = of_each(covariance.shared[..., :s, :s], 2), of_each(covariance.dispersion)
        Sigma = zero_where_infinite(Sigma)
        pulls, open_, rank = _pulls(rows, pose, residual, variance, Sigma)
        beside = total - (pulls - pulls / (1 + open_)).sum(-1)
        noise = ((total - pulls.sum(-1)) / (spare - rank).clamp(min=1)).clamp(min=1)
        pulls, open_ = (part / phi.unsqueeze(-1) for part in (pulls, open_))
        pull = (pulls / (1 + open_)).sum(-1) / (rank.clamp(min=1) * noise)
        views = of_each(known.used.any(-1).sum(-1))
        contradictions = ((views - 1) * (Sigma.diagonal(dim1=-2, dim2=-1) > 0).sum(-1)).clamp(min=1)
        elsewhere = f_deviations(pull, rank.clamp(min=1).to(pull), contradictions) > CHANCE
        elsewhere &= (notable > NOTABLE**2) & (f_deviations(notable, spare, freedom) > RARE)
        elsewhere &= (rank > 0) & (views >= FEWEST_VIEWS)
        scale = scale.maximum((pull * noise).sqrt())
    beside = beside.clamp(min=0) / spare
    large = (beside > LARGE**2) & (f_deviations(beside / VARIED**2, spare, freedom) > CHANCE)
    doubtful = counted & (large | elsewhere)
    return Mismatch(ratio, doubtful, torch.where(doubtful, scale, 1.0))


def derivatives(found: Fit) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives of the residuals by the intrinsics `(P, V, s, 2 N)` and by the pose `(P, V, 6, 2 N)`, and these.

    Under a robust loss, weighted as it weighs them.
    """
    task, solution = found.task, found.solution
    panel = task.problem.linearise(solution.shared.detach(), tuple(z.detach() for z in solution.local))
    if task.loss is not None:
        panel = panel * task.loss.weight(panel[:, :, -1].square().sum(2)).sqrt()[:, :, None, None]
    panel = panel.flatten(-2)
    s = task.parameters.few
    return panel[:, :, :s], panel[:, :, s:-1], panel[:, :, -1:]


def _pulls(A: Tensor, Z: Tensor, r: Tensor, variance: Tensor, Sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The pull of each view on the intrinsics, in independent directions.

    Returns:
        Its squares `(P, V, s)` in units of the noise's variance; how many times that variance the calibration leaves
        open there `(P, V, s)`; and how many directions the view tells anything of `(P, V)`.
    """
    eliminated = A @ Z.mT @ local_inverse(Z @ Z.mT)[0]
    S = A @ A.mT - eliminated @ (Z @ A.mT)
    u = A @ r.mT - eliminated @ (Z @ r.mT)
    size = S.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt().unsqueeze(-1)
    values, vectors = torch.linalg.eigh((S * size * size.mT).nan_to_num(0.0, 0.0, 0.0))
    told = values > SINGULAR * values[..., -1:].clamp(min=1e-300)
    white = torch.where(told, values.clamp(min=1e-300).rsqrt(), 0.0).unsqueeze(-1) * (vectors * size).mT
    spread = white @ S @ Sigma @ S @ white.mT
    open_, turn = torch.linalg.eigh(spread.nan_to_num(0.0, 0.0, 0.0))
    squares = (turn.mT @ (white @ u)).squeeze(-1).square()
    noise = variance.unsqueeze(-1)
    return squares / noise, open_.clamp(min=0) / noise, told.sum(-1)
