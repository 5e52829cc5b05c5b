"""What is done to every point, twice: the short way and its gradient against the one that is recorded."""

import pytest
import torch
from torch import Tensor

from diffproj._core import numerics
from diffproj.geometry.plane_kernel import direct, recorded

BATCHES = [((), ()), ((3,), (3,)), ((3,), ()), ((2, 3), (3,))]


def example(components: int, points: tuple[int, ...], maps: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
    torch.manual_seed(components)
    kind = {"dtype": torch.float64, "device": "cpu"}
    p, M = torch.randn(*points, 50, components, **kind), torch.randn(*maps, 4, 3, **kind)
    matrix = torch.cat([M, 0.3 * M[..., 3:, :].abs()], dim=-2)
    return p.requires_grad_(), matrix.requires_grad_(), torch.rand(*points, 50, **kind) > 0.2


@pytest.mark.parametrize("components", [2, 3])
@pytest.mark.parametrize(("points", "maps"), BATCHES)
@pytest.mark.parametrize("lens", [False, True])
@pytest.mark.parametrize("short", [False, True])
def test_the_short_way_gives_the_same(
    components: int,
    points: tuple[int, ...],
    maps: tuple[int, ...],
    lens: bool,
    short: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if not short:  # as of many points
        monkeypatch.setattr(numerics, "SHORT", 0)
    p, matrix, seen = example(components, points, maps)
    seen = seen if lens else None
    (slow, valid), (fast, too) = recorded(p, matrix, seen), direct(p, matrix, seen)
    assert torch.equal(valid, too)
    assert 0 < valid.double().mean() < 1
    torch.testing.assert_close(fast, slow)
    with torch.no_grad():
        torch.testing.assert_close(direct(p, matrix, seen)[0], slow)
    weights = torch.where(valid.unsqueeze(-1), torch.randn_like(slow), 0.0)
    first = [torch.autograd.grad(one, (p, matrix), weights, create_graph=True) for one in (slow, fast)]
    second = [torch.autograd.grad(torch.stack([g.square().sum() for g in one]).sum(), (p, matrix)) for one in first]
    torch.testing.assert_close(torch.autograd.grad(fast, (p, matrix), weights), first[0], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(first[1], first[0], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(second[1], second[0], rtol=1e-8, atol=1e-8)


def test_an_input_that_depends_on_the_other_counts_once() -> None:
    p, matrix, _ = example(2, (), ())
    shifted = p + matrix[0, 0]
    slopes = []
    for kernel in (recorded, direct):
        by_matrix = torch.autograd.grad(kernel(shifted, matrix, None)[0].sum(), matrix, create_graph=True)[0]
        slopes.append((by_matrix, torch.autograd.grad(by_matrix.square().sum(), matrix)[0]))
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-8, atol=1e-8)


def test_where_there_is_no_point_nothing_is_asked_of_the_loss() -> None:
    matrix = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0], [0, 0, 0]])
    p = torch.tensor([[1.0, 2], [1, -2], [torch.nan, 1], [torch.inf, 0]], requires_grad=True)
    points, valid = direct(p, matrix, None)
    assert valid.tolist() == [True, False, False, False]
    (by_p,) = torch.autograd.grad(points, p, torch.where(valid.unsqueeze(-1), torch.ones_like(points), torch.nan))
    assert by_p[1:].count_nonzero() == 0
    assert by_p.isfinite().all()


def test_points_may_be_changed_in_place_before_the_gradient() -> None:
    p, matrix, _ = example(2, (), ())
    points, valid = direct(p, matrix, None)
    (expected,) = torch.autograd.grad(points.sum(), p, retain_graph=True)
    points -= 1.0
    valid &= False
    torch.testing.assert_close(torch.autograd.grad(points.sum(), p)[0], expected)


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@pytest.mark.parametrize("components", [2, 3])
def test_a_point_is_the_same_to_rounding_however_many_there_are(
    components: int, kind: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    p, matrix, seen = (part.detach() for part in example(components, (3,), (3,)))
    p, matrix = p.to(kind), matrix.to(kind)
    few = direct(p, matrix, seen)
    monkeypatch.setattr(numerics, "SHORT", 0)
    many = direct(p, matrix, seen)
    torch.testing.assert_close(few[0], many[0])
    assert torch.equal(few[1], many[1])


@pytest.mark.filterwarnings("ignore:There is a performance drop")
def test_gradients_in_a_batch_are_those_one_by_one() -> None:
    p, matrix, _ = example(2, (), ())
    points, _ = direct(p, matrix, None)
    each = torch.eye(points.numel(), dtype=points.dtype).reshape(-1, *points.shape)

    def gradient(v: torch.Tensor) -> torch.Tensor:
        return torch.autograd.grad(points, p, v, retain_graph=True)[0]

    expected = torch.stack([gradient(v) for v in each])
    (batched,) = torch.autograd.grad(points, p, each, is_grads_batched=True, retain_graph=True)
    torch.testing.assert_close(batched, expected)
    torch.testing.assert_close(torch.func.vmap(gradient)(each), expected)
