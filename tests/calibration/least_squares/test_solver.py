"""The Schur-complement solver on a problem without cameras: curves that share a decay and have a line each."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from diffproj.calibration.least_squares.damping import DampingControl
from diffproj.calibration.least_squares.losses import Cauchy, Huber, SoftL1
from diffproj.calibration.least_squares.normal_equations import damped_step
from diffproj.calibration.least_squares.solver import Prior, Status, solve

D = torch.float64


@dataclass
class Curves:
    """`a exp(-b x) + b^2 + c_v + d_v x` at N places x, measured twice (k = 2), for P problems of V curves."""

    x: torch.Tensor
    seen: torch.Tensor  # (P, V, 2, N)

    def linearise(self, shared: torch.Tensor, local: tuple[torch.Tensor, ...]) -> torch.Tensor:
        a, b = shared[:, None, None, None].unbind(-1)
        c, d = local[0][:, :, None, None].unbind(-1)
        decay = torch.exp(-b * self.x).expand(self.seen.shape)
        rows = [decay, -a * self.x * decay + 2 * b, torch.ones_like(decay), self.x.expand(self.seen.shape)]
        return torch.stack([*rows, a * decay + b**2 + c + d * self.x - self.seen], dim=2)

    def retract(self, local: tuple[torch.Tensor, ...], step: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return (local[0] + step,)


def curves(P: int = 3, V: int = 7, N: int = 20, noise: float = 0.05) -> tuple[Curves, torch.Tensor, torch.Tensor]:
    x = torch.linspace(0, 3, N, dtype=D)
    shared = torch.tensor([2.0, 1.3], dtype=D) + 0.3 * torch.rand(P, 2, dtype=D)
    local = torch.randn(P, V, 2, dtype=D)
    problem = Curves(x, torch.zeros(P, V, 2, N, dtype=D))
    problem.seen = problem.linearise(shared, (local,))[:, :, -1] + noise * torch.randn(P, V, 2, N, dtype=D)
    return problem, shared, local


def rough(shared: torch.Tensor, local: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor]]:
    return 0.6 * shared, (torch.zeros_like(local),)


def run(problem: Curves, shared: torch.Tensor, local: torch.Tensor, **options: object):
    return solve(problem, *rough(shared, local), local_size=2, **options)  # type: ignore[arg-type]


def dense_step(
    panel: torch.Tensor, damping: float, prior: Prior | None, off: torch.Tensor, basis: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The damped step of one problem, and what the quadratic model falls by, of the normal equations as a whole."""
    V, rows = panel.shape[:2]
    s = rows - 3
    J = torch.zeros(V, *panel.shape[2:], s + 2 * V, dtype=D)
    for v in range(V):
        J[v, ..., :s] = panel[v, :s].permute(1, 2, 0)
        J[v, ..., s + 2 * v : s + 2 * v + 2] = panel[v, s : s + 2].permute(1, 2, 0)
    J, e = J.reshape(-1, s + 2 * V), panel[:, -1].reshape(-1)
    H, g = J.mT @ J, J.mT @ e
    if prior is not None:
        H[:s, :s] += prior.precision[0]
        g[:s] += prior.precision[0] @ off
    T = torch.block_diag(basis, torch.eye(2 * V, dtype=D))
    H, g = T.mT @ H @ T, T.mT @ g
    step = -torch.linalg.solve(H + damping * torch.diag(H.diagonal()), g)
    return T @ step, -(g @ step + step @ H @ step / 2)


@pytest.mark.parametrize("damping", [1e-9, 1e-6, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize("with_prior", [False, True])
@pytest.mark.parametrize("columns", [[[1.0, 0.0], [0.0, 1.0]], [[0.0], [1.0]], [[0.6], [0.8]], [[], []]])
def test_a_step_is_that_of_the_dense_normal_equations(
    damping: float, with_prior: bool, columns: list[list[float]]
) -> None:
    from diffproj.calibration.least_squares.solver import _Terms

    problem, shared, local = curves(P=1)
    basis = torch.tensor(columns, dtype=D)
    prior = Prior(shared + 1, torch.diag_embed(torch.full_like(shared, 7.0))) if with_prior else None
    x, z = rough(shared, local)
    _, equations = _Terms(problem, 2, None, None, prior).at(x, z)
    off = x[0] - prior.mean[0] if prior is not None else torch.zeros(2, dtype=D)
    want, gain = dense_step(problem.linearise(x, z)[0], damping, prior, off, basis)
    for given in (basis.unsqueeze(0), *([None] if basis.shape[1] == 2 else [])):
        dx, dz, reduction = damped_step(equations, torch.tensor([damping], dtype=D), given)
        got = torch.cat([dx[0], dz[0].reshape(-1)])
        torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-12 * float(want.abs().amax()))
        torch.testing.assert_close(reduction[0], gain, rtol=1e-9, atol=0)


def test_a_step_that_cannot_be_found_is_none_and_changes_no_other() -> None:
    """Of a problem whose equations are not finite, or not positive definite; one that sees nothing stays there."""
    from diffproj.calibration.least_squares.solver import _Terms

    problem, shared, local = curves(P=4)
    _, equations = _Terms(problem, 2, None, None, None).at(*rough(shared, local))
    damping = torch.full((4,), 1e-3, dtype=D)
    good = damped_step(equations, damping)
    broken = equations._replace(U=equations.U.clone(), W=equations.W.clone(), E=equations.E.clone())
    broken.U[0, 0, 0] = -1e6
    broken.W[1, 3] = torch.nan
    broken.W[2, 3], broken.E[2, 3], broken.h[2, 3] = 0.0, 0.0, 0.0  # nothing seen of one block
    dx, dz, reduction = damped_step(broken, damping)
    assert (dx[:2] == 0).all()
    assert (dz[:2] == 0).all()
    assert reduction[:2].tolist() == [torch.inf] * 2
    assert (dz[2, 3] == 0).all()
    assert dz[2].isfinite().all()
    assert reduction[2].isfinite()
    for now, before in zip((dx, dz, reduction), good, strict=True):
        assert torch.equal(now[3], before[3])


def test_finds_the_minimum() -> None:
    problem, shared, local = curves(noise=0.0)
    solution = run(problem, shared, local, negligible=1e-20)
    assert (solution.status == Status.CONVERGED).all()
    torch.testing.assert_close(solution.shared, shared, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(solution.local[0], local, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("loss", [None, Huber(0.05), SoftL1(0.05), Cauchy(0.1)])
def test_gradient_is_zero_at_the_minimum(loss: object) -> None:
    problem, shared, local = curves()
    weights = torch.rand(3, 7, 20, dtype=D)
    prior = Prior(shared, torch.diag_embed(torch.full_like(shared, 5.0)))
    solution = run(problem, shared, local, loss=loss, weights=weights, prior=prior, tolerance=1e-15, max_iterations=400)
    assert (solution.status == Status.CONVERGED).all()
    x, z = solution.shared.clone().requires_grad_(), solution.local[0].clone().requires_grad_()
    squared = problem.linearise(x, (z,))[:, :, -1].square().sum(-2)
    value = squared if loss is None else loss.value(squared)  # type: ignore[attr-defined]
    cost = (weights * value).sum((1, 2)) / 2 + 2.5 * (x - shared).square().sum(-1)
    torch.testing.assert_close(cost, solution.cost, rtol=1e-12, atol=0)
    gradients = torch.autograd.grad(cost.sum(), (x, z))
    assert max(float(g.abs().amax()) for g in gradients) < 1e-6


def test_cost_never_rises_and_progress_is_told() -> None:
    problem, shared, local = curves()
    history: list[torch.Tensor] = []
    solution = solve(
        problem, 5 * shared, (0 * local,), local_size=2, progress=lambda step, cost: history.append(cost.clone())
    )
    costs = torch.stack(history)
    assert (costs[1:] <= costs[:-1]).all()
    assert len(history) == solution.iterations.max()


def test_a_batch_gives_what_a_loop_gives() -> None:
    problem, shared, local = curves()
    together = run(problem, shared, local)
    for p in range(3):
        alone = run(Curves(problem.x, problem.seen[p : p + 1]), shared[p : p + 1], local[p : p + 1])
        torch.testing.assert_close(alone.shared[0], together.shared[p], rtol=1e-9, atol=1e-9)
        assert alone.iterations[0] == together.iterations[p]


def test_those_still_moving_go_on_alone_and_all_end_as_they_would() -> None:
    sizes = []

    @dataclass
    class Parted(Curves):
        def linearise(self, shared: torch.Tensor, local: tuple[torch.Tensor, ...]) -> torch.Tensor:
            sizes.append(len(shared))
            return super().linearise(shared, local)

        def part(self, which: torch.Tensor) -> "Parted":
            return Parted(self.x, self.seen[which])

    problem, shared, local = curves(P=20)
    weights = torch.rand(20, 7, 20, dtype=D) + 0.5
    prior = Prior(shared + 0.01, torch.diag_embed(torch.full_like(shared, 5.0)))
    basis = torch.eye(2, dtype=D).repeat(20, 1, 1)
    start, z = rough(shared, local)
    start = torch.where((torch.arange(20) % 7 == 3).unsqueeze(-1), start, shared)  # three are far off
    costs: list[torch.Tensor] = []
    options = {"local_size": 2, "loss": Huber(0.05)}
    found = solve(
        Parted(problem.x, problem.seen),
        start,
        z,
        weights=weights,
        prior=prior,
        basis=basis,
        progress=lambda _, cost: costs.append(cost.clone()),
        **options,  # type: ignore[arg-type]
    )
    assert sizes[0] == 20
    assert sizes[-1] <= 7
    assert {len(cost) for cost in costs} == {20}
    assert (costs[-1] <= costs[0]).all()
    for p in range(20):
        one = slice(p, p + 1)
        alone = solve(
            Curves(problem.x, problem.seen[one]),
            start[one],
            tuple(part[one] for part in z),
            weights=weights[one],
            prior=prior.part(one),
            basis=basis[one],
            **options,  # type: ignore[arg-type]
        )
        torch.testing.assert_close(found.shared[p], alone.shared[0], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(found.local[0][p], alone.local[0][0], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(found.equations.U[p], alone.equations.U[0], rtol=1e-6, atol=1e-6)
        assert (found.iterations[p], found.status[p]) == (alone.iterations[0], alone.status[0])


def test_a_hopeless_neighbour_changes_no_bit() -> None:
    problem, shared, local = curves()
    good = run(problem, shared, local)
    problem.seen[1, 2, 0, 3] = torch.nan
    mixed = run(problem, shared, local)
    assert mixed.status.tolist() == [Status.CONVERGED, Status.DIVERGED, Status.CONVERGED]
    for p in (0, 2):
        assert torch.equal(good.shared[p], mixed.shared[p])
        assert torch.equal(good.local[0][p], mixed.local[0][p])
        assert torch.equal(good.cost[p], mixed.cost[p])
    assert torch.equal(mixed.shared[1], 0.6 * shared[1])  # it stays where it was


def test_frozen_and_tied_unknowns() -> None:
    problem, shared, local = curves()
    frozen = torch.tensor([[1.0], [0.0]], dtype=D).expand(3, 2, 1)
    solution = run(problem, shared, local, basis=frozen)
    assert torch.equal(solution.shared[:, 1], 0.6 * shared[:, 1])
    # A stiff prior at the start says the same as freezing.
    stiff = torch.diag_embed(torch.tensor([0.0, 1e14], dtype=D)).expand(3, 2, 2)
    again = run(problem, shared, local, prior=Prior(0.6 * shared, stiff))
    torch.testing.assert_close(solution.shared[:, 0], again.shared[:, 0], rtol=1e-6, atol=0)
    tied = (0.6 * shared).unsqueeze(-1)
    solution = run(problem, shared, local, basis=tied)
    torch.testing.assert_close(
        solution.shared[:, 0] / solution.shared[:, 1], shared[:, 0] / shared[:, 1], rtol=1e-12, atol=0
    )
    held = run(problem, shared, local, basis=torch.zeros(3, 2, 0, dtype=D))
    assert torch.equal(held.shared, 0.6 * shared)
    assert (held.status == Status.CONVERGED).all()


def test_says_when_it_was_stopped_early() -> None:
    problem, shared, local = curves()
    solution = run(problem, shared, local, max_iterations=2)
    assert (solution.status == Status.MAX_ITERATIONS).all()
    assert (solution.iterations == 2).all()


def test_says_when_no_step_helps() -> None:
    class Wrong(Curves):
        def linearise(self, shared: torch.Tensor, local: tuple[torch.Tensor, ...]) -> torch.Tensor:
            panel = super().linearise(shared, local).clone()
            panel[:, :, :-1] *= -1  # every step goes uphill
            return panel

    problem, shared, local = curves()
    solution = run(Wrong(problem.x, problem.seen), shared, local, max_iterations=200)
    assert (solution.status == Status.DIVERGED).all()
    assert torch.equal(solution.shared, 0.6 * shared)


def test_exact_data_end_at_once() -> None:
    problem, shared, local = curves(noise=0.0)
    solution = solve(problem, shared, (local,), local_size=2, negligible=1e-20)
    assert (solution.status == Status.CONVERGED).all()
    assert (solution.iterations == 0).all()


def test_unobservable_directions_stay() -> None:
    problem, shared, local = curves()
    problem.x = torch.zeros_like(problem.x)  # only a + b^2 + c_v matters
    solution = run(problem, shared, local)
    assert (solution.status == Status.CONVERGED).all()
    assert torch.equal(solution.local[0][..., 1], torch.zeros(3, 7, dtype=D))


@pytest.mark.parametrize("loss", [Huber(0.7), SoftL1(0.7), Cauchy(0.7)])
def test_losses(loss: Huber | SoftL1 | Cauchy) -> None:
    squared = torch.tensor([0.0, 1e-12, 0.3, 0.48, 0.5, 2.0, 1e6], dtype=D, requires_grad=True)
    assert torch.autograd.gradcheck(loss.value, squared[1:].detach().requires_grad_())
    slope = torch.autograd.grad(loss.value(squared).sum(), squared, create_graph=True)[0]
    torch.testing.assert_close(slope, loss.weight(squared), rtol=1e-12, atol=1e-15)
    bend = torch.autograd.grad(slope.sum(), squared)[0]
    assert bend.isfinite().all()
    assert float(loss.value(squared)[0].detach()) == 0
    assert float(loss.weight(squared)[0].detach()) == 1
    with pytest.raises(ValueError, match="scale: want a positive number"):
        type(loss)(0.0)


def test_each_problem_may_have_its_own_number_of_steps() -> None:
    problem, shared, local = curves()
    limits = torch.tensor([1, 50, 2])
    together = run(problem, shared, local, max_iterations=limits)
    assert together.iterations.tolist()[::2] == [1, 2]
    assert together.status.tolist() == [Status.MAX_ITERATIONS, Status.CONVERGED, Status.MAX_ITERATIONS]
    for i, limit in enumerate(limits.tolist()):
        alone = Curves(problem.x, problem.seen[i : i + 1])
        one = run(alone, shared[i : i + 1], local[i : i + 1], max_iterations=limit)
        torch.testing.assert_close(together.shared[i], one.shared[0], rtol=1e-12, atol=1e-12)


def test_a_step_that_leaves_nothing_to_gain_is_the_last() -> None:
    """Each step gains a tenth of the one before: the one after the current may be within the tolerance already."""
    tolerance, cost = 1e-10, np.ones(2)
    control = DampingControl(cost, np.zeros(2), np.full(2, 9))
    first = np.array([9e-9, 9e-8])
    assert not control.stop(first, tolerance).any()
    assert control.stop(0.1 * first, tolerance).tolist() == [True, False]  # the next gain 9e-11 and 9e-10
    assert control.stop(0.01 * first, tolerance).tolist() == [False, True]
    assert control.status.tolist() == [Status.CONVERGED] * 2


def test_a_wide_tolerance_ends_early() -> None:
    """Also beyond the reduction up to which the last step is taken without a look at where it leads."""
    problem, shared, local = curves()
    near, exact = (run(problem, shared, local, tolerance=tolerance) for tolerance in (1e-3, 1e-14))
    assert bool((near.status == Status.CONVERGED).all())
    assert bool((near.iterations < exact.iterations).all())
    assert bool((near.cost <= exact.cost * 1.01).all())
