"""From initial estimates to a fit: solve, reject outliers, solve again.

Everything here works on a batch of P cameras, with batch axes flattened. `Task` defines the minimisation problem;
`fit` runs the solver over it in blocks of cameras.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.fitting.options import Progress
from diffproj.calibration.fitting.surveyed import whitening
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.fitting.two_poses import found_again, settled
from diffproj.calibration.least_squares.eliminated import reduced
from diffproj.calibration.least_squares.everyone import for_each
from diffproj.calibration.least_squares.solver import Solution, select
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results import covariance as covariances
from diffproj.calibration.results.covariance import Covariance

MAX_REJECTION_ROUNDS = 10
"""Maximum number of rounds of outlier rejection."""
HARDLY = 1e-6
"""Variance that is added to that of a residual, relative to the noise: one that the pose takes up tells nothing."""
WEIGHING_ROUNDS = (6, 3)
"""How often uncertain landmarks are weighed anew: where the pixels' noise is estimated, and where it is known."""


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

    def part(self, rows: Tensor) -> "Fit":
        """The fit of some of the cameras `(n,)`."""

        def cut(whole: Any) -> Any:
            if isinstance(whole, Tensor):
                return whole[rows]
            parts = [cut(part) for part in whole]
            return type(whole)(*parts) if hasattr(whole, "_fields") else tuple(parts)

        return Fit(self.task.part(rows), cut(self.solution), self.rejected[rows])

    def alone(self, row: int, views: int) -> "Fit":
        """The fit of one camera with its first views, as if it had been fitted alone."""
        one = self.part(torch.tensor([row], device=self.rejected.device))
        wholes = {name: getattr(one.task, name) for name in ("pixels", "used", "weights", "whitening", "shares")}
        cut = {name: None if whole is None else whole[:, :views] for name, whole in wholes.items()}
        if cut["shares"] is not None and bool((cut["shares"] == 1).all()):
            cut["shares"] = None
        if one.task.prior is not None and not bool(one.task.prior.whole.any()):
            cut["prior"] = None  # which other cameras of the batch needed
        blocks = {name: getattr(one.solution.equations, name)[:, :views] for name in ("E", "W", "h", "c")}
        solution = one.solution._replace(
            local=tuple(z[:, :views] for z in one.solution.local),
            equations=one.solution.equations._replace(**blocks),
        )
        return Fit(replace(one.task, **cut), solution, one.rejected[:, :views])

    @property
    def knows_noise(self) -> bool:
        """Whether the noise was given: a robust loss takes what was given for weights alone."""
        return self.task.known_noise and self.task.loss is None

    def residual_variance(self) -> Tensor:
        """The variance of residuals of weight 1, `(P,)`: `sum |e|^2 / (2 n - parameters)` of least squares.

        NaN without positive degrees of freedom; 1 where the weights say what it is.
        """
        if self.knows_noise:
            return torch.ones_like(self.solution.cost)
        return self.variance_of_residuals()

    def variance_of_residuals(self) -> Tensor:
        """The same as the residuals tell it, whether it is known or not."""
        cost = self.solution.cost
        if self.task.prior is not None:
            off = self.solution.shared.detach() - self.task.prior.mean
            cost = cost - (off.unsqueeze(-2) @ self.task.prior.precision @ off.unsqueeze(-1)).flatten() / 2
        if self.task.restraint is not None:
            moves = self.displacements().unsqueeze(-1)
            cost = cost - (moves.mT @ self.task.restraint.printed @ moves).sum((1, 2, 3)) / 2
        spare = self.degrees_of_freedom()
        return torch.where(spare > 0, 2 * cost / spare, torch.nan)

    def pixel_sigma(self) -> Tensor:
        """Standard deviation of a corner coordinate in pixels, estimated from the reprojection errors, `(P,)`."""
        if self.task.objective == "image" and self.task.loss is None and self.task.weights is None:
            return self.residual_variance().detach().sqrt()
        task, local = self.task, tuple(z.detach() for z in self.solution.local)
        image = replace(task, objective="image").problem.linearise(self.solution.shared.detach(), local)[:, :, -1]
        if task.loss is not None:
            return _robust_sigma(image, task.used, task.shares)
        if self.knows_noise:
            return self._given_sigma()
        spare = self.degrees_of_freedom()
        squares = image.square().sum((2, 3))
        squares = squares if task.shares is None else squares * task.shares
        return torch.where(spare > 0, squares.sum(-1) / spare, torch.nan).sqrt()

    def _given_sigma(self) -> Tensor:
        """The root mean square of the deviations that were given, `(P,)`."""
        weights, used = self.task.weights, self.task.used
        each = torch.ones_like(self.task.pixels[..., 0]) if weights is None else torch.where(used, weights, 1.0)
        variance = torch.where(used, 1 / each, 0.0).sum((1, 2))
        return (variance / used.sum((1, 2)).clamp(min=1)).sqrt()

    def degrees_of_freedom(self) -> Tensor:
        """Number of residual components minus number of free parameters, `(P,)`; views count by their shares."""
        used = self.task.used
        shared = self.task.names if self.task.basis is None else range(self.task.basis.shape[-1])
        spare = 2 * used.sum(-1) - (POSE - self.task.pose_known) * used.any(-1)
        spare = (spare if self.task.shares is None else spare * self.task.shares).sum(-1) - len(shared)
        return spare if self.task.restraint is None else spare + self.restrained

    def displacements(self) -> Tensor:
        """How far free points are from their nominal places `(P, N, 3)`."""
        return self.solution.shared.detach()[:, self.task.parameters.few :].unflatten(-1, (-1, 3))

    @cached_property
    def restrained(self) -> Tensor:
        """How many of the free points' coordinates the frame and the prior tell, and not the corners `(P,)`.

        Of a coordinate that both tell, the part that the prior does: the trace of its precision over all precision.
        """
        few, basis, restraint = self.task.parameters.few, self.task.basis, self.task.restraint
        S = reduced(self.solution.equations, basis, self.task.shares)[0]
        if restraint is None:
            return torch.zeros_like(S[:, 0, 0])
        told = torch.nn.functional.pad(restraint.precision, (few, 0, few, 0))
        told = told if basis is None else basis.mT @ told @ basis
        scale = S.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt().unsqueeze(-1)
        L, failed = torch.linalg.cholesky_ex(S * scale * scale.mT)
        part = torch.cholesky_solve(told * scale * scale.mT, L).diagonal(dim1=-2, dim2=-1).sum(-1)
        return torch.where(failed == 0, part, 0.0)

    @cached_property
    def plain_covariance(self) -> Covariance:
        """The covariance for least squares, whatever the loss and the objective, without graph: what verdicts go by."""
        with torch.inference_mode(False), torch.no_grad():  # kept, also where verdicts run without
            return covariances.covariance(
                self.solution.equations,
                self.task.names,
                self.residual_variance(),
                basis=self.task.basis,
                precision=self.measured_precision(),
                shares=self.task.shares,
                **self.frame(),
            )

    def frame(self) -> dict[str, Any]:
        """What `covariance` is to know of free points: what fixes their frame, and which of them nothing tells."""
        if self.task.restraint is None:
            return {}
        few = self.task.parameters.few
        unknown = torch.nn.functional.pad(self.task.restraint.unknown, (few, 0))
        parts = {"frame": self.task.restraint.frame, "printed": self.task.restraint.measured}
        wide = {name: torch.nn.functional.pad(part, (few, 0, few, 0)) for name, part in parts.items()}
        return {**wide, "unseen": unknown}

    def measured_precision(self) -> Tensor | None:
        """That part of the prior's precision which stands for a measurement `(P, s, s)`; the rest only restrains."""
        prior = self.task.prior
        return None if prior is None else prior.precision if prior.known is None else prior.known

    def has_prior(self) -> Tensor:
        """Of which cameras something is known beforehand `(P,)`; a lens that is restrained needs a prior, too."""
        known = self.measured_precision()
        return torch.zeros_like(self.rejected[:, 0, 0]) if known is None else (known != 0).any(-1).any(-1)

    def is_restrained(self) -> Tensor:
        """Which cameras' terms below the line are held near those of a poorer lens `(P,)`."""
        return self.restrained_parameters().any(-1)

    def restrained_parameters(self) -> Tensor:
        """Which of the shared parameters are `(P, s)`."""
        prior = self.task.prior
        if prior is None or prior.known is None:
            return torch.zeros_like(self.solution.shared, dtype=torch.bool)
        return (prior.precision != prior.known).any(-1)


def fit(
    task: Task,
    shared: Tensor,
    local: tuple[Tensor, ...],
    *,
    reject: float | None = None,
    max_iterations: int | Tensor = 300,
    tolerance: float = 3e-14,
    progress: Progress | None = None,
) -> Fit:
    """Minimise; with `reject`, leave out corners whose residual exceeds that many robust std, and repeat.

    A camera's robust std is 1.4826 times the median absolute residual component (Rousseeuw and Leroy 1987); where the
    noise is known, that counts: see `inliers`. At most `MAX_REJECTION_ROUNDS` rounds are run. `max_iterations` of the
    solver is one number, or one for each camera `(P,)`.
    """
    with torch.inference_mode():  # a fifth faster where call overhead dominates; derivatives are added afterwards
        found = _fit(task, shared, local, reject, max_iterations, tolerance, progress)
        if task.spread is not None:
            for _ in range(WEIGHING_ROUNDS[task.known_noise]):
                state = found.solution.shared, found.solution.local
                matrices = whitening(found.task, *state, found.residual_variance())
                again = _fit(replace(found.task, whitening=matrices), *state, reject, max_iterations, tolerance, None)
                found = Fit(again.task, again.solution, found.rejected | again.rejected)
    return Fit(*normal_tensors((found.task, found.solution, found.rejected)))


def _fit(
    task: Task,
    shared: Tensor,
    local: tuple[Tensor, ...],
    reject: float | None,
    max_iterations: int | Tensor,
    tolerance: float,
    progress: Progress | None,
) -> Fit:
    given = near = task.used
    rounds = 1 if reject is None else 1 + MAX_REJECTION_ROUNDS
    most = max(for_each(max_iterations, shared).tolist())
    total = rounds * most

    def attempt(task: Task, shared: Tensor, local: tuple[Tensor, ...], done: int) -> Solution:
        def tell(step: int, _: int) -> None:
            if progress is not None:
                progress(done * most + step, total)

        return settled(task, shared, local, max_iterations=max_iterations, tolerance=tolerance, progress=tell)

    solution = attempt(task, shared, local, 0)
    iterations = solution.iterations
    if reject is not None:
        for done in range(1, rounds):
            # Views left with fewer than four corners are no longer used; their pose is sought anew, they may come back.
            every = replace(task, used=given)
            solution = found_again(every, solution, ~task.used.any(-1))
            near = inliers(every, task.used, solution, reject)
            kept = near & (near.sum(-1, keepdim=True) >= 4)
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
    return Fit(task, solution._replace(iterations=iterations), given & ~near)


def normal_tensors(value: Any) -> Any:
    """Inference-mode tensors, and tuples and tasks of them, copied to normal tensors, which autograd accepts."""
    if isinstance(value, Tensor):
        return value.clone() if value.is_inference() else value
    if isinstance(value, Task):
        return replace(value, used=normal_tensors(value.used))
    parts = [normal_tensors(part) for part in value]
    return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)


def inliers(task: Task, used: Tensor, solution: Solution, limit: float) -> Tensor:
    """Which corners are inliers `(P, V, N)`, by their weighted residuals.

    Where the noise is known, the limit is in its deviations; then of each view with more than four corners the one that
    speaks most against the others is left out, too, and no more of them at a time: among few corners a wrong one makes
    all residuals large, its own even less so than others' (Baarda 1968).

    Args:
        task: with all corners that may count.
        used: those of them that the solution was found from `(P, V, N)`.
        solution: the last.
        limit: in standard deviations.
    """
    panel = task.problem.linearise(solution.shared, solution.local)
    if task.weights is not None:
        panel = panel * task.weights.sqrt()[:, :, None, None]
    residual = panel[:, :, -1]
    met = panel.isfinite().all(2).all(2)  # what lies behind the camera is no inlier, and tells of no other
    # With exact corners the residuals are rounding errors, none of which may count as an outlier.
    least = 1e-6 if task.objective == "image" else 1e-9 * float(task.points.abs().amax())
    known = task.known_noise and task.loss is None
    sigma = _robust_sigma(residual, task.used, task.shares).clamp(min=1.0 if known else least)
    near = residual.square().sum(2) <= (limit * sigma[:, None, None]).square()
    if known:
        size = _against_others(panel[:, :, -7:-1], residual, used & met)
        worst = size == torch.where(used, size, -1.0).amax(-1, keepdim=True)
        alone = ~used | (worst & (used.sum(-1, keepdim=True) > 4))
        near = near & ~(alone & (size > limit**2))
    return task.used & near


def _against_others(by_pose: Tensor, residual: Tensor, used: Tensor) -> Tensor:
    """The squares of residuals `(P, V, 2, N)` over their covariance, of noise 1 and a pose found from the used ones."""
    rows = torch.where(used[:, :, None, None], by_pose, 0.0).flatten(-2)
    W = rows @ rows.mT
    size = W.diagonal(dim1=-2, dim2=-1)
    scale = torch.where(size > 0, size, 1.0).rsqrt()
    inverse = torch.linalg.pinv(W * scale.unsqueeze(-1) * scale.unsqueeze(-2), hermitian=True)
    J = (by_pose * scale[..., None, None]).permute(0, 1, 4, 3, 2)  # (P, V, N, 2, 6)
    taken = J @ inverse.unsqueeze(2) @ J.mT
    identity = torch.eye(2, dtype=J.dtype, device=J.device)
    C = identity + torch.where(used[..., None, None], -1.0, 1.0) * taken + HARDLY * identity
    e = residual.mT.unsqueeze(-1)
    return (e.mT @ torch.linalg.solve_ex(C, e)[0]).squeeze(-1).squeeze(-1).nan_to_num(0.0).clamp(min=0)


def _robust_sigma(residual: Tensor, used: Tensor, shares: Tensor | None) -> Tensor:
    """Robust std `(P,)`: 1.4826 times the median size of residuals' components `(P, V, 2, N)`, copies counted once."""
    size = torch.where(used.unsqueeze(2), residual.abs(), torch.nan)
    if shares is None:
        return 1.4826 * size.flatten(1).nanmedian(-1).values
    size, order = size.flatten(1).sort(-1)  # NaN comes last
    weight = (used * shares.unsqueeze(-1)).unsqueeze(2).expand(residual.shape).flatten(1).gather(1, order).cumsum(-1)
    middle = (weight >= (0.5 - 1e-12) * weight[:, -1:]).to(torch.uint8).argmax(-1, keepdim=True)
    return 1.4826 * size.gather(1, middle).squeeze(-1)
