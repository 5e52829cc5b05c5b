"""A lens that folds, or has a pole, inside its own corners is no calibration; and inside the image it is kept from it."""

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic
from diffproj.calibration import outcome
from diffproj.calibration.fitting.fit import Fit, fit
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.results.border import border_with_rays
from diffproj.calibration.trust.reach import reach_of
from diffproj.lens.brown_domain import domain_reaches, surely_encloses

D = torch.float64
BOARD = dp.Chessboard()
SIZE = (640, 480)
K = torch.tensor([[600.0, 0, 330], [0, 600, 230], [0, 0, 1]], dtype=D)


def lens_of(*coefficients: float) -> dp.BrownConrady:
    return dp.BrownConrady(torch.tensor(coefficients, dtype=D))


TRUTH = dp.Camera(K, distortion=lens_of(-0.25, 0.09, 0.0, 0.0, -0.01), size=SIZE)


def seen(camera: dp.Camera, seed: int, noise: float = 0.2) -> dp.Views:
    return synthetic.corner_views(synthetic.random_cameras(camera, BOARD, 13, seed=seed), BOARD, noise_px=noise)


def together(views: list[dp.Views]) -> dp.Views:
    return dp.Views(torch.stack([v.pixels for v in views]), torch.stack([v.visible for v in views]), size=SIZE)


def border() -> Tensor:
    edge = torch.cartesian_prod(torch.linspace(0, 639, 33, dtype=D), torch.linspace(0, 479, 25, dtype=D))
    return edge[((edge[:, 0] % 639) == 0) | ((edge[:, 1] % 479) == 0)]


def test_eight_coefficients_reach_their_corners_and_the_image() -> None:
    """Without restraint 11 of 24 such lenses fold inside their own corners; here 325 of 702 would be lost."""
    views = seen(TRUTH, 8)
    five, eight = dp.calibrate(views, BOARD), dp.calibrate(views, BOARD, "brown8")
    projected, valid = eight.cameras.project(BOARD.points)
    assert bool(valid.all())
    assert bool(eight.camera.directions(border())[1].all())
    assert five.rms * 0.99 < eight.rms <= five.rms
    assert eight.rms == pytest.approx(float((projected - views.pixels).square().sum(-1).mean().sqrt()))
    assert "k4, k5 and k6 are held near" in eight.message
    assert "held near" not in five.message


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"loss": dp.Huber(0.5)}, marks=pytest.mark.slow),
        {"reject_outliers": True},
        pytest.param({"objective": "plane"}, marks=pytest.mark.slow),
    ],
)
def test_a_richer_lens_never_ends_above_a_poorer_one(options: dict) -> None:
    views = together([seen(TRUTH, seed) for seed in (2, 8)])
    five = dp.calibrate(views, BOARD, "brown5", **options)
    eight = dp.calibrate(views, BOARD, "brown8", **options)
    assert bool(eight.cameras.project(BOARD.points)[1].all())
    if not options:
        assert bool((eight.rms <= five.rms).all())
    assert (eight.rms / five.rms).max() < 1.002
    deviations = eight.covariance.deviations
    assert all(bool((d.isfinite() & (d > 0)).all()) for d in deviations.values())
    off = (eight.camera.K[:, 0, 0] - 600) / deviations["f_x"]  # over 24 sets: 1.03 root mean square
    assert off.abs().max() < 3


def test_what_restrains_counts_alike_in_both_covariances() -> None:
    views = seen(TRUTH, 8)
    plain = dp.calibrate(views, BOARD, "brown8").covariance.deviations
    weighted = dp.calibrate(views, BOARD, "brown8", weights=torch.ones((), dtype=D)).covariance.deviations
    for name, deviation in plain.items():
        assert float(weighted[name] / deviation) == pytest.approx(1, abs=0.25)  # the sandwich, from 1404 residuals


def test_terms_that_are_held_are_left_alone() -> None:
    found = dp.calibrate(seen(TRUTH, 8), BOARD, "brown8", fixed=("k4", "k5", "k6"))
    assert found.camera.distortion.coefficients[5:].tolist() == [0.0, 0.0, 0.0]  # type: ignore[union-attr]
    assert "drawn" not in found.message


def test_a_lens_that_folds_inside_its_corners_has_not_converged() -> None:
    """A lens of 170 degrees is no polynomial of the tangent."""
    wide = dp.KannalaBrandt(torch.tensor([0.02, -0.01, 0.003, -0.001], dtype=D))
    camera = dp.Camera(K.new_tensor([[200.0, 0, 330], [0, 200, 230], [0, 0, 1]]), distortion=wide, size=SIZE)
    poses = synthetic.random_cameras(camera, BOARD, 40, seed=3, distance=(0.6, 1.5))
    faces = (poses.R[..., 2] * (poses.R @ BOARD.points.mean(0) + poses.t)).sum(-1) > 0
    views = synthetic.corner_views(poses[faces][:13], BOARD)
    found = dp.calibrate(views, BOARD, "brown5", throw=False)
    lost = found.used & ~found.cameras.project(BOARD.points)[1]
    assert bool(lost.any())
    assert not bool(found.converged)
    assert f"{int(lost.sum())} corners lie beyond the fold of the lens" in found.message
    assert "fit distortion='fisheye'" in found.message
    assert torch.equal(found.view_rms.isinf(), lost.any(-1))
    assert bool(found.rms.isinf())
    assert dp.calibrate(views, BOARD, "fisheye").rms < 0.3


def test_refine_and_locate_say_it_too() -> None:
    views = seen(TRUTH, 8)
    beyond = dp.Camera(K, distortion=lens_of(-0.9, 0.0, 0.0, 0.0, 0.0), size=SIZE)  # it folds at 0.61
    with pytest.raises(dp.CalibrationError, match=r"locate: .* beyond the fold of the lens: hide"):
        dp.locate(views, BOARD, beyond)
    rational = (-35.135, 306.48, -0.0004, 0.0, 38.38, -34.887, 297.69, 115.99)  # the lowest minimum, with a pole
    posed = dp.calibrate(views, BOARD).cameras
    start = dp.Camera(K, distortion=lens_of(*rational), size=SIZE)[None].expand(len(views)).at(posed.R, posed.t)
    with pytest.raises(dp.CalibrationError, match=r"refine: .* beyond the fold of the lens: fit .*'brown5'") as raised:
        dp.refine(views, BOARD, start)
    assert bool(raised.value.calibration.rms.isinf())  # type: ignore[union-attr]


def test_the_summary_tells_what_of_the_image_is_out_of_reach() -> None:
    found = dp.calibrate(dp.example_views("left"), BOARD, "fisheye")
    lost = 100 * float((~found.camera.directions(border())[1]).double().mean())
    (line,) = [line for line in found.summary().splitlines() if line.startswith("image ")]
    assert abs(int(line.split()[1]) - lost) < 5
    for side in ("left", "right"):
        assert "fold" not in dp.calibrate(dp.example_views(side), BOARD).summary()


@pytest.mark.slow
def test_cross_validation_counts_what_a_lens_loses() -> None:
    outcome = dp.cross_validate(dp.example_views("right"), BOARD, "brown12")
    assert outcome.held_out_px.max() < 0.3
    assert not bool(outcome.lost.any())


@pytest.mark.slow
def test_a_fold_whose_lens_loses_corners_is_infinitely_bad() -> None:
    """The middle of the image tells five coefficients nothing about its corners."""
    strong = dp.Camera(K, distortion=lens_of(-0.3, 0.12, 0.0, 0.0, -0.02), size=SIZE)
    poses = synthetic.random_cameras(strong, BOARD, 400, seed=1, distance=(2.0, 5.0))
    pixels = poses.project(BOARD.points)[0]
    far = (pixels - K[:2, 2]).norm(dim=-1).amax(-1)
    order = far.argsort()
    chosen = torch.cat([order[:6], order[-1:]])
    outcome = dp.cross_validate(synthetic.corner_views(poses[chosen], BOARD, noise_px=0.3), BOARD, folds=7)
    assert int((outcome.lost > 0).sum()) == 1
    assert torch.equal(outcome.held_out_px.isinf(), outcome.lost > 0)
    assert f"{int(outcome.lost.sum())} held-out corners lie beyond the fold" in outcome.summary()


def lenses(count: int, number: int) -> torch.Tensor:
    draw = torch.Generator().manual_seed(count)
    size = torch.tensor([0.5, 0.5, 0.02, 0.02, 0.5, 0.5, 0.5, 0.5, 0.02, 0.02, 0.02, 0.02, 0.1, 0.1][:count], dtype=D)
    return torch.randn(number, count, generator=draw, dtype=D) * size


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_whether_a_domain_reaches_so_far_is_what_the_domain_says(count: int) -> None:
    number = 3000 if count <= 8 else 200
    coefficients = lenses(count, number)
    domain = dp.BrownConrady(coefficients).domain
    draw = torch.Generator().manual_seed(0)
    factor = torch.cat([2 * torch.rand(number - 80, generator=draw, dtype=D), 1 + 1e-12 * (torch.arange(80) - 39.5)])
    radius = torch.where(domain.isfinite(), domain, 1.0) * factor
    assert torch.equal(domain_reaches(coefficients, radius), radius <= domain)
    assert not bool(domain_reaches(coefficients[:2], torch.tensor([torch.nan, torch.nan], dtype=D)).any())


@pytest.mark.parametrize("count", [5, 8, 12, 14])
def test_what_surely_encloses_does(count: int) -> None:
    coefficients = lenses(count, 300)
    domain = dp.BrownConrady(coefficients).domain
    radius = domain.clamp(max=1.5) * (1 - 1e-9)
    angle = 2 * torch.pi * torch.arange(3600, dtype=D) / 3600
    circle = torch.stack([angle.cos(), angle.sin()], dim=-1)
    least = dp.BrownConrady(coefficients).distort(radius[:, None, None] * circle)[0].norm(dim=-1).amin(-1)
    some = radius > 0
    assert int(some.sum()) > 200
    assert not bool(surely_encloses(coefficients, radius, least * 1.0001)[some].any())
    assert int(surely_encloses(coefficients, radius, least * 0.9)[some].sum()) > 0.9 * int(some.sum())


@pytest.mark.parametrize("model", ["brown5", "brown8", "brown12", "brown14"])
def test_how_far_a_lens_reaches_is_what_its_domain_and_its_rays_say(model: str) -> None:
    count = int(model[5:])
    draw = torch.Generator().manual_seed(1)
    P = 40
    size = torch.tensor([0.3, 0.3, 0.01, 0.01, 0.3, 0.3, 0.3, 0.3, 0.02, 0.02, 0.02, 0.02, 0.05, 0.05][:count], dtype=D)
    own = torch.randn(P, count, generator=draw, dtype=D) * size
    shared = torch.cat([K.new_tensor([400.0, 410, 330, 235]).expand(P, 4), own], dim=-1)
    near = dp.calibrate(dp.example_views("left")[:3], BOARD).cameras
    poses = near.R.expand(P, 3, 3, 3), near.t.expand(P, 3, 3)
    used = torch.ones(P, 3, len(BOARD.points), dtype=torch.bool)
    task = Task(BOARD.points, torch.zeros(P, 3, len(BOARD.points), 2, dtype=D), used, model)  # type: ignore[arg-type]
    found = fit(task, shared, poses, max_iterations=0)
    found = Fit(task, found.solution._replace(status=torch.zeros(P, dtype=torch.int64)), found.rejected)
    lenses = dp.BrownConrady(shared[:, 4:])
    matrix = torch.tensor([[400.0, 0, 330], [0, 410, 235], [0, 0, 1]], dtype=D).expand(P, 3, 3)
    whole = border_with_rays(dp.Camera(matrix, distortion=lenses, size=SIZE), SIZE)
    X = BOARD.points @ near.R.mT + near.t.unsqueeze(-2)
    outermost = (X[..., :2] / X[..., 2:]).norm(dim=-1).max()
    expected = torch.where(outermost <= lenses.domain, whole, -1.0)
    assert torch.equal(reach_of(found, SIZE), expected)
    assert len({float(part) for part in expected}) > 2


def test_what_only_restrains_is_no_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one, with an error of 1 px, it made the deviations of k1 to k6 three times as large.

    Of 22 such cameras the errors of k1, k2 and k3 were 0.31, 0.17 and 0.46 of those (RMS); they are 0.66, 0.38 and 0.66
    of these, and that of f_x 0.97.
    """
    fits: list[Fit] = []
    covariance_of = outcome.covariance_of

    def noted(found: Fit, *args: object) -> object:
        fits.append(found)
        return covariance_of(found, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(outcome, "covariance_of", noted)
    found = dp.calibrate(seen(TRUTH, 8), BOARD, "brown8")
    spread, dispersion = found.covariance.shared, found.covariance.dispersion
    (restrained,) = fits
    # To rounding: the condition of the matrix is 1e10.
    torch.testing.assert_close(spread, restrained.plain_covariance.shared[0] * dispersion, rtol=1e-5, atol=0)
