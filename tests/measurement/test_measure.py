"""Measured points and lengths with error bars: Jacobians, limits, and what is refused. Sampling is in `test_sampling`."""

import math

import pytest
import torch

import diffproj as dp
from diffproj import synthetic
from diffproj.measurement.propagation import Propagated

D = torch.float64
BOARD = dp.Chessboard()
Z = dp.Plane.z(0.0)
LENSES = {
    "none": None,
    "brown5": dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002], dtype=D)),
    "brown14": dp.BrownConrady(
        torch.tensor([-0.2, 0.03, 0.001, 0.0, 0.01, 0.02, -0.01, 0, 0.002, 0, 0.001, 0, 0.02, -0.03], dtype=D)
    ),
    "fisheye": dp.KannalaBrandt(torch.tensor([0.02, -0.01, 0.004, -0.001], dtype=D)),
}


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    return dp.calibrate(dp.example_views("left"), BOARD)


def simulated(lens: str, views: int = 8) -> dp.Calibration:
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D)
    truth = synthetic.random_cameras(dp.Camera(K, distortion=LENSES[lens], size=(640, 480)), BOARD, views)
    seen = synthetic.corner_views(truth, BOARD)
    return dp.refine(seen, BOARD, truth, throw=False)


def redone(
    calibration: dp.Calibration, view: int, step: torch.Tensor, pixels: torch.Tensor, plane: dp.Plane
) -> torch.Tensor:
    """The points with the camera's parameters and the view's pose moved by a step, by the public back-projection.

    The pose turns about the middle of the board.
    """
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    camera = calibration.cameras[view]
    s = len(step) - 6
    K = camera.K.clone()
    K = K + torch.stack(
        [
            torch.stack([step[0], 0 * step[0], step[2]]),
            torch.stack([0 * step[0], step[1], step[3]]),
            torch.zeros(3, dtype=D),
        ]
    )
    lens = camera.distortion
    if lens is not None:
        lens = type(lens)(lens.coefficients + step[4:s])  # type: ignore[attr-defined, call-arg]
    R = axis_angle_to_rotation_matrix(step[None, s : s + 3])[0] @ camera.R
    middle = BOARD.points.to(D).mean(0)
    t = camera.t + camera.R @ middle + step[s + 3 :] - R @ middle
    points, valid = dp.back_project(pixels, dp.Camera.unchecked(K, R, t, lens, None), plane)
    assert valid.all()
    return points


@pytest.mark.parametrize("lens", list(LENSES))
@pytest.mark.parametrize("slanted", [False, True])
def test_jacobians_are_autograds(lens: str, slanted: bool) -> None:
    found = simulated(lens)
    plane = dp.Plane(torch.tensor([0.1, -0.2, 2.0], dtype=D), torch.tensor(7.0, dtype=D)) if slanted else Z
    pixels = found.views.pixels[3, ::9] + 2.5
    measured = dp.measure(pixels, found, plane, view=3, pixel_sigma=1.0, plane_covariance=torch.eye(4, dtype=D))
    size = found.covariance.view(3).shape[-1]
    by_theta = torch.func.jacfwd(lambda step: redone(found, 3, step, pixels, plane))(torch.zeros(size, dtype=D))
    scale = by_theta.abs().amax((0, 1))
    assert ((measured._noise.common[..., :size] - by_theta).abs().amax((0, 1)) <= 1e-8 * scale).all()
    by_pixel = torch.func.vmap(torch.func.jacfwd(lambda p: dp.back_project(p[None], found.cameras[3], plane)[0][0]))(
        pixels
    )
    torch.testing.assert_close(measured._noise.own, by_pixel, rtol=1e-8, atol=1e-10)

    def by_coefficients(abcd: torch.Tensor) -> torch.Tensor:
        return dp.back_project(pixels, found.cameras[3], dp.Plane(abcd[:3], abcd[3]))[0]

    abcd = torch.cat([plane.to(D).normal, plane.to(D).offset[None]])
    by_plane = torch.func.jacfwd(by_coefficients)(abcd)
    torch.testing.assert_close(measured._noise.common[..., size:], by_plane, rtol=1e-7, atol=1e-7)


def test_points_on_the_curve_are_those_of_moved_cameras() -> None:
    """Errors of camera, pose and pixels, followed by the shift of pixels that they amount to, up to the horizon."""
    found, plane = simulated("brown5"), dp.Plane([0.0, 1.0, 0.05], 300.0)
    horizon = dp.back_project(torch.tensor([[320.0, v] for v in range(480)], dtype=D), found.cameras[3], plane)[1]
    first = int(horizon.nonzero()[0])
    pixels = torch.tensor([[320.0, first + 3], [340, first + 100]], dtype=D)
    measured = dp.measure(pixels, found, plane, view=3, pixel_sigma=0.3)
    sight, Q = measured._noise.sight, measured._noise.sigma.shape[-1]
    for seed in range(5):
        draw = torch.randn(Q, generator=torch.Generator().manual_seed(seed), dtype=D)
        theta = (measured._noise.root() @ draw)[None]
        noise = torch.randn(1, 2, 2, generator=torch.Generator().manual_seed(seed), dtype=D)
        points, valid = sight.points(torch.tensor([[0, 1]]), theta, noise)
        assert valid.all()
        exact = redone(found, 3, theta[0], pixels + 0.3 * noise[0], plane)
        moved = (exact - measured.points).norm(dim=-1)
        assert ((points[0] - exact).norm(dim=-1) < 0.03 * moved).all()  # measured: 0.013


def test_joint_covariance_is_symmetric_and_positive(calibration: dp.Calibration) -> None:
    measured = dp.measure(calibration.views.pixels[0], calibration, Z, pixel_sigma=0.2, view=0)
    joint = measured.joint()
    assert joint.shape == (162, 162)
    torch.testing.assert_close(joint, joint.mT, rtol=1e-10, atol=1e-14)
    assert torch.linalg.eigvalsh(joint)[0] > -1e-10 * joint.diagonal().amax()
    blocks = torch.stack([joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(54)])
    torch.testing.assert_close(blocks, measured.covariance, rtol=1e-12, atol=1e-15)
    assert (measured.deviations[:, 2] < 1e-9).all()  # on the plane


def test_quantities_carry_the_joint_covariance(calibration: dp.Calibration) -> None:
    measured = dp.measure(calibration.views.pixels[0, [0, 8, 53, 45]], calibration, Z, view=0)
    joint = measured.joint()

    def want(function: object, which: list[int]) -> tuple[torch.Tensor, torch.Tensor]:
        points = measured.points.clone().requires_grad_()
        value = function(points[which])  # type: ignore[operator]
        g = torch.autograd.grad(value, points)[0].flatten()
        return value.detach(), (g @ joint @ g).sqrt()

    def check(got: dp.Quantity, function: object, which: list[int], row: int = 0) -> None:
        value, deviation = want(function, which)
        torch.testing.assert_close(got.value[row], value, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(got.deviation[row], deviation, rtol=1e-8, atol=1e-14)

    check(measured.lengths(), lambda p: (p[1] - p[0]).norm(), [1, 2], row=1)
    check(measured.lengths([[3, 1]]), lambda p: (p[1] - p[0]).norm(), [3, 1])
    square = measured.area()
    check(
        square, lambda p: ((p[2] - p[0])[0] * (p[3] - p[1])[1] - (p[2] - p[0])[1] * (p[3] - p[1])[0]) / 2, [0, 1, 2, 3]
    )
    assert square.value[0] == pytest.approx(200 * 125, rel=2e-3)
    right = measured.angles()
    assert right.value.shape == (2,)
    assert (right.value - torch.pi / 2).abs().max() < 0.01
    check(
        right,
        lambda p: ((p[0] - p[1]) @ (p[2] - p[1]) / (p[0] - p[1]).norm() / (p[2] - p[1]).norm()).acos(),
        [0, 1, 2],
    )
    low, high = measured.lengths().interval(0.6827)
    torch.testing.assert_close((high - low) / 2, measured.lengths().deviation, rtol=1e-3, atol=0)


def test_correlations_make_short_lengths_sure(calibration: dp.Calibration) -> None:
    start = calibration.views.pixels[0, 20]
    offsets = torch.tensor([0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0], dtype=D)
    pixels = start + torch.stack([offsets, 0 * offsets], dim=-1)
    exact = dp.measure(pixels, calibration, Z, pixel_sigma=0.0, view=0)
    lengths = exact.lengths([[0, i] for i in range(6)])
    ratio = lengths.deviation[1:] / lengths.value[1:]
    assert lengths.deviation[0] == 0
    assert (lengths.deviation[1:] < 0.02 * lengths.value[1:]).all()
    torch.testing.assert_close(ratio[0], ratio[1], rtol=0.01, atol=0)  # in proportion to the length
    noisy = dp.measure(pixels, calibration, Z, view=0, pixel_sigma="detector").lengths([[0, 1], [0, 5]])
    assert noisy.significant.tolist() == [False, True]
    assert (
        "less than three deviations from 0"
        in dp.measure(pixels[:2], calibration, Z, view=0, pixel_sigma="detector").summary()
    )


def test_points_counted_from_the_end_are_the_same_points(calibration: dp.Calibration) -> None:
    measured = dp.measure(calibration.views.pixels[0, :3], calibration, Z, view=0)

    def total(points: torch.Tensor) -> torch.Tensor:
        return (points[0] + points[1])[0]

    same, ends = measured.quantity(total, [[2, 2]]), measured.quantity(total, [[2, -1]])
    assert torch.equal(same.deviation, ends.deviation)
    with pytest.raises(IndexError, match="pairs: want numbers of the 3 points"):
        measured.lengths([[0, 3]])
    with pytest.raises(ValueError, match="pairs: want point numbers"):
        measured.lengths([[0, 1, 2]])
    with pytest.raises(ValueError, match="pixel_sigma: want finite standard deviations"):
        dp.measure(calibration.views.pixels[0, :3], calibration, Z, pixel_sigma=-1.0, view=0)
    with pytest.raises(ValueError, match="pixel_sigma: want a number or a shape"):
        dp.measure(calibration.views.pixels[0, :3], calibration, Z, pixel_sigma=torch.ones(2), view=0)


def test_a_view_by_number_or_name_and_a_camera_alone(calibration: dp.Calibration) -> None:
    pixels = calibration.views.pixels[4, [0, 53]]
    by_number = dp.measure(pixels, calibration, Z, view=4)
    by_name = dp.measure(pixels, calibration, Z, view="left05.jpg")
    assert torch.equal(by_number.joint(), by_name.joint())
    alone = dp.measure(pixels, calibration.cameras[4], Z, pixel_sigma=float(calibration.pixel_sigma))
    assert torch.equal(alone.points, by_number.points)
    assert not alone.includes_intrinsics
    assert (alone.deviations[:, :2] < by_number.deviations[:, :2]).all()
    assert "noise of the pixels alone" in alone.summary()
    assert "noise of the pixels alone" not in by_number.summary()


def test_a_saved_calibration_measures_just_as_well(calibration: dp.Calibration, tmp_path) -> None:
    dp.save_camera(tmp_path / "camera.json", calibration)
    again = dp.load_calibration(tmp_path / "camera.json")
    pixels = calibration.views.pixels[2, [0, 8, 53]]
    first, second = (dp.measure(pixels, c, Z, view=2) for c in (calibration, again))
    torch.testing.assert_close(second.joint(), first.joint(), rtol=1e-12, atol=1e-15)
    assert second.includes_intrinsics


def test_a_located_photograph_knows_the_intrinsics_uncertainty() -> None:
    views = dp.example_views("left")
    calibration = dp.calibrate(views[:8], BOARD)
    known, held = dp.locate(views[8:], BOARD, calibration), dp.locate(views[8:], BOARD, calibration.camera)
    assert torch.equal(known.cameras.t, held.cameras.t)
    torch.testing.assert_close(known.covariance.shared, calibration.covariance.shared)
    far = torch.tensor([[20.0, 20.0], [620.0, 460.0]], dtype=D)
    sure, unsure = (dp.measure(far, c, Z, view=1, pixel_sigma=0.2).lengths().deviation for c in (held, known))
    assert unsure > 1.1 * sure
    assert "noise of the pixels and the pose" in dp.measure(far, held, Z, view=1, pixel_sigma="detector").summary()
    assert "noise" not in dp.measure(far, known, Z, view=1, pixel_sigma="detector").summary()


@pytest.mark.parametrize("known", ["camera", "calibration"])
def test_pixels_beyond_the_photograph_are_told(calibration: dp.Calibration, known: str) -> None:
    """As those of a photograph of twice the size; the edge of a detector's box, counted from the corner, is none."""
    given = calibration if known == "calibration" else calibration.cameras[0]
    view = 0 if known == "calibration" else None
    edges = torch.tensor([[640.0, 480.0], [-1.0, -1.0], [320.0, 240.0]], dtype=D)
    dp.measure(edges, given, dp.Plane.z(0.0), view, 0.5)
    pixels = torch.cat([edges, torch.tensor([[320.0, 600.0], [660.0, 400.0]], dtype=D)])
    said = r"measure: pixel \(320, 600\) and 1 more outside of the photograph of 640 x 480 px"
    with pytest.warns(UserWarning, match=said):
        dp.measure(pixels, given, dp.Plane.z(0.0), view, 0.5)
    if known == "camera":  # nothing to compare with
        dp.measure(pixels, dp.Camera(given.K, given.R, given.t, given.distortion), dp.Plane.z(0.0), None, 0.5)


@pytest.mark.filterwarnings("ignore:measure. pixel")
def test_points_that_are_not_there(calibration: dp.Calibration) -> None:
    away = dp.Plane([0.0, 1.0, 0.05], -400.0)
    pixels = torch.tensor([[320.0, 10.0], [320.0, 470.0], [1e6, 0.0], [torch.nan, 0.0]], dtype=D)
    measured = dp.measure(pixels, calibration, away, view=0, pixel_sigma="detector")
    lengths = measured.lengths()
    assert measured.points.isfinite().all()
    assert torch.equal(measured.covariance.isnan().all(-1).all(-1), ~measured.valid)
    assert torch.equal(measured.joint().isfinite().all(-1).any(), torch.tensor(False))
    assert torch.equal(lengths.value.isnan(), ~(measured.valid[1:] & measured.valid[:-1]))
    assert "not on the plane" in measured.summary()


def test_what_is_not_determined_is_infinite() -> None:
    K = torch.tensor([[533.0, 0, 320], [0, 534, 240], [0, 0, 1]], dtype=D)
    angle = torch.tensor(0.5, dtype=D)
    alike = dp.rotation_from_euler(angle, 0 * angle, 0 * angle).expand(3, 3, 3)
    shifts = torch.tensor([[-100.0, -60, 500], [-80, -50, 600], [-90, -70, 450]], dtype=D)
    truth = dp.Camera(K, size=(640, 480)).at(alike, shifts)
    views = synthetic.corner_views(truth, BOARD)
    found = dp.refine(views, BOARD, truth, throw=False)
    covariance = found.covariance
    assert covariance.undetermined.any()
    assert not covariance.undetermined.all()
    assert covariance.deviations["f_x"].isinf()
    assert "not determined" in found.summary()
    full = covariance.full()
    assert not full.isnan().any()
    finite = torch.where(full.isinf(), 0.0, full)
    scale = finite.diagonal().clamp(min=1e-30).rsqrt()
    assert torch.linalg.eigvalsh(finite * scale * scale[:, None])[0] > -1e-6
    measured = dp.measure(views.pixels[0, [0, 5]], found, Z, view=0)
    joint = measured.joint()
    assert not joint.isnan().any()
    assert joint.diagonal().isinf()[[0, 1, 3, 4]].all()
    assert measured.lengths().deviation.isinf().all()
    assert "inf" in measured.summary()


def test_batched_and_differentiable() -> None:
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D)
    camera = dp.Camera(K, distortion=LENSES["brown5"], size=(640, 480))
    posed = synthetic.random_cameras(camera, BOARD, 16)
    truth = camera.at(posed.R.reshape(2, 8, 3, 3), posed.t.reshape(2, 8, 3))
    views = synthetic.corner_views(truth, BOARD)
    both = dp.calibrate(views, BOARD)
    measured = dp.measure(views.pixels[:, 1], both, Z, view=1, pixel_sigma="detector")
    assert measured.points.shape == (2, 54, 3)
    assert measured.joint().shape == (2, 162, 162)
    for i in range(2):
        alone = dp.calibrate(dp.Views(views.pixels[i], size=views.size), BOARD)
        single = dp.measure(views.pixels[i, 1], alone, Z, view=1, pixel_sigma="detector")
        torch.testing.assert_close(measured.lengths().deviation[i], single.lengths().deviation, rtol=1e-5, atol=0)

    def deviation(pixels: torch.Tensor) -> torch.Tensor:
        found = dp.measure(pixels, both, Z, view=1, pixel_sigma="detector")
        return found.lengths().deviation.sum() + found.points.sum()

    assert torch.autograd.gradcheck(deviation, (views.pixels[:, 1, ::27].clone().requires_grad_(),), fast_mode=True)


@pytest.mark.slow
def test_held_out_boards_agree_with_their_error_bars() -> None:
    """Distances between all corners of held-out views: errors over predicted deviations spread by about one."""
    pairs = torch.combinations(torch.arange(54), 2)
    for side in ("left", "right"):
        views = dp.example_views(side)
        calibration = dp.calibrate(views[:8], BOARD)
        located = dp.locate(views[8:], BOARD, calibration)
        points = BOARD.points
        truth = (points[pairs[:, 0]] - points[pairs[:, 1]]).norm(dim=-1)
        errors = []
        for view in range(5):
            lengths = dp.measure(located.views.pixels[view].to(D), located, Z, view=view).lengths(pairs)
            errors.append((lengths.value - truth) / lengths.deviation)
        assert 0.72 < torch.stack(errors).std() < 1.25  # measured: .84 and .77, on the cautious side


@pytest.mark.plain
def test_bad_input_is_refused_by_name(calibration: dp.Calibration) -> None:
    pixels = calibration.views.pixels[0, :2]
    with pytest.raises(ValueError, match="view: want one of left01.jpg, .* got 'left99.jpg'"):
        dp.measure(pixels, calibration, Z, view="left99.jpg")
    with pytest.raises(ValueError, match="view: want a number from -13 to 12, of the views, got 13"):
        dp.measure(pixels, calibration, Z, view=13)
    with pytest.raises(ValueError, match="pixel_sigma: want the noise of the pixels"):
        dp.measure(pixels, calibration.cameras[0], Z)
    missing = dp.calibrate(dp.example_views("left").hiding(torch.arange(13)[:, None].expand(13, 54) == 6), BOARD)
    with pytest.raises(ValueError, match="view: want one whose pose is known, got 6"):
        dp.measure(pixels, missing, Z, view=6)
    with pytest.raises(ValueError, match="level: want a probability between 0 and 1"):
        dp.measure(pixels, calibration, Z, view=0).lengths().interval(1.0)
    with pytest.raises(ValueError, match="points: want at least 3, got 2"):
        dp.measure(pixels, calibration, Z, view=0).angles()


def test_deviations_have_finite_gradients(calibration: dp.Calibration) -> None:
    """Also on a plane where one coordinate is exact."""
    pixels = calibration.views.pixels[0, [0, 8, 53]].clone().requires_grad_()
    total = dp.measure(pixels, calibration, Z, view=0, pixel_sigma="detector").deviations.sum()
    (gradient,) = torch.autograd.grad(total, pixels)
    assert gradient.isfinite().all()
    step = torch.zeros_like(pixels)
    step[1, 0] = 1e-3
    with torch.no_grad():
        up, down = (
            dp.measure(pixels + sign * step, calibration, Z, view=0, pixel_sigma="detector").deviations.sum()
            for sign in (1, -1)
        )
    assert float(gradient[1, 0]) == pytest.approx(float(up - down) / 2e-3, rel=1e-4)


@pytest.mark.parametrize("matrix", [-1e-2 * torch.eye(4), torch.ones(4, 4).tril(), math.nan * torch.eye(4)])
def test_a_plane_covariance_that_is_none_is_refused(calibration: dp.Calibration, matrix: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="plane_covariance: want a symmetric matrix without negative eigenvalues"):
        dp.measure(calibration.views.pixels[0], calibration, Z, plane_covariance=matrix.to(D), view=0)


def test_noise_that_is_none_is_refused_and_no_pixels_give_no_points(calibration: dp.Calibration) -> None:
    for sigma in (math.nan, math.inf, -1.0):
        with pytest.raises(ValueError, match="pixel_sigma: want finite standard deviations of at least 0"):
            dp.measure(calibration.views.pixels[0], calibration, Z, pixel_sigma=sigma, view=0)
    nothing = dp.measure(calibration.views.pixels[0, :0], calibration, Z, view=0)
    assert nothing.points.shape == nothing.deviations.shape == (0, 3)


def test_gradients_of_deviations_where_a_variance_is_zero() -> None:
    calibration = dp.calibrate(dp.example_views("left")[:6], dp.Chessboard(), "brown4")
    pixels = calibration.views.pixels[0, :3].clone().requires_grad_()
    K = calibration.camera.K.clone().requires_grad_()
    camera = calibration.cameras[0]
    camera = dp.Camera(K, camera.R, camera.t, camera.distortion)
    for source, sigma in ((calibration, None), (camera, 0.3), (camera, 0.0), (calibration, 0.0)):
        measured = dp.measure(pixels, source, dp.Plane.z(0.0), view=0, pixel_sigma=sigma)
        for found in (measured.deviations, measured.covariance, measured.lengths().deviation, measured.joint()):
            slopes = torch.autograd.grad(found.sum(), [pixels, K], allow_unused=True, retain_graph=True)
            assert all(slope is None or bool(slope.isfinite().all()) for slope in slopes)


def test_many_plane_covariances() -> None:
    calibration = dp.calibrate(dp.example_views("left")[:6], dp.Chessboard(), "brown4")
    pixels, plane = calibration.views.pixels[0, :3], dp.Plane([0.1, 0.2, 1.0], 3.0)
    covariances = torch.tensor([1e-6, 1e-4], dtype=torch.float64)[:, None, None] * torch.eye(4, dtype=torch.float64)
    many = dp.measure(pixels, calibration, plane, view=0, plane_covariance=covariances)
    for covariance, found in zip(covariances, many.deviations, strict=True):
        one = dp.measure(pixels, calibration, plane, view=0, plane_covariance=covariance)
        torch.testing.assert_close(found, one.deviations, rtol=1e-12, atol=0)
    assert many.lengths().interval()[0].shape == (2, 2)


def test_joint_covariance_of_many_is_that_of_each(calibration: dp.Calibration) -> None:
    pixels = calibration.views.pixels[:2, [0, 8, 45, 53, 20]]
    together = dp.measure(pixels, calibration, Z, view=0, pixel_sigma=0.5)
    assert together.joint().shape == (2, 15, 15)
    for each in range(2):
        alone = dp.measure(pixels[each], calibration, Z, view=0, pixel_sigma=0.5)
        torch.testing.assert_close(together.joint()[each], alone.joint(), rtol=1e-9, atol=1e-15)


@pytest.mark.filterwarnings("ignore:measure. pixel")  # those without a lens have a point
@pytest.mark.parametrize("far", [1e100, 1e200, 1e300, 1e308])
@pytest.mark.parametrize("lens", ["none", "brown5"])
def test_a_pixel_out_of_all_bounds_leaves_the_others_as_they_are(far: float, lens: str) -> None:
    """Its own errors are infinite, where it has a ray, and never NaN."""
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard(), lens)  # type: ignore[arg-type]
    pixels = torch.tensor([[far, 60.0], [100.0, 80.0], [-far, far]], dtype=D)
    options = {"view": 0, "pixel_sigma": 0.1, "plane_covariance": 1e-6 * torch.eye(4, dtype=D)}
    leaf = pixels.clone().requires_grad_()
    found, alone = (dp.measure(p, calibration, Z, **options) for p in (leaf, pixels[1:2]))
    torch.testing.assert_close(found.deviations[1], alone.deviations[0], rtol=1e-12, atol=0)
    told = torch.where(found.valid.unsqueeze(-1), found.deviations, 0.0)
    assert not bool(told.isnan().any())
    assert bool((told[[0, 2], :2].amax(-1) > 1e60)[found.valid[[0, 2]]].all())
    (gradient,) = torch.autograd.grad(found.deviations[1].sum(), leaf)
    assert bool(gradient.isfinite().all())


def test_lengths_of_a_batch_are_those_of_each() -> None:
    found = simulated("brown5")
    pixels = torch.stack([found.views.pixels[3, :8], found.views.pixels[3, 8:16]])
    pairs = [(0, 5), (1, 2)]
    many = dp.measure(pixels, found, Z, view=3, pixel_sigma=1.0).lengths(pairs)
    for number, one in enumerate(pixels):
        alone = dp.measure(one, found, Z, view=3, pixel_sigma=1.0).lengths(pairs)
        torch.testing.assert_close(many.value[number], alone.value)
        torch.testing.assert_close(many.deviation[number], alone.deviation)
        for bound, other in zip(many.interval(), alone.interval(), strict=True):
            torch.testing.assert_close(bound[number], other)


def test_errors_of_points_move_them_as_their_first_derivatives_say() -> None:
    """Of vectors of three points, one of them named twice: what a small step of each independent error does."""
    found = simulated("brown5")
    measured = dp.measure(found.views.pixels[3, :6], found, Z, view=3, pixel_sigma=1.0)
    index = torch.tensor([[0, 1, 2], [3, 4, 3]])
    spread = Propagated.of(measured._noise, index, torch.zeros(2, 1, 3, 3, dtype=D))
    steps, h = spread.steps(), 1e-4
    E = steps.shape[-3]
    for number in range(E):
        error = torch.zeros(2, E, dtype=D)
        error[:, number] = h
        (after, valid), (before, _) = spread.points(error), spread.points(-error)
        assert bool(valid.all())
        torch.testing.assert_close((after - before) / (2 * h), steps[:, number], rtol=1e-4, atol=1e-7)
