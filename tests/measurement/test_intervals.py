"""Intervals against sampling: near zero, near the horizon, and with deviations that were estimated from few residuals.

Of n trials a coverage of 95 % is known to 0.22 sqrt(1e4 / n) %: 0.5 % for 2000. The bounds are 93 and 97 %.
"""

import itertools
import math
import warnings
from dataclasses import replace

import pytest
import torch

import diffproj as dp
from diffproj.measurement import folded
from diffproj.measurement.intervals import _steps_to_zero
from diffproj.measurement.propagation import Propagated

D = torch.float64
Z = dp.Plane.z(0.0)
K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=D)
FRONTAL = dp.Camera(K, t=torch.tensor([0.0, 0, 1000], dtype=D))
TILTED = FRONTAL.at(dp.rotation_from_euler(*torch.tensor([1.2, 0, 0], dtype=D)), FRONTAL.t)
LEVEL, FLOOR = dp.Camera(K), dp.Plane([0.0, 1.0, 0.0], 1500.0)  # looks to the horizon, at v = 240
SIGMA = 0.5


def seen(exact: list[list[float]], trials: int = 2000, sigma: float = SIGMA) -> torch.Tensor:
    places = torch.tensor(exact, dtype=D)
    return places + sigma * torch.randn(trials, *places.shape, generator=torch.Generator().manual_seed(1), dtype=D)


def covered(bounds: tuple[torch.Tensor, torch.Tensor], truth: torch.Tensor) -> float:
    """In how many of a hundred valid trials the truth lies in the interval, but for rounding."""
    low, high = bounds
    known = ~low.isnan()
    rounding = 1e-12 * (1 + truth.abs())
    return 100 * float(((low <= truth + rounding) & (truth - rounding <= high))[known].double().mean())


def number(measured: dp.Measurement, what: str) -> dp.Quantity:
    return getattr(measured, what)()


SEPARATIONS = [0.0, 0.5, 1.0, 2.0, 3.0, 6.0, 50.0]


@pytest.mark.parametrize("deviations", SEPARATIONS)
@pytest.mark.parametrize("along", [0, 1], ids=["aside", "behind"])
@pytest.mark.parametrize("camera", [FRONTAL, TILTED], ids=["frontal", "tilted"])
def test_lengths_near_zero(camera: dp.Camera, along: int, deviations: float) -> None:
    """Measured: 94.0 to 95.6 %; aside of a tilted camera, where noise is larger across, up to 99.0 %."""
    step = [0.0, 0.0]
    step[along] = deviations * SIGMA * math.sqrt(2)
    exact = [[320.0, 260.0], [320.0 + step[0], 260.0 + step[1]]]
    truth = dp.measure(torch.tensor(exact, dtype=D), camera, Z, pixel_sigma=SIGMA).lengths()
    found = dp.measure(seen(exact), camera, Z, pixel_sigma=SIGMA).lengths()
    low, high = found.interval()
    assert (low >= 0).all()
    assert (high > 0).all()
    conservative = camera is TILTED and along == 0
    assert 93 < covered((low, high), truth.value) < (99.5 if conservative else 97)
    error = (found.value - truth.value).square().mean().sqrt()
    if deviations in (0, 50):
        torch.testing.assert_close(error, truth.deviation[0], rtol=0.05, atol=0)


@pytest.mark.parametrize("deviations", [0.0, 0.5, 1.0, 2.0, 3.0, 50.0])
@pytest.mark.parametrize("what", ["angles", "area"])
def test_straight_angles_and_flat_areas(what: str, deviations: float) -> None:
    """Three points on a line: the deviation is that of the noise, not 0. Measured: 94.1 to 95.6 %."""
    exact = [[100.0, 200], [300, 200 + deviations * SIGMA * math.sqrt(6) / 2], [500, 200]]
    truth = number(dp.measure(torch.tensor(exact, dtype=D), FRONTAL, Z, pixel_sigma=SIGMA), what)
    found = number(dp.measure(seen(exact), FRONTAL, Z, pixel_sigma=SIGMA), what)
    low, high = found.interval()
    assert 93 < covered((low, high), truth.value) < 97
    assert (low >= 0).all()
    assert (high <= (torch.pi if what == "angles" else torch.inf)).all()
    if deviations == 0:
        # Points 400 mm apart, each known to 1 mm: the angle to sqrt(6) / 400, the area to 400 / 2 sqrt(6).
        want = math.sqrt(6) / 400 if what == "angles" else 200 * math.sqrt(6)
        assert float(truth.deviation) == pytest.approx(want, rel=1e-3)
        error = (found.value - truth.value).square().mean().sqrt()
        assert float(error) == pytest.approx(want, rel=0.05)
        assert truth.nonlinear.all()


def test_angle_zero_and_arms_without_length() -> None:
    exact = [[300.0, 200], [100, 200], [500, 200]]
    found = dp.measure(seen(exact), FRONTAL, Z, pixel_sigma=SIGMA).angles()
    assert 93 < covered(found.interval(), torch.tensor(0.0, dtype=D)) < 97
    for arm in (0.0, 1.0, 3.0):  # deviations of a click; measured: 95.0 to 97.7 %
        exact = [[300.0 + arm * SIGMA, 200], [300, 200], [500, 210]]
        truth = torch.tensor(math.atan2(10, 200) if arm else 1.0, dtype=D)  # without an arm any angle is as true
        found = dp.measure(seen(exact), FRONTAL, Z, pixel_sigma=SIGMA).angles()
        assert 93 < covered(found.interval(), truth) < 98
    nothing = dp.measure(torch.tensor([[300.0, 200], [300, 200], [500, 210]], dtype=D), FRONTAL, Z, pixel_sigma=SIGMA)
    assert nothing.angles().deviation.isinf().all()
    assert [float(bound) for bound in nothing.angles().interval()] == [0, pytest.approx(math.pi)]


def test_right_angles_between_rows_and_columns_of_pixels() -> None:
    """Straight above a plane, clicks on whole pixels give arms whose product is exactly 0. Measured: 94.9 %."""
    exact = [[300.0, 200], [200, 200], [200, 300]]
    pixels = torch.tensor(exact, dtype=D, requires_grad=True)
    found = dp.measure(pixels, FRONTAL, Z, pixel_sigma=SIGMA).angles()
    assert float(found.value.detach()) == math.pi / 2
    # Each arm is 200 mm long and turns by the noise of its end and of the corner, 1 mm each.
    assert float(found.deviation.detach()) == pytest.approx(2 / 200, rel=1e-6)
    (slope,) = torch.autograd.grad(found.value.sum(), pixels)
    torch.testing.assert_close(slope, torch.tensor([[0.0, -1], [1, 1], [-1, 0]], dtype=D) / 100)
    many = dp.measure(seen(exact), FRONTAL, Z, pixel_sigma=SIGMA).angles()
    assert 93 < covered(many.interval(), torch.tensor(math.pi / 2, dtype=D)) < 97
    low, high = found.interval()
    assert float(high - low) == pytest.approx(2 * 1.96 * 2 / 200, rel=1e-2)


def test_two_clicks_on_one_pixel() -> None:
    measured = dp.measure(torch.tensor([[320.0, 260], [320, 260]], dtype=D), FRONTAL, Z, pixel_sigma=SIGMA)
    length = measured.lengths()
    # Each click is known to 1 mm along both axes.
    assert float(length.value) == 0
    assert float(length.deviation) == pytest.approx(2, rel=1e-6)
    low, high = length.interval()
    assert float(low) == 0
    assert float(high) == pytest.approx(1.959964 * math.sqrt(2), rel=1e-6)
    assert not length.significant
    same = measured.lengths([[1, 1]])
    assert (float(same.value), float(same.deviation), *map(float, same.interval())) == (0, 0, 0, 0)
    own = measured.quantity(lambda p: (p[1] - p[0]).norm(), [[0, 1]])
    assert float(own.deviation) == pytest.approx(2, rel=1e-6)
    assert float(own.interval()[1]) == pytest.approx(2 * 1.959964, rel=1e-6)


def test_far_from_zero_and_the_horizon_all_is_as_to_first_order() -> None:
    pixels = torch.tensor([[100.0, 130], [520, 160], [470, 400], [140, 350]], dtype=D)
    measured = dp.measure(pixels, TILTED, Z, pixel_sigma=1e-3)
    joint = measured.joint()
    for name, function in {
        "lengths": lambda p: (p[1] - p[0]).norm(),
        "angles": lambda p: torch.nn.functional.cosine_similarity(p[0] - p[1], p[2] - p[1], dim=0).acos(),
        "area": lambda p: sum(torch.linalg.cross(p[i], p[(i + 1) % 4])[2] for i in range(4)).abs() / 2,
    }.items():
        found = number(measured, name)
        index = {"lengths": [0, 1], "angles": [0, 1, 2], "area": [0, 1, 2, 3]}[name]
        points = measured.points[index].requires_grad_()
        value = function(points)
        g = torch.zeros(12, dtype=D)
        g[[3 * i + axis for i in index for axis in range(3)]] = torch.autograd.grad(value, points)[0].flatten()
        deviation = (g @ joint @ g).sqrt()
        torch.testing.assert_close(found.value[0], value.detach(), rtol=1e-10, atol=0)
        torch.testing.assert_close(found.deviation[0], deviation, rtol=1e-6, atol=0)
        low, high = found.interval()
        torch.testing.assert_close(high[0] - value.detach(), 1.959964 * deviation, rtol=2e-3, atol=0)
        torch.testing.assert_close(value.detach() - low[0], 1.959964 * deviation, rtol=2e-3, atol=0)
        assert not found.nonlinear.any()
        assert torch.equal(measured.quantity(function, [index]).deviation > 0, torch.tensor([True]))
    assert not measured.nonlinear.any()


@pytest.mark.parametrize("below", [5.0, 2.0, 1.0, 0.5])
def test_near_the_horizon(below: float) -> None:
    """Pixels that far below the horizon. Measured: 94.3 to 97.1 %; of `value -+ 1.96 deviation` 81.9 to 99.9 %.

    Half a pixel below, noise lifts one point in six above the horizon; 97 % is right for the others.
    """
    exact = [[320.0, 240 + below], [320, 300], [420, 240 + below]]
    truth = dp.measure(torch.tensor(exact, dtype=D), LEVEL, FLOOR, pixel_sigma=SIGMA)
    found = dp.measure(seen(exact), LEVEL, FLOOR, pixel_sigma=SIGMA)
    low, high = found.interval()
    for point, axis in itertools.product(range(3), (0, 2)):
        bounds = low[:, point, axis], high[:, point, axis]
        assert 93 < covered(bounds, truth.points[point, axis]) < 98, (point, axis)
    lengths, (low, high) = found.lengths([[0, 1]]), found.lengths([[0, 1]]).interval()
    assert 93 < covered((low, high), truth.lengths([[0, 1]]).value) < 98
    known = ~lengths.value.isnan()
    assert (low[known] >= 0).all()
    assert (high[known] > lengths.value[known]).all()
    assert truth.nonlinear.tolist() == [True, False, True]
    assert truth.lengths([[0, 1]]).nonlinear.all()
    text = truth.summary()
    assert "nonlinear" in text.splitlines()[0]
    assert "nonlinear" not in text.splitlines()[1]
    assert "nonlinear, 95 %: " in text
    assert "Nonlinear: close to the horizon or to zero" in text


def test_bounds_are_infinite_where_the_noise_reaches_the_horizon() -> None:
    measured = dp.measure(torch.tensor([[320.0, 240.9], [320, 300]], dtype=D), LEVEL, FLOOR, pixel_sigma=SIGMA)
    low, high = measured.interval()
    assert high[0, 2].isinf()
    assert low[0, 2] > 1500 * 500 / (0.9 + 2 * SIGMA)
    low, high = measured.lengths().interval()
    assert high.isinf().all()
    assert (low > 0).all()
    assert measured.lengths().interval(0.5)[1].isfinite().all()


def test_bounds_are_the_extremes_over_all_errors_of_that_size() -> None:
    """Against the slow way: thousands of errors of that size, each followed on the curve."""
    setup = dp.calibrate(dp.example_views("left"), dp.Chessboard())
    known = setup.covariance_of_kept_poses  # as small as for corners that err independently: random draws reach more
    small = replace(known, **{n: getattr(known, n) / known.dispersion for n in ("shared", "_mixed", "_alone")})
    setup = replace(setup, _covariance=lambda: small)
    plane = dp.Plane([0.0, 1.0, 0.02], 300.0)
    spread = torch.diag(torch.tensor([1e-6, 1e-6, 1e-6, 1.0], dtype=D))
    pixels = torch.tensor([[320.0, 160.0], [330, 170]], dtype=D)
    measured = dp.measure(pixels, setup, plane, view=0, pixel_sigma=0.5, plane_covariance=spread)
    low, high = measured.lengths().interval()
    noise = measured._noise
    errors = torch.randn(20000, noise.sigma.shape[-1] + 4, generator=torch.Generator().manual_seed(3), dtype=D)
    errors[:, :-4] *= 0.3  # most of the spread is the pixels'
    errors = 1.959964 * errors / errors.norm(dim=-1, keepdim=True)
    theta = errors[:, :-4] @ noise.root().mT
    index = torch.arange(2).expand(20000, 2)
    points, valid = noise.sight.points(index, theta, errors[:, -4:].reshape(-1, 2, 2))
    assert valid.all()
    lengths = points.diff(dim=-2).norm(dim=-1)
    assert low <= lengths.min()
    assert lengths.max() <= high
    reached = (lengths.max() - lengths.min()) / (high - low)
    assert reached > 0.8  # random errors hardly point the best way


@pytest.mark.parametrize("corners", [4, *(pytest.param(n, marks=pytest.mark.slow) for n in (5, 8))])
def test_estimated_from_few_corners(corners: int) -> None:
    """A view located by few corners, at its own residual level. Measured: 94.4 to 95.0 and 98.6 to 99.0 %.

    With normal intervals it is 81 and 87 % for 4 corners.
    """

    class Target:
        points = dp.Chessboard().points[[0, 8, 53, 45, 22, 4, 49, 31][:corners]]

    camera = dp.Camera(torch.tensor([[800.0, 0, 639.5], [0, 800, 479.5], [0, 0, 1]], dtype=D), size=(1280, 960))
    posed = camera.at(
        dp.rotation_from_euler(*torch.tensor([0.5, 0.3, 0.2], dtype=D)), torch.tensor([-80.0, -50, 500], dtype=D)
    )
    exact, _ = posed.project(Target.points)
    views = dp.Views(seen(exact.tolist(), 1500, 0.3).unsqueeze(1), size=(1280, 960))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.AmbiguousPoseWarning)  # a few of so many
        located = dp.locate(views, Target, camera, throw=False)
    assert located.degrees_of_freedom is not None
    assert (located.degrees_of_freedom == 2 * corners - 6).all()
    places = torch.tensor([[0.0, 0, 0], [200, 0, 0], [100, 125, 0]], dtype=D)
    noise = 0.3 * torch.randn(1500, 3, 2, generator=torch.Generator().manual_seed(2), dtype=D)
    pixels = posed.project(places)[0] + noise
    truth = places.diff(dim=0).norm(dim=-1)
    found = dp.measure(pixels, located, Z, pixel_sigma="detector")
    assert torch.equal(found.degrees_of_freedom, located.degrees_of_freedom)
    assert found.lengths().degrees_of_freedom.median() == pytest.approx(2 * corners - 6, rel=0.01)
    assert 93 < covered(found.lengths().interval(), truth) < 97
    assert 98 < covered(found.lengths().interval(0.99), truth) < 99.6
    # A pixel noise that is given is known; the pose's share stays estimated.
    given = dp.measure(pixels, located, Z, pixel_sigma=0.3).lengths()
    assert (given.degrees_of_freedom > 2 * corners - 6).all()
    assert 92.5 < covered(given.interval(), truth) < 97


def test_a_given_noise_is_known() -> None:
    measured = dp.measure(torch.tensor([[320.0, 260], [400, 300]], dtype=D), FRONTAL, Z, pixel_sigma=SIGMA)
    assert measured.degrees_of_freedom.isinf().all()
    length = measured.lengths()
    torch.testing.assert_close(length.interval()[1] - length.value, 1.959964 * length.deviation, rtol=1e-5, atol=0)


def test_points_without_a_place_have_no_deviation() -> None:
    measured = dp.measure(torch.tensor([[320.0, 100], [320, 300], [330, 310]], dtype=D), LEVEL, FLOOR, pixel_sigma=1.0)
    assert measured.valid.tolist() == [False, True, True]
    assert measured.points[0].tolist() == [0, 0, 0]
    low, high = measured.interval()
    for tensor in (measured.deviations, measured.covariance.flatten(-2), low, high):
        assert tensor.isnan().all(-1).tolist() == [True, False, False]
    length = measured.lengths()
    assert length.value.isnan().tolist() == length.deviation.isnan().tolist() == [True, False]
    assert not length.significant[0]
    assert not length.nonlinear[0]
    assert not measured.nonlinear[0]
    text = measured.summary()
    assert "nan" not in text
    assert "0.000 ± 0.000" not in text.splitlines()[0]
    assert "point 0   not on the plane" in text
    assert "0 to 1    not both points are on the plane" in text


def test_gradients_stay_finite_at_kinks() -> None:
    pixels = torch.tensor([[320.0, 260], [320, 260], [300, 260], [340, 260], [320, 100]], dtype=D, requires_grad=True)
    measured = dp.measure(pixels, TILTED, Z, pixel_sigma=SIGMA)
    kinks = (measured.lengths([[0, 1]]), measured.angles([[2, 0, 3], [0, 1, 2]]), measured.area([0, 2, 3]))
    for found in kinks:
        known = found.deviation.isfinite()
        (gradient,) = torch.autograd.grad(found.value.sum() + found.deviation[known].sum(), pixels, retain_graph=True)
        assert gradient.isfinite().all()


@pytest.mark.slow
def test_many_cameras_give_what_each_gives() -> None:
    both = TILTED.at(torch.stack([FRONTAL.R, TILTED.R]), torch.stack([FRONTAL.t, TILTED.t]))
    pixels = torch.tensor([[320.0, 260], [320.2, 260.3], [500, 120]], dtype=D)
    heights = dp.Plane.per_point([0.0, 0.0, 1.0], torch.tensor([0.0, 0.0, 20.0], dtype=D))
    for plane in (Z, heights):
        together = dp.measure(pixels.expand(2, 3, 2), both, plane, pixel_sigma=SIGMA)
        for i, camera in enumerate((FRONTAL, TILTED)):
            alone = dp.measure(pixels, camera, plane, pixel_sigma=SIGMA)
            for many, one in zip(together.interval(), alone.interval(), strict=True):
                torch.testing.assert_close(many[i], one, rtol=1e-7, atol=1e-7)
            for many, one in zip(together.angles().interval(), alone.angles().interval(), strict=True):
                torch.testing.assert_close(many[i], one, rtol=1e-7, atol=1e-7)


def test_steps_to_zero_are_where_a_curve_ends() -> None:
    """Of curves that cross zero after 0.5 to 11 steps, bent up or down, some of which leave the plane behind that."""

    class Line(Propagated):
        """The error itself is the point; beyond a place there is none."""

        def __init__(self) -> None:
            pass

        ends = torch.tensor([12.5, 12.5, 12.5, 12.5, 1.0, 11.5, 12.5], dtype=D)

        def points(self, errors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return errors, errors.squeeze(-1) <= self.ends

    zeros = torch.tensor([0.5, 4.0, 11.0, 4.0, 0.5, 11.0, 20.0], dtype=D)
    bends = torch.tensor([0.3, 0.3, 0.3, -0.03, 0.3, -0.03, 0.3], dtype=D)

    def curve(points: torch.Tensor) -> torch.Tensor:
        steps = points.squeeze(-1)
        return (zeros - steps) / (1 + bends * steps)

    one = torch.ones(7, dtype=D)
    found = _steps_to_zero(Line(), curve, zeros, one.unsqueeze(-1), one)
    torch.testing.assert_close(found, zeros.clamp(max=folded.FAR), rtol=0, atol=0.05)  # 0.032, of the one at 11


def test_nothing_measured() -> None:
    measured = dp.measure(torch.zeros(0, 2, dtype=D), FRONTAL, Z, pixel_sigma=SIGMA)
    assert measured.interval()[0].shape == (0, 3)
    assert measured.nonlinear.shape == (0,)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_worlds_unit_changes_nothing(unit: float) -> None:
    pixels = torch.tensor([[320.0, 250], [300, 260]], dtype=D)
    usual, other = (
        dp.measure(pixels, LEVEL, dp.Plane([0.0, 1.0, 0.0], scale * 1500.0), pixel_sigma=1.0) for scale in (1.0, unit)
    )
    for first, second in (
        (usual.lengths(), other.lengths()),
        (usual.quantity(lambda p: p[1, 2], [[0, 1]]), other.quantity(lambda p: p[1, 2], [[0, 1]])),
    ):
        assert first.nonlinear.all()
        for bound, there in zip(first.interval(), second.interval(), strict=True):
            torch.testing.assert_close(there / unit, bound, rtol=1e-9, atol=0)


def test_without_a_slope_no_direction_is_better_than_another() -> None:
    """A square at its smallest value: both sides of the interval are those of the mean square of what noise does."""
    measured = dp.measure(torch.tensor([[320.0, 240]], dtype=D), FRONTAL, Z, pixel_sigma=SIGMA)
    square = measured.quantity(lambda p: p[0, 0].square(), [[0]])
    # Along x the point is known to 1 mm, and across it the square stays.
    assert [float(value) for value in (square.value, square.deviation)] == pytest.approx([0, 1])
    assert [float(bound) for bound in square.interval()] == pytest.approx([-1.959964, 1.959964])


def test_degrees_of_freedom_of_what_is_known_in_part() -> None:
    """Welch and Satterthwaite: those of the estimated part over the square of its share of the variance."""
    views, board = dp.example_views("left"), dp.Chessboard()
    located = dp.locate(views[3], board, dp.calibrate(views, board).camera)
    assert located.degrees_of_freedom is not None
    pixels = views.pixels[3, [0, 8]]
    estimated, both = (dp.measure(pixels, located, Z, pixel_sigma=sigma).lengths() for sigma in (0.0, 0.02))
    share = (estimated.deviation / both.deviation).square()
    assert 0.5 < float(share) < 0.95
    assert estimated.degrees_of_freedom is not None
    assert both.degrees_of_freedom is not None
    torch.testing.assert_close(estimated.degrees_of_freedom, located.degrees_of_freedom.reshape(1))
    torch.testing.assert_close(both.degrees_of_freedom, located.degrees_of_freedom / share.square())


@pytest.mark.parametrize(
    "of",
    [
        lambda measured: measured.lengths(),
        lambda measured: measured.angles(),
        lambda measured: measured.area(),
        lambda measured: measured.quantity(lambda p: (p[0] - p[1]).norm() - (p[2] - p[3]).norm(), [[0, 1, 2, 3]]),
    ],
    ids=["lengths", "angles", "area", "quantity"],
)
def test_of_no_cameras(of):
    """A batch may be empty, as the detections of a photograph may be."""
    found = of(dp.measure(torch.zeros(0, 4, 2, dtype=D), FRONTAL, Z, pixel_sigma=SIGMA))
    for part in (found.value, found.deviation, *found.interval(0.95)):
        assert part.shape[0] == 0
        assert part.ndim == 2
