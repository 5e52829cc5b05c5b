"""Noise of u and v apart, ellipses on the plane, cameras of a batch that saw nothing, and shifted origins."""

import pytest
import torch
from torch import Tensor

import diffproj as dp


def T(values: object) -> Tensor:
    """In float64."""
    return torch.tensor(values, dtype=torch.float64)


def street() -> dp.Camera:
    """The camera of UCMCTrack's example (Yi et al. 2024), its rotation made orthonormal."""
    rows = T([[0.13917, -0.99027, 0], [-0.06908, -0.00971, -0.99756], [0.98786, 0.13883, -0.06976]])
    U, _, Vh = torch.linalg.svd(rows)
    return dp.Camera(T([[1300.0, 0, 960], [0, 1300, 540], [0, 0, 1]]), U @ Vh, T([0.0, 1.31, 6.097]))


FOOT = T([[960.5, 593.0]])


def test_the_foot_of_a_box() -> None:
    """Deviations of u and v give the published mapper's covariance."""
    measured = dp.measure(FOOT, street(), dp.Plane.z(0.0), pixel_sigma=T([[5.45, 10.9]]))
    torch.testing.assert_close(measured.points[0, :2], T([9.51917, 1.33171]), atol=5e-5, rtol=0)
    expected = T([[1.3911, 0.1944], [0.1944, 0.0316]])
    torch.testing.assert_close(measured.covariance[0, :2, :2], expected, atol=1e-4, rtol=0)
    same = dp.measure(FOOT, street(), dp.Plane.z(0.0), pixel_sigma=torch.diag_embed(T([[5.45, 10.9]]).square()))
    torch.testing.assert_close(same.covariance, measured.covariance)
    for one, other in zip(same.interval(), measured.interval(), strict=True):
        torch.testing.assert_close(one, other)
    both = dp.measure(FOOT, street(), dp.Plane.z(0.0), pixel_sigma=5.45).ellipses(0.95)
    torch.testing.assert_close(both.half_axes[0], T([1.4575, 0.161]), atol=2e-4, rtol=0)


def test_correlated_noise_against_sampling() -> None:
    """A covariance of u and v reaches the plane as samples of it do."""
    C = T([[4.0, 2.5], [2.5, 3.0]])
    camera = dp.Camera(T([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]), t=T([0.0, 0, 10]))
    pixels = T([[100.0, 50], [500, 400]])
    measured = dp.measure(pixels, camera, dp.Plane([0.0, 0.3, 1.0], 0.5), pixel_sigma=C.expand(2, 2, 2))
    noise = torch.randn(40000, 1, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    shaken, _ = dp.back_project(pixels + noise @ torch.linalg.cholesky(C).mT, camera, dp.Plane([0.0, 0.3, 1.0], 0.5))
    for point in range(2):
        torch.testing.assert_close(measured.covariance[point], torch.cov(shaken[:, point].mT), rtol=0.04, atol=2e-6)
    ellipses = measured.ellipses(0.8)
    off = (shaken - measured.points).unsqueeze(-2) * ellipses.directions
    share = ((off.sum(-1) / ellipses.half_axes).square().sum(-1) < 1).to(torch.float64).mean(0)
    torch.testing.assert_close(share, T([0.8, 0.8]), atol=0.01, rtol=0)
    on_edge = (ellipses.outline(8) - ellipses.center.unsqueeze(-2)).norm(dim=-1)
    torch.testing.assert_close(on_edge.amax(-1), ellipses.half_axes[:, 0])


def test_gradients_flow_to_the_noise() -> None:
    """Of deviations and covariances."""
    for sigma in (T([[5.45, 10.9]]), T([[[30.0, 3], [3, 119.0]]])):
        given = sigma.requires_grad_()
        measured = dp.measure(FOOT, street(), dp.Plane.z(0.0), pixel_sigma=given)
        measured.covariance[0, 0, 0].backward()
        assert given.grad is not None
        assert bool((given.grad.diagonal(dim1=-2, dim2=-1) if given.ndim == 3 else given.grad).ge(0).all())


def test_angles_are_those_of_the_worlds_axes() -> None:
    """On z = 0 from x to y."""
    down = dp.Camera(
        T([[100.0, 0, 0], [0, 100, 0], [0, 0, 1]]), T([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), T([0.0, 0, 10])
    )
    turn = T(0.4)
    axes = torch.stack([torch.stack([turn.cos(), -turn.sin()]), torch.stack([turn.sin(), turn.cos()])])
    C = axes @ torch.diag(T([9.0, 1.0])) @ axes.mT
    C = C * T([[1.0, -1], [-1, 1]])  # the image's y points down
    found = dp.measure(T([[0.0, 0.0]]), down, dp.Plane.z(0.0), pixel_sigma=C.unsqueeze(0)).ellipses()
    assert found.angle[0] == pytest.approx(0.4)
    torch.testing.assert_close(found.half_axes[0, 0] / found.half_axes[0, 1], T(3.0))
    assert len(repr(found)) < 80


def test_noise_that_cannot_be() -> None:
    """Is named."""
    for sigma, message in (
        (T([[-1.0, 1.0]]), "want finite standard deviations of at least 0"),
        (T([[[1.0, 2.0], [2.0, 1.0]]]), "want symmetric covariances without negative eigenvalues"),
        (T([1.0, 2.0, 3.0]), "want a number or a shape that broadcasts to"),
    ):
        with pytest.raises(ValueError, match=message):
            dp.measure(FOOT, street(), dp.Plane.z(0.0), pixel_sigma=sigma)


def test_each_pixels_covariance_is_judged_by_its_own_size() -> None:
    pixels = FOOT.reshape(-1, 2)[:1].expand(3, 2)
    good = T([[[4.0, 1], [1, 2]], [[1e-8, 2e-9], [2e-9, 3e-8]], [[1.0, 0], [0, 1e-12]]])
    found = dp.measure(pixels, street(), dp.Plane.z(0.0), pixel_sigma=good)
    alone = [dp.measure(pixels[:1], street(), dp.Plane.z(0.0), pixel_sigma=C.unsqueeze(0)) for C in good]
    for each, one in zip(found.covariance, alone, strict=True):
        torch.testing.assert_close(each, one.covariance[0], rtol=1e-9, atol=0)
    uneven = good.clone()
    uneven[1, 0, 1] = 3e-9
    with pytest.raises(ValueError, match="want symmetric covariances"):
        dp.measure(pixels, street(), dp.Plane.z(0.0), pixel_sigma=uneven)


def test_a_camera_that_saw_nothing_does_not_stop_the_others() -> None:
    """Its points are not valid; theirs are what they are alone."""
    views, board = dp.example_views("left"), dp.Chessboard()
    camera = dp.calibrate(views, board).camera
    pair = dp.Views(torch.stack([views.pixels[:1], views.pixels[:1]]), size=views.size)
    blind = pair.hiding(torch.stack([torch.zeros(1, 54), torch.ones(1, 54)]) > 0)
    found = dp.locate(blind, board, camera, throw=False)
    pixels = views.pixels[0, :3]
    measured = dp.measure(pixels, found, dp.Plane.z(0.0), pixel_sigma=0.1)
    assert measured.valid.tolist() == [[True] * 3, [False] * 3]
    alone = dp.measure(pixels, dp.locate(views[:1], board, camera), dp.Plane.z(0.0), pixel_sigma=0.1)
    torch.testing.assert_close(measured.points[0], alone.points)
    torch.testing.assert_close(measured.deviations[0], alone.deviations, rtol=1e-6, atol=0)
    assert measured.deviations[1].isnan().all()
    assert measured.ellipses().half_axes[1].isnan().all()


def test_a_shifted_camera_measures_in_float32() -> None:
    """About an origin near the scene, what UTM has too many digits for."""
    origin = T([642734.0, 8304296.0, 0.0])
    R = T([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    far = dp.Camera(T([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), R, -R @ (origin + T([1.0, 2, 8])))
    pixels = T([[100.0, 80.0], [600, 400]])
    truth, _ = dp.back_project(pixels, far, dp.Plane.z(0.0))
    near = far.shifted(origin).to(torch.float32)
    found, _ = dp.back_project(pixels.to(torch.float32), near, dp.Plane.z(0.0).to(torch.float32))
    torch.testing.assert_close(found.to(torch.float64), truth - origin, atol=1e-5, rtol=0)
    many = far.shifted(torch.stack([origin, origin + 1]))
    assert many.batch_shape == (2,)


def test_maps_of_a_bare_camera() -> None:
    """With a number for the pixels' noise they are those of its own measurements."""
    camera = dp.Camera(T([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]]), t=T([0.0, 0, 10]), size=(640, 480))
    found = dp.AccuracyMap.over_image(camera, step=100, pixel_sigma=0.5)
    assert found.valid.all()
    torch.testing.assert_close(found.deviation, torch.full_like(found.deviation, 0.5 * 10 / 800))
    plane = dp.AccuracyMap.over_plane(camera, (-1, -1, 1, 1), shape=(3, 4), pixel_sigma=0.5)
    torch.testing.assert_close(plane.deviation, torch.full_like(plane.deviation, 0.5 * 10 / 800))
    with pytest.raises(ValueError, match="a camera alone does not know it"):
        dp.AccuracyMap.over_image(camera)
