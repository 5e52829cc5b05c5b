"""From initial estimates to a fit: solve, reject outliers, solve again; and the covariance of the result.

Everything here works on a batch of P cameras, with batch axes flattened. `Task` defines the minimisation problem;
`fit` runs the solver over it in blocks of cameras.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration import covariance as covariances
from diffproj.calibration.covariance import Covariance, Scores
from diffproj.calibration.losses import Loss
from diffproj.calibration.options import Progress
from diffproj.calibration.parametrisation import POSE
from diffproj.calibration.solver import Equations, Solution, select
from diffproj.calibration.task import Task
from diffproj.calibration.two_poses import found_again, settled

MAX_REJECTION_ROUNDS = 10
"""Maximum number of rounds of outlier rejection."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The fit of P cameras.

    Attributes:
        task: the problem, with the corners used in the last round.
        solution: the solver's.
        rejected: outliers `(P, V, N)`.
    """

    task: Task
    solution: Solution
    rejected: Tensor

    def residual_variance(self) -> Tensor:
        """`sum |e|^2 / (2 n - parameters)` of least squares, `(P,)`; NaN without positive degrees of freedom."""
        cost = self.solution.cost
        if self.task.prior is not None:
            off = self.solution.shared.detach() - self.task.prior.mean
            cost = cost - (off.unsqueeze(-2) @ self.task.prior.precision @ off.unsqueeze(-1)).flatten() / 2
        spare = self.degrees_of_freedom()
        return torch.where(spare > 0, 2 * cost / spare, torch.nan)

    def pixel_sigma(self) -> Tensor:
        """Standard deviation of a corner coordinate in pixels, estimated from the reprojection errors, `(P,)`."""
        if self.task.objective == "image" and self.task.loss is None and self.task.weights is None:
            return self.residual_variance().detach().sqrt()
        task, local = self.task, tuple(z.detach() for z in self.solution.local)
        image = replace(task, objective="image").problem.linearise(self.solution.shared.detach(), local)[:, :, -1]
        if task.loss is not None:
            return _robust_sigma(image, task.used)
        spare = self.degrees_of_freedom()
        return torch.where(spare > 0, image.square().sum((1, 2, 3)) / spare, torch.nan).sqrt()

    def degrees_of_freedom(self) -> Tensor:
        """Number of residual components minus number of free parameters, `(P,)`."""
        used = self.task.used
        shared = self.task.names if self.task.basis is None else range(self.task.basis.shape[-1])
        return 2 * used.sum((-2, -1)) - len(shared) - POSE * used.any(-1).sum(-1)

    def plain_covariance(self) -> Covariance:
        """The covariance for least squares with equal weights."""
        return covariances.covariance(
            self.solution.equations,
            self.task.names,
            self.residual_variance(),
            basis=self.task.basis,
            precision=self._measured_precision(),
        )

    def covariance(self) -> Covariance:
        """The covariance, in the sandwich form where the task needs it: see `diffproj.calibration.covariance`."""
        task = self.task
        if task.weights is None and task.loss is None and task.objective == "image":
            return self.plain_covariance()
        shared, local = self.solution.shared.detach(), tuple(z.detach() for z in self.solution.local)
        panel = task.problem.linearise(shared, local)
        rows, residual = panel[:, :, :-1], panel[:, :, -1]
        score = (rows * residual.unsqueeze(2)).sum(3)  # (P, V, s + 6, N): per corner, unweighted
        squared = residual.square().sum(2)
        weight = torch.ones_like(squared) if task.weights is None else task.weights
        slope, bend = _derivatives(task.loss, squared)
        flat = rows.flatten(-2)
        both = (weight * slope).unsqueeze(2)
        H = (flat * both.repeat(1, 1, 1, 2)) @ flat.mT + (score * (2 * weight * bend).unsqueeze(2)) @ score.mT
        kept = self._finite_sample_factor(weight, slope, bend, squared)[:, None, None, None]
        M = (score * both.square()) @ score.mT / kept
        s = len(task.names)
        U = H[..., :s, :s].sum(1)
        precision = None if task.prior is None else task.prior.precision
        spread = self._measured_precision()
        if precision is not None and spread is not None and spread is not precision:
            # What only restrains is as uncertain as the residuals say.
            spread = spread + self.residual_variance().nan_to_num(0.0)[:, None, None] * (precision - spread)
        return covariances.covariance(
            Equations(
                U if precision is None else U + precision,
                H[..., :s, s:],
                H[..., s:, s:],
                *self.solution.equations[3:],
            ),
            task.names,
            torch.ones_like(U[:, 0, 0]),
            basis=task.basis,
            precision=spread,
            scores=Scores(M[..., :s, :s], M[..., :s, s:], M[..., s:, s:]),
        )

    def _measured_precision(self) -> Tensor | None:
        prior = self.task.prior
        return None if prior is None else prior.precision if prior.known is None else prior.known

    def _finite_sample_factor(self, weight: Tensor, slope: Tensor, bend: Tensor, squared: Tensor) -> Tensor:
        """Finite-sample correction of the sandwich covariance: how much fitting shrinks squared scores, `(P,)`.

        Fitting reduces a residual of leverage h by `h psi(e) / mean A`, with psi the score and A its derivative. To
        first order in the mean leverage h (parameters over residual components), mean `psi^2` is reduced by the factor

            1 - h (2 mean(psi A psi) / (mean(psi^2) mean A) - mean(A^2) / (mean A)^2)

        which is 1 - h for least squares, and closer to 1 with outliers, whose bounded score hardly changes. The factor
        is at least 0.1.
        """
        used = self.task.used.to(squared)
        n = used.sum((-2, -1))
        h = 1 - self.degrees_of_freedom() / (2 * n)

        def mean(values: Tensor) -> Tensor:
            return (values * used).sum((-2, -1)) / n

        psi = (weight * slope).square() * squared
        A = weight * (slope + bend * squared)
        A_squared = weight.square() * (slope.square() + 2 * slope * bend * squared + 2 * (bend * squared).square())
        psi_A_psi = weight * (slope + 2 * bend * squared) * psi
        taken = 2 * mean(psi_A_psi) / (mean(psi) * mean(A)) - mean(A_squared) / mean(A).square()
        return (1 - h * taken).clamp(min=0.1)


def fit(
    task: Task,
    shared: Tensor,
    local: tuple[Tensor, ...],
    *,
    reject: float | None = None,
    max_iterations: int = 300,
    tolerance: float = 3e-14,
    progress: Progress | None = None,
) -> Fit:
    """Minimise; with `reject`, leave out corners whose residual exceeds that many robust std, and repeat.

    A camera's robust std is 1.4826 times the median absolute residual component (Rousseeuw and Leroy 1987). At most
    `MAX_REJECTION_ROUNDS` rounds are run.
    """
    with torch.inference_mode():  # a fifth faster where call overhead dominates; derivatives are added afterwards
        found = _fit(task, shared, local, reject, max_iterations, tolerance, progress)
    return Fit(*normal_tensors((found.task, found.solution, found.rejected)))


def _fit(
    task: Task,
    shared: Tensor,
    local: tuple[Tensor, ...],
    reject: float | None,
    max_iterations: int,
    tolerance: float,
    progress: Progress | None,
) -> Fit:
    given = inliers = task.used
    rounds = 1 if reject is None else 1 + MAX_REJECTION_ROUNDS
    total = rounds * max_iterations

    def attempt(task: Task, shared: Tensor, local: tuple[Tensor, ...], done: int) -> Solution:
        def tell(step: int, _: int) -> None:
            if progress is not None:
                progress(done * max_iterations + step, total)

        return settled(task, shared, local, max_iterations=max_iterations, tolerance=tolerance, progress=tell)

    solution = attempt(task, shared, local, 0)
    iterations = solution.iterations
    if reject is not None:
        for done in range(1, rounds):
            # Views left with fewer than four corners are no longer used; their pose is sought anew, they may come back.
            every = replace(task, used=given)
            solution = found_again(every, solution, ~task.used.any(-1))
            inliers = _inliers(every, solution, reject)
            kept = inliers & (inliers.sum(-1, keepdim=True) >= 4)
            changed = (kept != task.used).any(-1).any(-1)
            if not bool(changed.any()):
                break
            task = replace(task, used=kept)
            again = attempt(task, solution.shared, solution.local, done)
            # Cameras whose inliers did not change keep their solution to the bit.
            solution = select(changed.numpy(force=True), again, solution)
            iterations = iterations + torch.where(changed, again.iterations, 0)
    if progress is not None:
        progress(total, total)
    return Fit(task, solution._replace(iterations=iterations), given & ~inliers)


def normal_tensors(value: Any) -> Any:
    """Inference-mode tensors, and tuples and tasks of them, copied to normal tensors, which autograd accepts."""
    if isinstance(value, Tensor):
        return value.clone() if value.is_inference() else value
    if isinstance(value, Task):
        return replace(value, used=normal_tensors(value.used))
    parts = [normal_tensors(part) for part in value]
    return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)


def _inliers(task: Task, solution: Solution, limit: float) -> Tensor:
    """Which of the given corners are inliers `(P, V, N)`, by their weighted residuals."""
    residual = task.problem.linearise(solution.shared, solution.local)[:, :, -1]
    if task.weights is not None:
        residual = residual * task.weights.sqrt().unsqueeze(2)
    # With exact corners the residuals are rounding errors, none of which may count as an outlier.
    least = 1e-6 if task.objective == "image" else 1e-9 * float(task.points.abs().amax())
    sigma = _robust_sigma(residual, task.used).clamp(min=least)
    return task.used & (residual.square().sum(2) <= (limit * sigma[:, None, None]).square())


def _robust_sigma(residual: Tensor, used: Tensor) -> Tensor:
    """Robust std `(P,)`: 1.4826 times the median absolute component of residuals `(P, V, 2, N)`."""
    return 1.4826 * torch.where(used.unsqueeze(2), residual.abs(), torch.nan).flatten(1).nanmedian(-1).values


def _derivatives(loss: Loss | None, squared: Tensor) -> tuple[Tensor, Tensor]:
    """First and second derivative, rho' and rho'', of the loss by the squared residual."""
    if loss is None:
        return torch.ones_like(squared), torch.zeros_like(squared)
    with torch.enable_grad():
        e2 = squared.detach().requires_grad_()
        slope = loss.weight(e2)
        bend = torch.autograd.grad(slope.sum(), e2, allow_unused=True)[0] if slope.requires_grad else None
    return slope.detach(), torch.zeros_like(squared) if bend is None else bend
