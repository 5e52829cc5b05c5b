"""Lenses drawn at random, the absurd ones too: no exception, no hang, no NaN, and nothing valid that is not true."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from diffproj.lens.brown_conrady import BrownConrady
from diffproj.lens.kannala_brandt import KannalaBrandt

SETTINGS = settings(deadline=None, derandomize=True, max_examples=60, suppress_health_check=list(HealthCheck))

small = st.floats(-1, 1)
sizes = [0.5, 0.3, 0.01, 0.01, 0.1, 0.3, 0.1, 0.05, 0.01, 0.01, 0.01, 0.01, 0.1, 0.1]
counts = st.sampled_from([4, 5, 8, 12, 14])
wild = st.one_of(st.floats(-1e12, 1e12), st.floats(-3, 3), st.sampled_from([0.0, 1e-300, -1e-300, 1e300, -1e300]))
angles = st.one_of(st.floats(-10, 10), st.sampled_from([math.pi / 2, -math.pi / 2, math.pi / 2 - 1e-9, math.pi, 0.0]))


@st.composite
def sane_lenses(draw: st.DrawFn) -> list[float]:
    return [draw(small) * size for size in sizes[: draw(counts)]]


@st.composite
def absurd_lenses(draw: st.DrawFn) -> list[float]:
    count = draw(counts)
    return [draw(wild) for _ in range(min(count, 12))] + [draw(angles) for _ in range(count - 12)]


def disc(radius: float, guard: float = 1e-6) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    u, angle = torch.rand(2, 300, generator=generator, dtype=torch.float64)
    share = torch.where(torch.arange(300) % 3 == 0, 1 - guard ** (1 - u), u.sqrt() * (1 - guard))
    return radius * share.unsqueeze(-1) * torch.stack([(2 * math.pi * angle).cos(), (2 * math.pi * angle).sin()], -1)


def size(xy: Tensor) -> Tensor:
    return xy.norm(dim=-1)


@SETTINGS
@given(sane_lenses())
def test_forward_is_opencvs(coefficients: list[float]) -> None:
    lens = BrownConrady(torch.tensor(coefficients, dtype=torch.float64))
    xy = disc(min(0.99 * float(lens.domain), 1.0))
    xy_distorted, valid = lens.distort(xy)
    points = np.concatenate([xy.numpy(), np.ones((len(xy), 1))], axis=1)
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients))
    assert valid.all()
    assert ((torch.from_numpy(pixels[:, 0]) - xy_distorted).norm(dim=-1) < 1e-12 * (1 + size(xy_distorted))).all()


@SETTINGS
@given(st.tuples(small, small, small, small))
def test_fisheye_forward_is_opencvs(shares: tuple[float, ...]) -> None:
    coefficients = [share * size for share, size in zip(shares, (0.1, 0.1, 0.05, 0.01), strict=True)]
    lens = KannalaBrandt(torch.tensor(coefficients, dtype=torch.float64))
    plane = disc(min(0.99 * float(lens.domain), 1.4))
    theta = plane.norm(dim=-1, keepdim=True)
    direction = torch.cat([plane / theta * theta.sin(), theta.cos()], dim=-1)
    xy_distorted, valid = lens.project_direction(direction)
    zero = np.zeros(3)
    pixels, _ = cv2.fisheye.projectPoints(direction.numpy()[None], zero, zero, np.eye(3), np.array(coefficients))
    assert valid.all()
    assert (size(torch.from_numpy(pixels[0]) - xy_distorted) < 1e-12 * (1 + size(xy_distorted))).all()


@SETTINGS
@given(sane_lenses())
def test_every_point_of_the_disc_is_found(coefficients: list[float]) -> None:
    lens = BrownConrady(torch.tensor(coefficients, dtype=torch.float64))
    xy_distorted, _ = lens.distort(disc(min(float(lens.domain), 5.0)))
    xy, valid = lens.undistort(xy_distorted)
    assert valid.all()
    again, valid = lens.distort(xy)
    assert valid.all()
    assert (size(again - xy_distorted) < 1e-12 * (1 + size(xy_distorted))).all()


@SETTINGS
@given(absurd_lenses(), st.sampled_from([torch.float32, torch.float64]))
def test_absurd_lenses_do_no_harm(coefficients: list[float], dtype: torch.dtype) -> None:
    columns = torch.tensor(coefficients, dtype=torch.float64).clamp(-torch.finfo(dtype).max, torch.finfo(dtype).max)
    check_honest(BrownConrady(columns.to(dtype)))


@SETTINGS
@given(st.lists(wild, min_size=4, max_size=4), st.sampled_from([torch.float32, torch.float64]))
def test_absurd_fisheyes_do_no_harm(coefficients: list[float], dtype: torch.dtype) -> None:
    columns = torch.tensor(coefficients, dtype=torch.float64).clamp(-torch.finfo(dtype).max, torch.finfo(dtype).max)
    check_honest(KannalaBrandt(columns.to(dtype)))


def check_honest(lens: BrownConrady | KannalaBrandt) -> None:
    """Whatever comes out is finite, and what is called valid goes back to where it came from."""
    assert float(lens.domain) >= 0
    scale = min(float(lens.domain), 1.0)
    xy = torch.cat([disc(factor, 1e-3)[:100] for factor in (2 * scale, 1.0, 1e3)]).to(lens.dtype).requires_grad_()
    direction, valid = lens.unproject(xy)
    assert direction.isfinite().all()
    again, valid_again = lens.project_direction(direction)
    assert again.isfinite().all()
    tolerance = 1e4 * torch.finfo(lens.dtype).eps
    both = valid & valid_again
    assert (size(again - xy)[both] <= tolerance * size(xy)[both]).all()
    assert (valid & ~valid_again).sum() <= 3  # a rounding may move a point at the edge over it
    (gradient,) = torch.autograd.grad(direction.sum(), xy)
    assert not gradient.isnan().any()
    assert (gradient[~valid] == 0).all()


@pytest.mark.parametrize("tau", [math.pi / 2, math.pi / 2 - 1e-5, -math.pi / 2])
@pytest.mark.parametrize("bend", [0.0, 23663.0])
def test_a_sensor_seen_edge_on_has_no_image(tau: float, bend: float) -> None:
    coefficients = torch.zeros(2, 14, dtype=torch.float64)
    coefficients[:, 2] = bend
    coefficients[0, 12], coefficients[1, 13] = tau, tau
    lens = BrownConrady(coefficients)
    assert (lens.domain == 0).all()
    assert not lens.undistort(torch.zeros(2, 1, 2, dtype=torch.float64) + 1e-17)[1].any()


def test_a_fold_far_beyond_the_strongest_terms_reach_is_seen() -> None:
    strong, weak = 419828660842.0, -14366218744.0
    lens = BrownConrady(torch.tensor([strong, 0, 0, 0, weak], dtype=torch.float64))
    # 1 + 3 k1 r^2 + 7 k3 r^6 = 0
    assert float(lens.domain) == pytest.approx((3 * strong / (7 * -weak)) ** 0.25, rel=1e-9)


@pytest.mark.slow
@settings(SETTINGS, max_examples=1500)
@given(sane_lenses())
def test_every_point_of_many_discs_is_found(coefficients: list[float]) -> None:
    test_every_point_of_the_disc_is_found.hypothesis.inner_test(coefficients)  # type: ignore[attr-defined]


@pytest.mark.slow
@settings(SETTINGS, max_examples=1500)
@given(absurd_lenses(), st.sampled_from([torch.float32, torch.float64]))
def test_many_absurd_lenses_do_no_harm(coefficients: list[float], dtype: torch.dtype) -> None:
    test_absurd_lenses_do_no_harm.hypothesis.inner_test(coefficients, dtype)  # type: ignore[attr-defined]
