"""Derivatives of the lenses: reverse, forward, second order, under transforms, at and around every singular point."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad, gradcheck, gradgradcheck
from torch.func import grad, jacfwd, jacrev, jvp, vmap

from diffproj.lens import plan
from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.kannala_brandt import KannalaBrandt

Kind = type[BrownConrady] | type[KannalaBrandt]

LENSES: dict[str, tuple[Kind, list[float]]] = {
    "brown4": (BrownConrady, [-0.27, 0.03, 0.002, -0.001]),
    "brown5": (BrownConrady, [-0.2535, 0.0924, -0.0006, 0.0007, -0.0191]),
    "brown8": (BrownConrady, [-0.3, 0.1, 1e-3, 2e-3, -0.02, 0.05, 0.02, 0.01]),
    "brown14": (
        BrownConrady,
        [-0.25, 0.09, -6e-4, 7e-4, -0.02, 0.01, -0.003, 0.001, 1e-3, -1e-4, 2e-3, 1e-4, 0.02, -0.03],
    ),
    "fisheye": (KannalaBrandt, [-0.02, 0.005, -0.001, 0.0001]),
}
SLOW_WITH_MANY = [
    name if name not in ("brown8", "brown14") else pytest.param(name, marks=pytest.mark.slow) for name in LENSES
]
CENTRE = [[0.0, 0.0], [1e-12, 0.0], [0.0, -1e-12], [1e-12, 1e-12]]
INVALID = [[5000.0, 4000.0], [math.nan, 0.1], [0.1, math.inf], [-3000.0, 0.0]]


def tensor(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def lens_of(name: str) -> tuple[Kind, Tensor, float]:
    kind, coefficients = LENSES[name]
    return kind, tensor(coefficients), float(kind(tensor(coefficients)).domain)


def undistorted(name: str, shares: tuple[float, ...] = (0.2, 0.6, 0.9)) -> Tensor:
    """Undistorted points or directions at shares of the domain."""
    kind, _, domain = lens_of(name)
    angle = torch.arange(len(shares), dtype=torch.float64) * 2.1 + 0.3
    ray = torch.stack([angle.cos(), angle.sin()], -1)
    reach = tensor(shares).unsqueeze(-1) * domain
    if kind is BrownConrady:
        return torch.cat([ray * reach, torch.ones_like(reach)], dim=-1)
    return torch.cat([ray * reach.sin(), reach.cos()], dim=-1)


def distorted(name: str, shares: tuple[float, ...] = (0.2, 0.6, 0.9)) -> Tensor:
    kind, coefficients, _ = lens_of(name)
    return kind(coefficients).project_direction(undistorted(name, shares))[0]


def inverse(kind: Kind) -> Callable[[Tensor, Tensor], Tensor]:
    return lambda xy, coefficients: kind(coefficients).unproject(xy)[0]


def forward(kind: Kind) -> Callable[[Tensor, Tensor], Tensor]:
    return lambda direction, coefficients: kind(coefficients).project_direction(direction)[0]


@pytest.mark.parametrize("name", SLOW_WITH_MANY)
def test_inverse_and_forward_to_second_order(name: str) -> None:
    kind, coefficients, _ = lens_of(name)
    for function, points in ((inverse(kind), distorted(name)), (forward(kind), undistorted(name))):
        arguments = points.requires_grad_(), coefficients.clone().requires_grad_()
        assert gradcheck(function, arguments, check_forward_ad=True, check_batched_grad=False)
        assert gradgradcheck(function, arguments, check_fwd_over_rev=True, check_rev_over_rev=True, fast_mode=True)


@pytest.mark.parametrize("name", LENSES)
def test_at_the_centre_among_invalid_points(name: str) -> None:
    kind, coefficients, _ = lens_of(name)
    points = torch.cat([tensor(CENTRE), distorted(name), tensor(INVALID)]).requires_grad_()
    coefficients.requires_grad_()
    direction, valid = kind(coefficients).unproject(points)
    assert valid.tolist() == [True] * 7 + [False] * 4
    assert direction.isfinite().all()
    (by_points, by_coefficients) = torch.autograd.grad(direction.sin().sum(), (points, coefficients), create_graph=True)
    assert by_points.isfinite().all()
    assert by_points[~valid].abs().max() == 0
    if name != "brown14":  # the tilt alone stretches the centre
        torch.testing.assert_close(by_points[:4].detach(), torch.ones(4, 2, dtype=torch.float64), rtol=1e-9, atol=1e-9)
    alone = kind(coefficients).unproject(points[:7].detach())[0]
    torch.testing.assert_close(by_coefficients, torch.autograd.grad(alone.sin().sum(), coefficients)[0])
    squares = by_points[valid].square().sum() + by_coefficients.square().sum()
    for second in torch.autograd.grad(squares, (points, coefficients)):
        assert second.isfinite().all()


@pytest.mark.parametrize("name", SLOW_WITH_MANY)
def test_centre_against_finite_differences(name: str) -> None:
    """Exactly 0 and 1e-12 from it."""
    kind, coefficients, _ = lens_of(name)
    points = tensor(CENTRE).requires_grad_()
    arguments = points, coefficients.clone().requires_grad_()
    assert gradcheck(inverse(kind), arguments, eps=1e-5, atol=1e-6, check_forward_ad=True)
    assert gradgradcheck(inverse(kind), arguments, eps=1e-5, atol=1e-4, check_fwd_over_rev=True, fast_mode=True)


@pytest.mark.parametrize("name", SLOW_WITH_MANY)
def test_forward_at_the_centre_and_among_invalid_directions(name: str) -> None:
    kind, coefficients, _ = lens_of(name)
    bad = [[0, 0, -1], [0, 0, 0], [math.nan, 0, 1], [0, math.inf, 1]]
    directions = tensor([[0, 0, 1], [1e-12, 0, 1], *bad, [0, 0.1, 2]])
    directions.requires_grad_()
    coefficients.requires_grad_()
    xy, valid = kind(coefficients).project_direction(directions)
    assert valid.tolist() == [True, True, False, False, False, False, True]
    first = torch.autograd.grad(xy.exp().sum(), (directions, coefficients), create_graph=True)
    second = torch.autograd.grad(sum(part.square().sum() for part in first), (directions, coefficients))
    assert all(part.isfinite().all() for part in (*first, *second))
    assert all(part[~valid].abs().max() == 0 for part in (first[0], second[0]))
    good = directions[valid].detach().requires_grad_()
    assert gradcheck(forward(kind), (good, coefficients), eps=1e-5, atol=1e-7, check_forward_ad=True)


@pytest.mark.parametrize("name", LENSES)
def test_near_the_edge_of_the_domain(name: str) -> None:
    """The derivative of the inverse is the inverse of the derivative, where it has grown to thousands."""
    kind, coefficients, _ = lens_of(name)
    shares = (1 - 1e-4, 1 - 1e-5, 1 - 2e-6)
    directions, points = undistorted(name, shares), distorted(name, shares)
    assert kind(coefficients).unproject(points)[1].all()
    there = vmap(jacrev(lambda d: kind(coefficients).project_direction(d[None])[0][0]))(directions)
    back = vmap(jacrev(lambda p: kind(coefficients).unproject(p[None])[0][0]))(points)
    identity = torch.eye(2, dtype=torch.float64).expand(len(shares), 2, 2)
    torch.testing.assert_close(there @ back, identity, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", LENSES)
def test_forward_mode_under_no_grad(name: str) -> None:
    kind, coefficients, _ = lens_of(name)
    points = distorted(name)
    torch.manual_seed(0)
    tangents = torch.randn_like(points), 1e-3 * torch.randn_like(coefficients)
    step = 1e-6
    function = inverse(kind)
    higher = function(points + step * tangents[0], coefficients + step * tangents[1])
    lower = function(points - step * tangents[0], coefficients - step * tangents[1])
    expected = (higher - lower) / (2 * step)
    with torch.no_grad():
        _, functional = jvp(function, (points, coefficients), tangents)
        with forward_ad.dual_level():
            duals = [forward_ad.make_dual(a, b) for a, b in zip((points, coefficients), tangents, strict=True)]
            dual = forward_ad.unpack_dual(function(*duals)).tangent
    torch.testing.assert_close(functional, expected, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(dual, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", LENSES)
def test_all_orders_of_modes_agree(name: str) -> None:
    kind, coefficients, _ = lens_of(name)
    point = distorted(name)[1]

    def loss(point: Tensor, coefficients: Tensor) -> Tensor:
        return kind(coefficients).unproject(point[None])[0].sin().sum()

    hessians = [
        torch.cat([part.flatten() for row in outer(inner(loss, (0, 1)), (0, 1))(point, coefficients) for part in row])
        for outer in (jacfwd, jacrev)
        for inner in (grad, jacfwd, jacrev)
    ]
    for other in hessians[1:]:
        torch.testing.assert_close(other, hessians[0], rtol=1e-9, atol=1e-9)
    step = 1e-5
    shift = step * torch.eye(len(coefficients), dtype=torch.float64)[0]
    shifted = [grad(loss)(point, coefficients + sign * shift) for sign in (1, -1)]
    mixed = jacfwd(grad(loss), 1)(point, coefficients)[:, 0]
    torch.testing.assert_close(mixed, (shifted[0] - shifted[1]) / (2 * step), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", LENSES)
def test_vmap_over_batches_of_lenses_in_the_operations_of_compiled_graphs(name: str) -> None:
    kind, coefficients, _ = lens_of(name)
    scale = torch.linspace(0.2, 1, 6, dtype=torch.float64).reshape(2, 3, 1)
    lens = kind(coefficients * scale)
    domain = vmap(lambda three: plan._domain(three, lens._key))(lens.coefficients)
    torch.testing.assert_close(domain, lens.domain, rtol=0, atol=0)
    parts = vmap(lambda three, reached: plan._rest(three, reached, lens._key))(lens.coefficients, domain)
    for found, expected in zip(parts, plan._rest(lens.coefficients, domain, lens._key), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=0)


@pytest.mark.parametrize("name", LENSES)
def test_vmap_over_points_and_over_lenses(name: str) -> None:
    kind, coefficients, _ = lens_of(name)
    points = distorted(name)
    many = coefficients * torch.linspace(0.2, 1, 4, dtype=torch.float64).unsqueeze(-1)
    lens = kind(many)
    expected, expected_valid = lens.unproject(points)
    for batched in (
        vmap(lambda one: kind(one).unproject(points))(many),
        vmap(lambda one: one.unproject(points))(lens),
    ):
        torch.testing.assert_close(batched[0], expected, rtol=1e-13, atol=1e-13)
        assert torch.equal(batched[1], expected_valid)
    torch.testing.assert_close(vmap(lambda one: one.domain)(lens), lens.domain)
    one_by_one, _ = vmap(lambda point: kind(coefficients).unproject(point[None]))(points)
    torch.testing.assert_close(one_by_one[:, 0], kind(coefficients).unproject(points)[0], rtol=1e-13, atol=1e-13)
    jacobians = vmap(jacrev(lambda one: kind(one).unproject(points)[0]))(many)
    assert jacobians.shape == (4, 3, 3, len(coefficients))
    assert jacobians.isfinite().all()


def test_a_lens_of_no_use_poisons_nobody_under_vmap() -> None:
    many = tensor([[-0.2, 0, 0, 0], [math.nan, 0, 0, 0], [math.inf, 0, 0, 0]])
    points = tensor([[0.1, 0.2], [0.0, 0.0]])
    gradient = vmap(grad(lambda c: BrownConrady(c).undistort(points)[0].sum()))(many)
    assert gradient.isfinite().all()
    assert gradient[0, 0] != 0
    assert gradient[1:].abs().max() == 0
    assert vmap(lambda c: BrownConrady(c).undistort(points)[1])(many).tolist() == [[True] * 2, [False] * 2, [False] * 2]


def test_without_a_derivative_the_result_is_the_same() -> None:
    kind, coefficients, _ = lens_of("brown5")
    points = distorted("brown5")
    plain, _ = kind(coefficients).undistort(points)
    taped, _ = kind(coefficients.requires_grad_()).undistort(points)
    assert not plain.requires_grad
    assert taped.requires_grad
    torch.testing.assert_close(plain, taped.detach(), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14, "fisheye"])
def test_the_lens_s_own_derivatives(count: int | str) -> None:
    """In closed form, against automatic differentiation, on the axis and far from it."""
    if count == "fisheye":
        kind, numbers = KannalaBrandt, [0.01, -0.02, 0.001, 0.0005]
        directions = [[0.0, 0, 1], [1e-9, 0, 1], [0.1, -0.05, 1], [0.15, 0, 1], [1, 2, 0], [0.3, 1, -0.4], [1, 2, 3e3]]
    else:
        kind = BrownConrady
        every = [-0.2, 0.05, 0.001, -0.002, 0.002, 0.01, 0.02, 0.001, 0.001, 0.002, 0.003, 0.002, 0.02, -0.03]
        numbers = every[: int(count)]
        directions = [[0.0, 0, 1], [1e-9, 0, 1], [0.1, -0.05, 1], [-0.3, 0.4, 2], [0.5, 0.4, 1e-1 * 10], [1, 2, 3e3]]
    coefficients = torch.tensor(numbers, dtype=torch.float64)
    given = torch.tensor(directions, dtype=torch.float64)

    def project(direction: Tensor, coefficients: Tensor) -> Tensor:
        return kind(coefficients).project_direction(direction[None])[0][0]

    by_direction, by_coefficients = vmap(jacrev(project, (0, 1)), (0, None))(given, coefficients)
    lens = kind(coefficients)
    torch.testing.assert_close(lens.by_direction(given), by_direction, rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(lens.by_coefficients(given), by_coefficients, rtol=1e-12, atol=1e-18)
    some = given[2:].clone().requires_grad_()
    assert gradcheck(lens.by_direction, some, atol=1e-7)
    both = kind(torch.stack([coefficients, 0.5 * coefficients]))
    alone = [kind(one) for one in both.coefficients]
    for name in ("by_direction", "by_coefficients"):
        want = torch.stack([getattr(one, name)(given) for one in alone])
        torch.testing.assert_close(getattr(both, name)(given.expand(2, -1, -1)), want, rtol=1e-13, atol=1e-18)
