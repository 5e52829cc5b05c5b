"""Error bars: against refits, real and simulated, for each kind of fit; and the factor for errors that views share."""

import warnings
from dataclasses import replace
from typing import Any

import pytest
import torch

import diffproj as dp
from diffproj import synthetic
from tests.calibration.trust.smooth_errors import seen_at_random, with_smooth_errors

D = torch.float64
BOARD = dp.Chessboard()
SIGMA = 0.2


def subsets(views: dp.Views, size: int, draws: int, seed: int = 0) -> dp.Views:
    """Random subsets of the views of one camera, as a batch."""
    generator = torch.Generator().manual_seed(seed)
    visible = views.visible.expand(draws, -1, -1).clone()
    for i in range(draws):
        visible[i, torch.randperm(len(views), generator=generator)[size:]] = False
    return dp.Views(views.pixels.expand(draws, -1, -1, -1), visible, views.names, views.size)


@pytest.mark.parametrize("side", ["left", "right"])
def test_error_bars_of_real_photographs_hold(side: str) -> None:
    """Calibrations from some of the views differ from that of all of them by what their error bars say."""
    views = dp.example_views(side)
    whole = dp.calibrate(views, BOARD)
    variance = whole.covariance.shared.diagonal()[:4]
    ratios = []
    for size in (3, 5, 8):
        found = dp.calibrate(subsets(views, size, 100), BOARD)
        own = found.covariance.shared.diagonal(dim1=-2, dim2=-1)[:, :4]
        squares = (found.shared - whole.shared)[:, :4].square() / (own - variance)
        ratios.append(squares.abs().mean(0).sqrt())
    ratio = torch.stack(ratios)
    assert 0.6 < ratio.mean() < 1.3  # measured: .86 and .69, cautious
    assert ratio.amax() < 1.9
    assert whole.covariance.dispersion > 4  # without it: 2.5 on average, 4.4 at most


@pytest.mark.parametrize("count", [8, 20])
@pytest.mark.parametrize("together_px", [0.1, 0.3])
def test_errors_that_go_together_within_a_view_are_held(count: int, together_px: float) -> None:
    """Fields that are smooth over the board, others in each view, beside noise of .1 px: as another perspective would.

    RMS of the errors of focal lengths and principal point, in their deviations: .97 to 1.21, and 1.2 to 1.46 where the
    contradiction of the views was averaged over all directions of the parameters.
    """
    camera = scene(1)[0]
    views = with_smooth_errors(seen_at_random(camera, BOARD, 200, count), BOARD.points, together_px)
    found = dp.calibrate(views, BOARD)
    truth = torch.cat([camera.K.diagonal()[:2], camera.K[:2, 2]])
    off = (found.shared[:, :4] - truth) / found.covariance.shared.diagonal(dim1=-2, dim2=-1)[:, :4].sqrt()
    ratio = off.square().mean(0).sqrt()
    assert ratio.amin() > 0.92
    assert ratio.amax() < 1.25


def scene(count: int) -> dp.Camera:
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D)
    lens = dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001], dtype=D))
    return synthetic.random_cameras(dp.Camera(K, distortion=lens, size=(640, 480)), BOARD, count, seed=5)


def errors(found: dp.Calibration, cameras: dp.Camera, view: int) -> torch.Tensor:
    """Errors of the shared parameters and of a pose, in the order of `covariance.view`."""
    truth = torch.cat([cameras.K[0].diagonal()[:2], cameras.K[0, :2, 2], cameras.distortion.coefficients[0]])
    turned = found.cameras.R[:, view] @ cameras.R[view].mT
    omega = torch.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], dim=-1)
    return torch.cat([found.shared - truth, omega, found.cameras.t[:, view] - cameras.t[view]], dim=-1)


def fitted(
    cameras: dp.Camera, noise: torch.Tensor, visible: torch.Tensor | None = None, **options: Any
) -> dp.Calibration:
    exact, seen = cameras.project(BOARD.points)
    assert seen.all()
    start = cameras.at(cameras.R.expand(len(noise), -1, -1, -1), cameras.t)
    return dp.refine(dp.Views(exact + noise, visible, size=(640, 480)), BOARD, start, **options)


def contaminated(shape: tuple[int, ...], generator: torch.Generator) -> torch.Tensor:
    """One corner in ten has five times the noise."""
    noise = SIGMA * torch.randn(shape, generator=generator, dtype=D)
    return noise * torch.where(torch.rand(shape[:-1], generator=generator) < 0.1, 5.0, 1.0).unsqueeze(-1)


KINDS: dict[str, dict[str, Any]] = {
    "least squares": {},
    "Huber": {"loss": dp.Huber(0.4)},
    "Cauchy": {"loss": dp.Cauchy(0.5)},
    "plane": {"objective": "plane"},
    "weights": {"weights": torch.tensor(25.0, dtype=D)},
}


@pytest.mark.parametrize("kind", KINDS)
def test_joint_error_of_parameters_and_pose(kind: str) -> None:
    """The squared standardised error is one for each degree of freedom: the covariance as a whole, not its diagonal."""
    cameras = scene(10)
    generator = torch.Generator().manual_seed(1)
    shape = (100, 10, 54, 2)
    noise = contaminated(shape, generator) if "loss" in KINDS[kind] else SIGMA * torch.randn(
        shape, generator=generator, dtype=D
    )  # fmt: skip
    found = fitted(cameras, noise, **KINDS[kind])
    error = errors(found, cameras, 3)
    joint = (error * torch.linalg.solve(found.covariance.view(3), error)).sum(-1) / error.shape[-1]
    assert 0.89 < float(joint.mean()) < 1.11  # 100 trials of 14 squares: 1 +- 0.04
    assert float(found.covariance.dispersion.mean()) < 1.05


@pytest.mark.parametrize("loss", [None, pytest.param(dp.Huber(0.4), marks=pytest.mark.slow)])
def test_joint_error_with_few_corners_a_view(loss: dp.Loss | None) -> None:
    cameras = scene(20)
    visible = torch.zeros(20, 54, dtype=torch.bool)
    visible[:, torch.linspace(0, 53, 8).long()] = True
    generator = torch.Generator().manual_seed(2)
    found = fitted(cameras, contaminated((60, 20, 54, 2), generator), visible, loss=loss, throw=False)
    error = errors(found, cameras, 3)
    joint = (error * torch.linalg.solve(found.covariance.view(3), error)).sum(-1) / error.shape[-1]
    assert 0.75 < float(joint.median()) < 1.3


def test_covariance_of_the_plane_objective_is_the_dense_one() -> None:
    """Without blocks: H^-1 M H^-1 with the noise of the image, by finite differences of the residuals on the plane."""
    cameras = scene(4)
    exact, _ = cameras.project(BOARD.points)
    noise = SIGMA * torch.randn(exact.shape, generator=torch.Generator().manual_seed(3), dtype=D)
    views = dp.Views(exact + noise, size=(640, 480))
    found = dp.refine(views, BOARD, cameras, objective="plane")
    parameters = found.parameters
    pose = torch.zeros(4, 6, dtype=D)

    def landed(shared: torch.Tensor, pose: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        from diffproj.calibration.problem.parametrisation import moved

        posed = parameters.unpack(shared.expand(4, -1), moved((found.cameras.R, found.cameras.t), pose))
        return dp.back_project(pixels, posed, dp.Plane.z(0.0))[0][..., :2]

    by_shared, by_pose, by_pixel = torch.autograd.functional.jacobian(
        landed, (found.shared, pose, views.pixels), vectorize=True
    )
    J = torch.cat([by_shared.flatten(0, 2), by_pose.flatten(0, 2).flatten(1)], dim=-1)
    G = by_pixel.flatten(0, 2).flatten(1)
    inverse = torch.linalg.inv(J.mT @ J)
    pull = J.mT @ G
    want = inverse @ (pull @ pull.mT) @ inverse * found.pixel_sigma.square() * found.covariance.dispersion
    scale = want.diagonal().rsqrt()
    difference = (found.covariance.full() - want) * scale * scale.unsqueeze(-1)
    assert difference.abs().amax() < 2e-2  # the residuals' own derivatives, which Gauss and Newton leave out


def waves(count: int, strength: float, generator: torch.Generator) -> torch.Tensor:
    """An error of each view that varies slowly over the board: random quadratic fields."""
    x = BOARD.points[:, 0] / 100 - 1
    y = BOARD.points[:, 1] / 62.5 - 1
    fields = torch.stack([x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
    return strength * torch.einsum("fn,bvfk->bvnk", fields, torch.randn(count, 10, 7, 2, generator=generator, dtype=D))


def test_errors_that_go_together_within_a_view_are_seen() -> None:
    cameras = scene(10)
    generator = torch.Generator().manual_seed(4)
    noise = 0.1 * torch.randn(100, 10, 54, 2, generator=generator, dtype=D) + waves(100, 0.1, generator)
    found = fitted(cameras, noise)
    factor = found.covariance.dispersion
    assert float(factor.amin()) > 2
    standard = errors(found, cameras, 0)[:, :4] / found.covariance.shared.diagonal(dim1=-2, dim2=-1)[:, :4].sqrt()
    assert 0.6 < float(standard.square().mean().sqrt()) < 1.2
    assert float((standard.square().mean(0) * factor.mean()).sqrt().amin()) > 1.4  # without the factor


def test_dispersion_is_one_where_there_is_nothing_to_compare() -> None:
    views = dp.example_views("left")
    camera = dp.calibrate(views, BOARD).camera
    assert dp.locate(views, BOARD, camera).covariance.dispersion == 1
    alone = dp.refine(views[3:4], BOARD, camera, fixed=("principal_point", "distortion"))
    assert alone.covariance.dispersion == 1
    exact, _ = scene(4).project(BOARD.points)
    assert dp.calibrate(dp.Views(exact, size=(640, 480)), BOARD, "brown4").covariance.shared.isfinite().all()


def test_dispersion_of_two_views_and_of_one_with_a_prior() -> None:
    """Two views see the same board bent in two ways; one view contradicts a prior, but no other view."""
    cameras = scene(2)
    generator = torch.Generator().manual_seed(4)
    noise = 0.02 * torch.randn(20, 2, 54, 2, generator=generator, dtype=D) + waves(20, 0.3, generator)[:, :2]
    exact, _ = cameras.project(BOARD.points)
    both, first = (dp.Views(pixels, size=(640, 480)) for pixels in (exact + noise, (exact + noise)[:, :1]))
    start = cameras[0].without_pose()
    two = dp.refine(both, BOARD, start, fixed=("principal_point", "distortion"))
    assert float(two.covariance.dispersion.median()) > 2
    known = {"f_x": (1.1 * start.K[0, 0], 0.001), "f_y": (1.1 * start.K[1, 1], 0.001)}
    one = dp.refine(first, BOARD, start, fixed=("principal_point", "distortion"), priors=known)
    assert bool((one.covariance.dispersion == 1).all())


def test_dispersion_does_not_depend_on_units_order_or_batch() -> None:
    views = dp.example_views("right")
    found = dp.calibrate(views, BOARD).covariance.dispersion
    small = dp.calibrate(views, dp.Chessboard(9, 6, 25e-6)).covariance.dispersion
    turned = dp.calibrate(views[list(range(12, -1, -1))], BOARD).covariance.dispersion
    weighted = dp.calibrate(views, BOARD, weights=torch.tensor(1e4, dtype=D)).covariance.dispersion
    both = dp.calibrate(
        dp.Views(torch.stack([views.pixels, dp.example_views("left").pixels]), size=views.size), BOARD
    ).covariance.dispersion
    for other in (small, turned, weighted, both[0]):
        torch.testing.assert_close(other, found, rtol=1e-5, atol=0)
    assert both.shape == (2,)


def test_a_file_of_an_earlier_version_has_no_dispersion() -> None:
    covariance = dp.calibrate(dp.example_views("left"), BOARD).covariance
    fields = covariance.to_fields()
    again = dp.Covariance.from_fields(fields)
    assert torch.equal(again.dispersion, covariance.dispersion)
    del fields["dispersion"]
    assert dp.Covariance.from_fields(fields).dispersion == 1


@pytest.mark.slow
@pytest.mark.parametrize("corners", [4, 6, 54])
def test_few_corners_are_located_with_the_noise_of_the_calibration(corners: int) -> None:
    """Their own residuals hardly tell it: from four corners alone, intervals of 95 % held 86 %, or were far too wide."""
    cameras = scene(11)
    exact, _ = cameras.project(BOARD.points)
    generator = torch.Generator().manual_seed(6)
    noisy = exact + SIGMA * torch.randn(600, *exact.shape, generator=generator, dtype=D)
    found = dp.calibrate(dp.Views(noisy[:, :10], size=(640, 480)), BOARD, "brown4")
    visible = torch.zeros(1, 54, dtype=torch.bool)
    visible[0, [0, 53, 8, 45, 22, 31, *range(54)][:corners]] = True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.AmbiguousPoseWarning)
        warnings.simplefilter("ignore", dp.CameraMismatchWarning)  # of 600 views, some are taken for another camera's
        located = dp.locate(dp.Views(noisy[:, 10:], visible.expand(600, -1, -1), size=(640, 480)), BOARD, found)
    assert found.degrees_of_freedom is not None
    assert located.degrees_of_freedom is not None
    pooled = located.degrees_of_freedom > found.degrees_of_freedom
    assert float(pooled.double().mean()) > 0.97
    places = torch.tensor([[25.0, 25, 0], [175, 100, 0], [100, 60, 0]], dtype=D)
    pixels = cameras[10].project(places)[0] + SIGMA * torch.randn(600, 3, 2, generator=generator, dtype=D)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.CameraMismatchWarning)
        low, high = dp.measure(pixels, located, dp.Plane.z(0.0), pixel_sigma="detector").interval()
    inside = ((low <= places) & (places <= high))[..., :2].double().mean()
    assert 0.93 < float(inside) < 0.97
    # Corners that are far noisier than the calibration's tell their own noise.
    worse = exact[10:] + 20 * SIGMA * torch.randn(1, 54, 2, generator=generator, dtype=D)
    one = dp.calibrate(dp.Views(noisy[0, :10], size=(640, 480)), BOARD, "brown4")
    with pytest.warns(dp.CameraMismatchWarning, match="times the calibration's"):
        own = dp.locate(dp.Views(worse, size=(640, 480)), BOARD, one)
    assert own.pixel_sigma == pytest.approx(20 * SIGMA, rel=0.3)


def test_few_degrees_of_freedom_do_not_blow_error_bars_up() -> None:
    """Three views without a lens say two things more than they need: chance, which is not taken for dispersion."""
    generator = torch.Generator().manual_seed(8)
    bare = scene(3)
    cameras = dp.Camera(bare.K, bare.R, bare.t, size=(640, 480))
    exact, seen = cameras.project(BOARD.points)
    assert seen.all()
    noisy = exact + SIGMA * torch.randn(150, *exact.shape, generator=generator, dtype=D)
    found = dp.calibrate(dp.Views(noisy, size=(640, 480)), BOARD, "none")
    assert float(found.covariance.dispersion.mean()) < 1.2  # without this 1.8, and up to 18
    assert float(found.covariance.dispersion.amax()) < 6


@pytest.mark.parametrize("objective", ["image", "plane"])
@pytest.mark.parametrize("loss", [None, dp.Huber(1.0)])
def test_corners_that_are_met_exactly_by_any_noise_tell_no_deviation(loss: dp.Loss | None, objective: Any) -> None:
    """Four corners in each of two views are 16 coordinates for two poses and four intrinsics."""
    bare = scene(2)
    exact, _ = dp.Camera(bare.K, bare.R, bare.t).project(BOARD.points)
    noise = SIGMA * torch.randn(exact.shape, generator=torch.Generator().manual_seed(0), dtype=D)
    four = torch.zeros(2, 54, dtype=torch.bool)
    four[:, [0, 8, 45, 53]] = True
    views = dp.Views(exact + noise, four, size=(640, 480))
    found = dp.calibrate(views, BOARD, "none", loss=loss, objective=objective, throw=False)
    assert found.degrees_of_freedom == 0
    assert found.covariance.shared.diagonal().isnan().all()


def test_a_file_holds_0_for_a_variance_that_nothing_tells() -> None:
    """JSON has no infinity; which they are, the mask says."""
    known = dp.calibrate(dp.example_views("left"), dp.Chessboard(), "brown4").covariance
    shared, lost = known.shared.clone(), known.undetermined.clone()
    shared[2], shared[:, 2], lost[2] = 0.0, 0.0, True
    shared[2, 2] = torch.inf
    fields = replace(known, shared=shared, undetermined=lost).to_fields()
    assert fields["shared"][2] == [0.0] * len(known.names)
    again = dp.Covariance.from_fields(fields)
    assert torch.equal(again.shared, shared)
    assert again.deviations["c_x"].isinf()
