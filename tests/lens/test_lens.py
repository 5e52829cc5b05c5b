"""Lenses against OpenCV, against brute force, and against their own promises."""

import copy
import io
import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj.lens import kannala_brandt
from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.kannala_brandt import KannalaBrandt
from diffproj.lens.protocol import Lens

REPORTED = [-0.2535, 0.0924, -0.0006, 0.0007, -0.0191]
FOCAL, CENTRE = 1917.36, (1920.0, 1080.0)

BROWN = {
    "none": [0.0] * 4,
    "brown4": [-0.27, 0.03, 0.002, -0.001],
    "brown5": REPORTED,
    "pincushion": [0.1, 0.02, 0.001, -0.0005, 0.003],
    "brown8": [22.0, 8.0, 1e-4, 2e-4, 0.2, 22.3, 15.0, 1.6],
    "brown12": [-0.25, 0.09, -6e-4, 7e-4, -0.02, 0.01, -0.003, 0.001, 1e-3, -1e-4, 2e-3, 1e-4],
    "brown14": [-0.25, 0.09, -6e-4, 7e-4, -0.02, 0.01, -0.003, 0.001, 1e-3, -1e-4, 2e-3, 1e-4, 0.02, -0.03],
}
FISHEYE = {
    "equidistant": [0.0] * 4,
    "wide": [0.01, -0.002, 0.0, 0.0],
    "folding": [-0.05, 0.3, -0.2, 0.03],
}


def tensor(values: Any, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(values, dtype=dtype)


def disc(radius: float, count: int = 4000, guard: float = 1e-6) -> Tensor:
    """Points of a disc, half of them crowding at its edge, up to a guard band."""
    generator = torch.Generator().manual_seed(0)
    u, angle = torch.rand(2, count, generator=generator, dtype=torch.float64)
    share = torch.where(torch.arange(count) % 2 == 0, u.sqrt() * (1 - guard), 1 - guard ** (1 - u))
    angle = 2 * math.pi * angle
    return radius * share.clamp_min(0).unsqueeze(-1) * torch.stack([angle.cos(), angle.sin()], dim=-1)


def cone(angle: float, count: int = 4000, guard: float = 1e-6) -> Tensor:
    """Unit directions up to an angle from the axis."""
    plane = disc(angle, count, guard)
    theta = plane.norm(dim=-1, keepdim=True)
    return torch.cat([plane / theta.clamp_min(1e-300) * theta.sin(), theta.cos()], dim=-1)


def opencv(coefficients: list[float], xy: Tensor) -> Tensor:
    points = np.concatenate([xy.numpy(), np.ones((len(xy), 1))], axis=1)
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients))
    return torch.from_numpy(pixels.reshape(-1, 2))


def random_lenses(count: int, number: int, *, seed: int, wild: bool = False) -> Tensor:
    """Coefficients `(number, count)`: moderate, or of any size between 1e-3 and 1e2 with tilts up to 80 degrees."""
    generator = torch.Generator().manual_seed(seed)
    part = 2 * torch.rand(number, count, generator=generator, dtype=torch.float64) - 1
    moderate = [0.5, 0.3, 0.01, 0.01, 0.1, 0.3, 0.1, 0.05, 0.01, 0.01, 0.01, 0.01, 0.1, 0.1]
    if not wild:
        return part * tensor(moderate[:count])
    coefficients = part.sign() * 10 ** (5 * part.abs() - 3)
    coefficients[:, 12:] = 1.4 * part[:, 12:]
    return coefficients


def raw(coefficients: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """The textbook's equations once more, independently of the package's."""
    padded = torch.cat([coefficients, coefficients.new_zeros(14 - len(coefficients))])
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y = padded
    s = x * x + y * y
    g = (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2 + k6 * s**3)
    x_bent = x * g + 2 * p1 * x * y + p2 * (s + 2 * x * x) + s1 * s + s2 * s * s
    y_bent = y * g + p1 * (s + 2 * y * y) + 2 * p2 * x * y + s3 * s + s4 * s * s
    top = tau_x.cos() * x_bent
    middle = tau_y.cos() * y_bent - tau_x.sin() * tau_y.sin() * x_bent
    below = tau_y.sin() * x_bent - tau_y.cos() * tau_x.sin() * y_bent + tau_x.cos() * tau_y.cos()
    return top / below, middle / below


def smallest_eigenvalue(coefficients: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Of the symmetric part of the Jacobian, by automatic differentiation of the textbook's equations."""
    point = torch.stack([x, y], -1).requires_grad_()
    parts = raw(coefficients, *point.unbind(-1))
    rows = [torch.autograd.grad(part.sum(), point, retain_graph=True)[0] for part in parts]
    jacobian = torch.stack(rows, dim=-2)
    return torch.linalg.eigvalsh((jacobian + jacobian.mT) / 2)[..., 0].detach()


# ------------------------------------------------------------------------------------------------------ Brown-Conrady


@pytest.mark.parametrize("name", BROWN)
def test_distort_is_opencvs(name: str) -> None:
    lens = BrownConrady(tensor(BROWN[name]))
    xy = disc(min(float(lens.domain), 1.2))
    xy_distorted, valid = lens.distort(xy)
    assert valid.all()
    torch.testing.assert_close(xy_distorted, opencv(BROWN[name], xy), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", BROWN)
def test_undistort_inverts_up_to_the_edge_of_the_domain(name: str) -> None:
    lens = BrownConrady(tensor(BROWN[name]))
    xy = disc(min(float(lens.domain), 3.0))
    xy_distorted, _ = lens.distort(xy)
    found, valid = lens.undistort(xy_distorted)
    again, valid_again = lens.distort(found)
    assert valid.all()
    assert valid_again.all()
    assert (again - xy_distorted).abs().max() < 1e-12
    assert (found - xy)[: len(xy) : 2].abs().max() < 1e-6  # next to the fold a rounding moves the preimage far


@pytest.mark.parametrize("name", ["brown4", "brown5", "brown12", "brown14"])
def test_valid_is_what_brute_force_finds(name: str) -> None:
    """A dense grid of distorted points: is there a preimage in the disc, by the winding of its distorted edge?"""
    lens = BrownConrady(tensor(BROWN[name]))
    radius = float(lens.domain)
    axis = torch.linspace(-1.3, 1.3, 301, dtype=torch.float64)
    grid = torch.cartesian_prod(axis, axis)
    _, valid = lens.undistort(grid)
    angle = torch.linspace(0, 2 * math.pi, 20001, dtype=torch.float64)

    def encloses(edge_radius: float) -> Tensor:
        """Whether the distorted circle winds around a point: a one-to-one map takes the disc to what it encloses."""
        edge = torch.stack(raw(lens.coefficients, edge_radius * angle.cos(), edge_radius * angle.sin()), -1)
        polygon = np.ascontiguousarray(edge.numpy())
        return torch.from_numpy(_inside_polygon(polygon, grid.numpy()))

    inside, outside = encloses(radius * (1 - 1e-6)), ~encloses(radius)
    near_edge = inside == outside
    assert near_edge.sum() < 10
    assert valid[inside & ~near_edge].all()
    assert not valid[outside & ~near_edge].any()
    assert 1000 < valid.sum() < 0.9 * len(grid)


def _inside_polygon(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """By the radius of a star-shaped polygon in the direction of each point, between its corners."""
    angles = np.unwrap(np.arctan2(polygon[:, 1], polygon[:, 0]))
    assert (np.diff(angles) > 0).all()
    direction = (np.arctan2(points[:, 1], points[:, 0]) - angles[0]) % (2 * np.pi) + angles[0]
    right = np.clip(np.searchsorted(angles, direction), 1, len(polygon) - 1)
    a, b = polygon[right - 1], polygon[right]
    return (b[:, 0] - a[:, 0]) * (points[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (points[:, 0] - a[:, 0]) > 0


@pytest.mark.parametrize("name", ["brown4", "brown5", "brown12", "brown14"])
def test_domain_is_the_largest_disc_with_positive_definite_jacobian(name: str) -> None:
    lens = BrownConrady(tensor(BROWN[name]))
    radius = float(lens.domain)
    angle = torch.linspace(0, 2 * math.pi, 7201, dtype=torch.float64)

    def worst(share: float) -> float:
        r = radius * share
        return float(smallest_eigenvalue(lens.coefficients, r * angle.cos(), r * angle.sin()).min())

    assert all(worst(share) > 0 for share in (0.1, 0.5, 0.9, 0.99, 0.9999, 1 - 1e-7))
    assert worst(1 + 1e-5) < 0


@pytest.mark.parametrize("wild", [False, True])
@pytest.mark.parametrize("count", [8, 12, 14])
def test_random_lenses_hold_their_promise_up_to_the_edge(count: int, wild: bool) -> None:
    """No disc goes beyond a fold, and of each disc every point is found, up to a millionth of the radius.

    Next to a pole or a tilted horizon, and where the worst direction turns quickly with the radius, a search for
    either of them loses its way first.
    """
    lens = BrownConrady(random_lenses(count, 40, seed=1, wild=wild))
    share = tensor([0.3, 0.8, 0.9, 0.99, 0.999, 1 - 1e-4, 1 - 1e-6, 1.00001])
    angle = torch.linspace(0, 2 * math.pi, 721, dtype=torch.float64)
    finite = 0
    for coefficients, domain in zip(lens.coefficients, lens.domain, strict=True):
        if 0 < domain < math.inf:
            radius = (share * domain).unsqueeze(-1)
            worst = smallest_eigenvalue(coefficients, radius * angle.cos(), radius * angle.sin()).amin(-1)
            assert (worst[:-1] > 0).all()
            finite += 1
    assert finite > 20
    points = disc(1.0, count=600) * lens.domain.clamp_max(5.0)[:, None, None]
    xy_distorted, inside = lens.distort(points)
    xy, valid = lens.undistort(xy_distorted)
    assert torch.equal(valid, inside)
    again, _ = lens.distort(xy)
    assert ((again - xy_distorted).norm(dim=-1) < 1e-12 * (1 + xy_distorted.norm(dim=-1))).all()
    outside = points * 3
    xy, valid = lens.undistort(outside)
    again, inside = lens.distort(xy)
    assert inside[valid].all()
    assert ((again - outside).norm(dim=-1)[valid] < 1e-12 * (1 + outside.norm(dim=-1)[valid])).all()


@pytest.mark.parametrize("name", ["brown5", "brown8", "brown14", "folding"])
def test_transforms_find_what_eager_finds_next_to_the_fold(name: str) -> None:
    """Under `vmap` nobody sees which points need more steps; they get them all the same."""
    lens = LENSES[name]
    inner, outer = (cone, 1.0) if name == "folding" else (disc, 1.2)
    there = inner(min(float(lens.domain), 3.0), 300)
    there = there if there.shape[-1] == 3 else torch.nn.functional.pad(there, (0, 1), value=1.0)
    xy, _ = lens.project_direction(there)
    xy = torch.cat([xy, outer * xy])
    direction, valid = lens.unproject(xy)
    assert valid[:300].all()
    one_by_one, found = torch.func.vmap(lambda point: lens.unproject(point[None]))(xy)
    assert torch.equal(found[:, 0], valid)
    torch.testing.assert_close(one_by_one[:, 0], direction, rtol=1e-9, atol=1e-9)


def test_the_way_forward_needs_no_table_of_the_inverse(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError

    monkeypatch.setattr("diffproj.lens.brown_conrady.inverse_table", refuse)
    monkeypatch.setattr("diffproj.lens.kannala_brandt.inverse_table", refuse)
    for lens in (BrownConrady(tensor(REPORTED)), KannalaBrandt(tensor(FISHEYE["wide"]))):
        assert lens.project_direction(tensor([[0.1, 0.2, 1.0]]))[1].all()
        assert lens.domain > 0


@pytest.mark.parametrize(
    ("coefficients", "radius"),
    [
        ([-1 / 3, 0.0, 0.0, 0.0], 1.0),  # d/dr (r - r^3 / 3) = 0
        ([0.0, 0.0, 0.0, 0.1], 1 / 0.6),  # 1 - 6 p r = 0
        ([0.0, 0.0, 0.06, 0.08], 1 / 0.6),
        ([0.0] * 5, math.inf),
        ([0.2, 0.0, 0.0, 0.0, 0.1], math.inf),
        ([0.0] * 8 + [0.5, 0.0, 0.0, 0.0], 1.0),  # 1 + 2 s1 x = 0
    ],
)
def test_domain_by_hand(coefficients: list[float], radius: float) -> None:
    domain = float(BrownConrady(tensor(coefficients)).domain)
    assert domain == pytest.approx(radius, rel=1e-9)
    assert domain <= radius


def test_reported_case() -> None:
    """Image corners beyond the model's reach, where others return garbage; the left edge, where they are far off."""
    lens = BrownConrady(tensor(REPORTED))
    pixels = tensor([[0, 0], [3839, 0], [0, 2159], [3839, 2159], [0, 1080]])
    xy_distorted = (pixels - tensor(CENTRE)) / FOCAL
    xy, valid = lens.undistort(xy_distorted)
    assert valid.tolist() == [False] * 4 + [True]
    assert xy[:4].abs().max() == 0
    again, _ = lens.distort(xy[4:])
    assert (again - xy_distorted[4:]).abs().max() * FOCAL < 1e-9
    usual = cv2.undistortPoints(xy_distorted[4:].numpy(), np.eye(3), np.array(REPORTED)).reshape(-1, 2)
    off = (torch.from_numpy(usual) - xy[4:]).norm() * FOCAL
    assert off > 5


@pytest.mark.parametrize("name", BROWN)
def test_float32_costs_no_more_than_its_rounding(name: str) -> None:
    check_float32(BrownConrady(tensor(BROWN[name])).to(torch.float32), 2.0)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_float32_of_random_lenses(count: int) -> None:
    for coefficients in random_lenses(count, 12, seed=3):
        check_float32(BrownConrady(coefficients.float()), 2.0)


def check_float32(lens: BrownConrady | KannalaBrandt, reach: float) -> None:
    """Points that the inverse finds in float32 go back to where they came from, up to 4 roundings.

    A rounding is the largest error of the forward model in float32 against float64, on the same points. Carried back
    through the inverse's derivative it is what a solution may be off by. That derivative is infinite at a fold, so the
    comparison is made in front of it: each solution is distorted exactly and compared with its distorted point, which
    multiplies the error with the forward derivative and cancels the inverse's.
    """
    exact = lens.to(torch.float64)
    assert (lens.domain <= exact.domain).all()
    make = disc if isinstance(lens, BrownConrady) else cone
    there = make(min(float(exact.domain), reach), count=1000, guard=1e-3).float()
    if isinstance(lens, BrownConrady):
        there = torch.nn.functional.pad(there, (0, 1), value=1.0)
    arrived, _ = exact.project_direction(there.double())
    rounding = (lens.project_direction(there)[0].double() - arrived).norm(dim=-1).max()
    goal = arrived.float()
    found, valid = lens.unproject(goal)
    assert valid.all()
    again, _ = exact.project_direction(found.double())
    finest = torch.finfo(torch.float32).eps * goal.double().norm(dim=-1).max()
    inside = exact.unproject(goal.double())[1]  # rounding the goal may carry it over the edge
    assert (again - goal.double()).norm(dim=-1)[inside].max() <= 4 * max(rounding, finest)


def test_directions() -> None:
    lens = BrownConrady(tensor(REPORTED))
    direction = tensor([[0.3, 0.2, 1], [1.5, 1, 5], [0.3, 0.2, -1], [1, 0, 0], [0, 0, 0], [9, 0, 1]])
    xy_distorted, valid = lens.project_direction(direction)
    assert valid.tolist() == [True, True, False, False, False, False]
    torch.testing.assert_close(xy_distorted[0], xy_distorted[1])
    assert xy_distorted[2:].abs().max() == 0
    back, valid = lens.unproject(xy_distorted[:2])
    assert valid.all()
    torch.testing.assert_close(back, tensor([[0.3, 0.2, 1.0]]).expand(2, 3))


# ----------------------------------------------------------------------------------------------------------- fisheye


@pytest.mark.parametrize("name", FISHEYE)
def test_fisheye_is_opencvs(name: str) -> None:
    lens = KannalaBrandt(tensor(FISHEYE[name]))
    direction = cone(min(float(lens.domain), 1.5))
    xy_distorted, valid = lens.project_direction(direction * 3)
    assert valid.all()
    zero = np.zeros(3)
    pixels, _ = cv2.fisheye.projectPoints(direction.numpy()[None], zero, zero, np.eye(3), np.array(FISHEYE[name]))
    torch.testing.assert_close(xy_distorted, torch.from_numpy(pixels[0]), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", FISHEYE)
def test_fisheye_inverts_beyond_ninety_degrees(name: str) -> None:
    lens = KannalaBrandt(tensor(FISHEYE[name]))
    direction = cone(float(lens.domain))
    xy_distorted, valid = lens.project_direction(direction)
    assert valid.all()
    found, valid = lens.unproject(xy_distorted)
    assert valid.all()
    again, valid = lens.project_direction(found)
    assert valid.all()
    assert (again - xy_distorted).abs().max() < 1e-12
    assert (found.norm(dim=-1) - 1).abs().max() < 1e-14
    if name != "folding":
        assert (direction[:, 2] < 0).any()
        assert (found - direction).abs().max() < 1e-13


def test_the_fisheyes_inverse_of_an_exported_graph_is_the_usual_one() -> None:
    """Of two lenses at once and of one, whatever the start, and for points that are to be left alone."""
    angle = torch.linspace(0, 1.2, 40, dtype=torch.float64)
    for coefficients in (tensor([FISHEYE["wide"], FISHEYE["equidistant"]]), tensor(FISHEYE["wide"])):
        k1, k2, k3, k4 = coefficients.unsqueeze(-2).unbind(-1)
        s = angle * angle
        rho = angle * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
        left = (torch.arange(40) % 5 > 0).expand(rho.shape)
        like = rho.new_ones(rho.shape[:-1])
        given = coefficients, 1.5 * like, like, rho, torch.ones_like(rho), left
        sigma, solved = kannala_brandt._solved_in_graph(*given)
        assert torch.equal(solved, left)
        torch.testing.assert_close((sigma * rho)[left], angle.expand(rho.shape)[left], rtol=1e-12, atol=1e-12)
        assert bool((sigma[~left] == 1).all())


def test_fisheye_domain() -> None:
    assert float(KannalaBrandt(torch.zeros(4, dtype=torch.float64)).domain) == pytest.approx(math.pi)
    assert float(KannalaBrandt(tensor([-1 / 3, 0, 0, 0])).domain) == pytest.approx(1.0, rel=1e-10)
    lens = KannalaBrandt(tensor([-1 / 3, 0, 0, 0]))
    assert lens.unproject(tensor([[2 / 3 - 1e-9, 0], [2 / 3 + 1e-9, 0]]))[1].tolist() == [True, False]


def test_fisheye_has_no_image_of_the_direction_straight_back() -> None:
    lens = KannalaBrandt(torch.zeros(4, dtype=torch.float64))
    direction = tensor([[0, 0, -1.0], [0, 0, 0], [0, 0, 1], [1e-3, 0, -1], [1e200, 0, 1e200], [1e-150, 0, 0]])
    xy_distorted, valid = lens.project_direction(direction)
    assert valid.tolist() == [False, False, True, True, True, True]
    torch.testing.assert_close(xy_distorted[4], tensor([math.pi / 4, 0]))
    torch.testing.assert_close(xy_distorted[5], tensor([math.pi / 2, 0]))


@pytest.mark.parametrize("name", FISHEYE)
def test_fisheye_in_float32(name: str) -> None:
    check_float32(KannalaBrandt(tensor(FISHEYE[name])).to(torch.float32), 3.0)


def test_float32_of_random_fisheyes() -> None:
    generator = torch.Generator().manual_seed(5)
    for coefficients in (2 * torch.rand(20, 4, generator=generator) - 1) * torch.tensor([0.1, 0.1, 0.05, 0.01]):
        check_float32(KannalaBrandt(coefficients), 3.0)


# ------------------------------------------------------------------------------------------- what holds for all lenses


LENSES: dict[str, Lens] = {name: BrownConrady(tensor(c)) for name, c in BROWN.items()}
LENSES |= {name: KannalaBrandt(tensor(c)) for name, c in FISHEYE.items()}


@pytest.mark.parametrize("name", LENSES)
def test_input_that_is_not_finite(name: str) -> None:
    lens = LENSES[name]
    bad = [math.nan, math.inf, -math.inf, 1e308, 1e200]
    xy = tensor([[value, 0.1] for value in bad] + [[0.1, value] for value in bad[:3]])
    direction, valid = lens.unproject(xy)
    assert direction.isfinite().all()
    assert not valid[[0, 1, 2, 5, 6, 7]].any()
    rays = tensor([[math.nan, 0, 1], [math.inf, 0, 1], [0.1, 0, math.inf], [0.1, -math.inf, 1], [0.1, 0, math.nan]])
    xy_distorted, valid = lens.project_direction(rays)
    assert xy_distorted.isfinite().all()
    assert not valid.any()


@pytest.mark.parametrize("name", ["brown5", "brown14", "wide"])
def test_batches_are_loops(name: str) -> None:
    lens = LENSES[name]
    assert isinstance(lens, BrownConrady | KannalaBrandt)
    coefficients = lens.coefficients * tensor([[0.5], [1.0], [0.0]])
    batch = type(lens)(coefficients)
    xy = disc(0.9, 100).reshape(2, 1, 50, 2)
    together, valid = batch.unproject(xy)
    assert together.shape == (2, 3, 50, 3)
    assert batch.domain.shape == (3,)
    for i in range(2):
        for j in range(3):
            alone, valid_alone = type(lens)(coefficients[j]).unproject(xy[i, 0])
            torch.testing.assert_close(together[i, j], alone, rtol=1e-14, atol=1e-14)
            assert torch.equal(valid[i, j], valid_alone)
            torch.testing.assert_close(batch[j].unproject(xy[i, 0])[0], alone, rtol=1e-14, atol=1e-14)
    forward, _ = batch.project_direction(together)
    torch.testing.assert_close(forward[valid], xy.expand(2, 3, 50, 2)[valid], rtol=1e-12, atol=1e-12)


def test_indexing_and_expanding_keep_the_domain() -> None:
    lens = BrownConrady(tensor([REPORTED, BROWN["pincushion"]]).expand(3, 2, 5))
    domain = lens.domain
    assert lens[1].domain.tolist() == domain[1].tolist()
    assert lens[..., 0].domain.tolist() == domain[..., 0].tolist()
    assert lens[:, 1:].batch_shape == (3, 1)
    wide = lens[0].expand(4, 2)
    assert wide.domain.shape == wide.batch_shape == (4, 2)
    assert wide.coefficients.shape == (4, 2, 5)
    assert wide.undistort(torch.zeros(4, 2, 7, 2, dtype=torch.float64))[0].shape == (4, 2, 7, 2)


@pytest.mark.parametrize("name", ["brown5", "wide"])
def test_no_points_and_no_lenses(name: str) -> None:
    lens = LENSES[name]
    direction, valid = lens.unproject(torch.zeros(0, 2, dtype=torch.float64))
    assert direction.shape == (0, 3)
    assert valid.shape == (0,)
    assert lens.project_direction(direction)[0].shape == (0, 2)
    none = lens.expand(2)[:0]
    assert none.unproject(torch.zeros(5, 2, dtype=torch.float64))[0].shape == (0, 5, 3)


@pytest.mark.parametrize("name", ["brown5", "wide"])
def test_blocks_change_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    lens = LENSES[name].expand(3)
    xy = disc(1.4, 1000)
    whole = lens.unproject(xy)
    monkeypatch.setattr("diffproj._core.numerics.BLOCK_POINTS", 333)
    for part, reference in zip(lens.unproject(xy), whole, strict=True):
        assert torch.equal(part, reference)


def test_domain_follows_coefficients_that_are_written_to() -> None:
    coefficients = torch.nn.Parameter(tensor([-1 / 3, 0, 0, 0]))
    lens = BrownConrady(coefficients)
    assert float(lens.domain) == pytest.approx(1.0)
    with torch.no_grad():
        coefficients[0] = -1 / 12
    assert float(lens.domain) == pytest.approx(2.0)
    assert float(lens.detach().domain) == pytest.approx(2.0)
    assert not lens.domain.requires_grad
    assert not lens.detach().coefficients.requires_grad


def test_domain_remembered_in_inference_mode_serves_training() -> None:
    coefficients = tensor(REPORTED).requires_grad_()
    lens = BrownConrady(coefficients)
    xy = disc(0.5, 10)
    with torch.inference_mode():
        lens.undistort(xy)
    lens.undistort(xy)[0].sum().backward()
    assert coefficients.grad is not None
    assert coefficients.grad.isfinite().all()


@pytest.mark.parametrize("name", LENSES)
def test_copies_and_files(name: str) -> None:
    lens = LENSES[name]
    assert lens.domain.isfinite().all() or float(lens.domain) > 0
    twin = copy.deepcopy(lens.expand(2)[0])
    file = io.BytesIO()
    torch.save(lens, file)
    file.seek(0)
    loaded = torch.load(file, weights_only=False)
    for other in (twin, loaded):
        assert torch.equal(other.domain, lens.domain)
    leaves, structure = torch.utils._pytree.tree_flatten(lens)
    assert len(leaves) == 1
    assert torch.equal(torch.utils._pytree.tree_unflatten(leaves, structure).domain, lens.domain)
    assert str(tuple(leaves[0].shape)) in repr(lens)


def test_halves_are_lifted() -> None:
    lens = BrownConrady(tensor(REPORTED).half())
    assert lens.dtype == torch.float32
    assert lens.undistort(torch.zeros(3, 2, dtype=torch.bfloat16))[0].dtype == torch.float32


@pytest.mark.plain
@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: BrownConrady("k1"), TypeError, "coefficients: want a tensor, an array or numbers, got 'k1'"),  # type: ignore[arg-type]
        (lambda: BrownConrady(torch.zeros(5, dtype=torch.int64)), TypeError, "coefficients: want a floating-point"),
        (lambda: BrownConrady(torch.zeros(6)), ValueError, "coefficients: want 4, 5, 8, 12, 14 of them"),
        (lambda: KannalaBrandt(torch.zeros(5)), ValueError, "coefficients: want 4 of them"),
        (lambda: BrownConrady(tensor([math.nan, 0, 0, 0])), ValueError, "coefficients: want finite numbers"),
        (lambda: BrownConrady(torch.zeros(5)).undistort(torch.zeros(3, 3)), ValueError, "xy_distorted: want shape"),
        (lambda: BrownConrady(torch.zeros(5)).distort(torch.zeros(3, 2).double()), TypeError, "xy: want torch.float32"),
        (lambda: BrownConrady(torch.zeros(3, 5)).distort(torch.zeros(2, 4, 2)), ValueError, "do not broadcast"),
        (
            lambda: KannalaBrandt(torch.zeros(4)).project_direction(torch.zeros(3, 2)),
            ValueError,
            "direction: want shape",
        ),
    ],
)
def test_mistakes_are_named(make: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make()


def test_lens_from_outside() -> None:
    """A lens that the package does not know: what `Lens` asks for is enough."""

    class Stereographic(Lens):
        """`rho = 2 f tan(theta / 2)`, with one scale `f`."""

        def __init__(self, scale: Tensor):
            self.scale = scale

        batch_shape = property(lambda self: self.scale.shape)
        dtype = property(lambda self: self.scale.dtype)
        device = property(lambda self: self.scale.device)
        domain = property(lambda self: torch.full_like(self.scale, 3.0))

        def project_direction(self, direction: Tensor) -> tuple[Tensor, Tensor]:
            unit = torch.nn.functional.normalize(direction, dim=-1)
            valid = unit[..., 2] > math.cos(3.0)
            below = torch.where(valid, 1 + unit[..., 2], 1)
            xy = 2 * self.scale[..., None, None] * unit[..., :2] / below[..., None]
            return torch.where(valid[..., None], xy, 0), valid

        def unproject(self, xy_distorted: Tensor) -> tuple[Tensor, Tensor]:
            xy = xy_distorted / (2 * self.scale[..., None, None])
            s = xy.square().sum(-1, keepdim=True)
            direction = torch.cat([2 * xy, 1 - s], dim=-1) / (1 + s)
            return direction, direction[..., 2] > math.cos(3.0)

        def to(self, *args: Any, **kwargs: Any) -> "Stereographic":
            return Stereographic(self.scale.to(*args, **kwargs))

        def expand(self, *batch_shape: int) -> "Stereographic":
            return Stereographic(self.scale.expand(batch_shape))

        def detach(self) -> "Stereographic":
            return Stereographic(self.scale.detach())

        def __getitem__(self, index: Any) -> "Stereographic":
            return Stereographic(self.scale[index])

    dp.register_lens(Stereographic, tensors=("scale",))
    lens = Stereographic(tensor([1.0, 0.7]))
    assert isinstance(lens, Lens)
    direction = cone(2.5, 50)
    back = torch.func.vmap(lambda one: one.unproject(one.project_direction(direction)[0])[0])(lens)
    torch.testing.assert_close(back, direction.expand(2, -1, -1))
    xy = lens[1].project_direction(direction)[0]
    front = direction[:, 2] > 0
    undistorted, valid = lens[1].undistort(xy)
    assert torch.equal(valid, front)
    torch.testing.assert_close(undistorted[front], direction[front, :2] / direction[front, 2:])
    again, valid = lens[1].distort(undistorted)
    assert valid.all()
    torch.testing.assert_close(again[front], xy[front])
