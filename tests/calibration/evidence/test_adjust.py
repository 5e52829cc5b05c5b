"""`adjust`: figures of the field, error bars against sampling, what evidence does not tell, gradients, batches."""

import copy
import json
import pickle
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

import diffproj as dp
from diffproj.calibration.evidence.pose_parameters import PoseParameters
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import Parametrisation

D = torch.float64
GROUND = dp.Plane.z(0.0)


def made(**changes: Any) -> dp.Camera:
    given = {"height": 6.0, "tilt_deg": 20.0, "roll_deg": 2.0, "heading_deg": 30.0, "position": [3.0, -2.0]}
    return dp.Camera.mounted(**(given | {"focal": 900.0, "size": (1280, 720)} | changes))  # type: ignore[arg-type]


TRUE = made()
START = made(height=7.0, tilt_deg=25.0, roll_deg=0.0, heading_deg=20.0, position=[0.0, 0.0])
LANDMARKS = torch.tensor([[10.0, 30, 1], [25, 28, 3], [4, 12, 0], [9, 11, 0.5], [14, 16, 0], [2, 18, 2]], dtype=D)


def seen(camera: dp.Camera = TRUE, points: torch.Tensor = LANDMARKS) -> torch.Tensor:
    pixels, valid = camera.project(points)
    assert bool(valid.all())
    return pixels


def within(estimate: torch.Tensor, truth: torch.Tensor, deviation: torch.Tensor) -> float:
    """The part of estimates that lie within 1.96 deviations."""
    off = (estimate - truth + 180) % 360 - 180
    return float((off.abs() <= 1.96 * deviation).to(D).mean())


# ------------------------------------------------------------------------------------------ figures of the field


def test_colony_of_penguins() -> None:
    """50 penguins of 0.75 m, two clicks on the horizon, two landmarks: figures of an independent fit of the same."""
    given = json.loads((Path(__file__).parent / "penguins.json").read_text())
    pieces = [
        dp.Heights(given["feet"], given["tops"], 0.75, 0.03),
        dp.Horizon(given["horizon"], 10.0),
        dp.Seen(given["landmarks"], given["seen"], pixel_sigma=1e-3, sigma=[3.0, 3.0, 5.0]),
    ]
    start = dp.Camera.mounted(16.0, 10.0, focal=3863.64, size=(4608, 2592), principal_point=[2304.0, 1296.0])
    found = dp.adjust(start, pieces, fixed=("position",))
    value, spread = found.mounting, found.mounting_deviations
    expected = {"height": (20.47, 0.19), "tilt": (90 - 83.48, 0.10), "roll": (-1.01, 0.22), "heading": (101.72, 0.23)}
    for name, (truth, deviation) in expected.items():
        assert float(getattr(value, name)) == pytest.approx(truth, abs=0.02), name
        assert float(getattr(spread, name)) == pytest.approx(deviation, rel=0.05), name
    assert "Heights (2.0 times)" in found.doubts  # penguins are less alike than 3 cm
    lines = found.summary().splitlines()
    assert [line.split() for line in lines if line[0] in "xy"] == [
        ["x", "0.0000", "(fixed)"],
        ["y", "0.0000", "(fixed)"],
    ]


VANISHING = [[1136.941176, 209.411765], [-1842.891566, 174.939760]]
"""Of a traffic camera, along the road and across; its scale makes the camera's height 0.09158."""


def test_vanishing_points_of_a_traffic_camera() -> None:
    start = dp.Camera.mounted(0.09158282892, 10.0, focal=1500.0, size=(1280, 720), principal_point=[640.0, 360.0])
    points = dp.VanishingPoints(["y", "x"], pixels=VANISHING, pixel_sigma=2.0)
    found = dp.adjust(start, points, free=("focal",), fixed=("height", "position"))
    assert float(found.camera.K[0, 0]) == pytest.approx(1098.1726, abs=5e-5)
    assert float(found.camera.K[1, 1]) == pytest.approx(1098.1726, abs=5e-5)
    road = dp.measure([[500.0, 500.0], [700.0, 500.0]], found, GROUND, pixel_sigma=0.5)
    assert float(road.lengths().value) == pytest.approx(0.06230170583, abs=1e-9)
    assert road.includes_intrinsics
    # The heading that is nearer to the camera's own, of the two that a vanishing point leaves open.
    assert float((found.mounting.heading - 180).abs()) > 90


@pytest.mark.filterwarnings("ignore:measure. pixel")  # 5 m aside is beyond the picture
def test_mounted_camera_alone_has_a_covariance() -> None:
    """No observations: height to 2 cm, tilt to half a degree, pixels to 1 px; against 200000 samples, within 5 %."""
    mast = dp.Camera.mounted(2.18, 14.0, focal=800.0, size=(640, 480))
    known = dp.adjust(mast, priors={"height": 0.02, "tilt": 0.5}, fixed=("roll", "heading", "position"))
    random = torch.Generator().manual_seed(0)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=D, generator=random)

    many = dp.Camera.mounted(2.18 + 0.02 * noise(20000), 14 + 0.5 * noise(20000), focal=800.0, size=(640, 480))
    for point in ([0.0, 10, 0], [5.0, 10, 0]):
        pixels = seen(mast, torch.tensor([point], dtype=D))
        measured = dp.measure(pixels, known, GROUND, pixel_sigma=1.0)
        sampled = dp.back_project(pixels + noise(20000, 1, 2), many, GROUND)[0].std(0)
        torch.testing.assert_close(measured.deviations[:, :2], sampled[:, :2], rtol=0.05, atol=0)
    # 10 m ahead and 5 m aside, as others have sampled it.
    torch.testing.assert_close(measured.deviations[0, :2], torch.tensor([0.206, 0.442], dtype=D), rtol=0.05, atol=0)
    assert "tilt                 14.0000 ± 0.5000 degrees" in known.summary()


def test_a_mounted_camera_is_a_calibration(tmp_path: Path) -> None:
    """It is saved and loaded with its covariance, copied, mapped, and taken as a prior."""
    mast = dp.Camera.mounted(2.18, 14.0, focal=800.0, size=(640, 480))
    known = dp.adjust(mast, priors={"height": 0.02, "tilt": 0.5}, fixed=("roll", "heading", "position"))
    pixels = [[320.0, 300.0], [400.0, 320.0]]
    measured = dp.measure(pixels, known, GROUND, pixel_sigma=1.0)
    dp.save_camera(tmp_path / "mast.json", known)
    for same in (dp.load_calibration(tmp_path / "mast.json"), copy.deepcopy(known), pickle.loads(pickle.dumps(known))):  # noqa: S301
        again = dp.measure(pixels, same, GROUND, pixel_sigma=1.0)
        torch.testing.assert_close(again.joint(), measured.joint())
    assert float(dp.CalibrationPrior(known, view=0)(known.cameras[0])) == pytest.approx(0, abs=1e-12)
    assert dp.AccuracyMap.over_image(known, step=100, pixel_sigma=1.0).deviation.shape == (6, 8)
    with pytest.raises(ValueError, match="pixel_sigma: want the noise of the pixels"):
        dp.measure(pixels, known, GROUND)


# ------------------------------------------------------------------------------------------------ error bars


def evidence(count: int) -> dict[str, list[Any]]:
    """Pieces of evidence of many noisy copies of one scene, by name, for cameras of batch shape `(count,)`."""
    random = torch.Generator().manual_seed(1)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, dtype=D, generator=random)

    many = TRUE.expand(count)
    spots = torch.rand(8, 2, dtype=D, generator=random) * torch.tensor([1200.0, 400], dtype=D)
    feet = dp.back_project(spots + torch.tensor([40.0, 300], dtype=D), TRUE, GROUND)[0]
    tops = feet + torch.nn.functional.pad((1.7 + 0.1 * noise(8)).unsqueeze(-1), (2, 0))
    heights = dp.Heights(
        seen(TRUE, feet) + 0.5 * noise(8, 2), many.project(tops)[0] + 0.5 * noise(8, 2), 1.7, 0.1, pixel_sigma=0.5
    )
    far = TRUE.center + 1e9 * torch.tensor([[0.2, 1, 0], [0.9, 1, 0]], dtype=D)
    horizon = dp.Horizon(seen(TRUE, far) + 2 * noise(2, 2), 2.0)
    two = dp.Seen(LANDMARKS[:2], seen()[:2] + noise(2, 2))
    moved = LANDMARKS + 0.05 * noise(6, 3)
    unsure = dp.Seen(LANDMARKS, many.project(moved)[0] + noise(6, 2), sigma=0.05)
    robust = dp.Seen(LANDMARKS, many.project(moved)[0] + noise(6, 2), sigma=0.05, loss=dp.Huber(1.5))
    posts = torch.tensor([[2.0, 9, 0], [8, 9, 0], [2, 14, 0], [8, 14, 0]], dtype=D)
    ends = seen(TRUE, posts).reshape(2, 2, 2)
    lengths = dp.Lengths(
        ends[:, 0] + 0.5 * noise(2, 2), ends[:, 1] + 0.5 * noise(2, 2), 6 + 0.05 * noise(2), 0.05, pixel_sigma=0.5
    )
    rows = torch.tensor([[[-4.0, 9, 0], [16, 40, 0]], [[0, 8, 0], [20, 39, 0]]], dtype=D)
    lines = dp.VanishingPoints(
        [[20.0, 31, 0]] * 2,
        segments=seen(TRUE, rows.reshape(-1, 3)).reshape(2, 2, 2) + 0.5 * noise(2, 2, 2),
        pixel_sigma=0.5,
    )
    return {
        "heights, horizon, two landmarks": [heights, horizon, two],
        "landmarks that are off": [unsure],
        "robust": [robust],
        "lines, lengths, two landmarks": [lines, lengths, two],
    }


@pytest.mark.slow
@pytest.mark.parametrize("which", list(evidence(1)))
def test_intervals_hold_the_truth(which: str) -> None:
    """95 % intervals of 600 noisy scenes hold the truth in 93 to 97 % of them, each angle, place and height."""
    found = dp.adjust(START, evidence(600)[which])
    assert bool(found.converged.all())
    truth, spread = TRUE.mounting(), found.mounting_deviations
    parts = [within(*each) for each in zip(found.mounting, truth, spread, strict=True)]
    assert 0.93 <= sum(parts) / len(parts) <= 0.97
    assert all(0.92 <= part <= 0.98 for part in parts), parts
    assert float(found.consistency.mean()) == pytest.approx(1, abs=0.1)


def test_landmarks_are_seen_with_their_own_sigma() -> None:
    """The same as their points with that sigma, which one that is given replaces; names and the order do not matter."""
    spread = torch.linspace(0.02, 0.3, 18, dtype=D).reshape(6, 3)
    pixels = seen() + torch.linspace(-1.5, 1.5, 12, dtype=D).reshape(6, 2)
    named = dp.Landmarks(LANDMARKS, names=["mast", "gate", "kerb", "post", "drain", "roof"], sigma=spread)
    one, other = (
        dp.adjust(START, dp.Seen(points, pixels, pixel_sigma=1.2, **given))  # type: ignore[arg-type]
        for points, given in ((named, {}), (LANDMARKS, {"sigma": spread}))
    )
    assert torch.allclose(one.cameras.t, other.cameras.t, atol=1e-12)
    assert torch.allclose(one.mounting_covariance, other.mounting_covariance, rtol=1e-9, atol=0)
    exact = dp.adjust(START, dp.Seen(named, pixels, pixel_sigma=1.2, sigma=0.0))
    assert bool((exact.mounting_deviations.height < one.mounting_deviations.height).all())
    # A covariance that is not along the axes: the world turned by 40 degrees about z, the landmarks and it along.
    turn = (
        dp.Camera.mounted(1.0, 90.0, heading_deg=40.0, focal=1.0, size=(2, 2)).R * torch.tensor([1.0, -1, -1])[:, None]
    )
    around = dp.Landmarks(LANDMARKS @ turn.mT, sigma=turn @ torch.diag_embed(spread.square()) @ turn.mT)
    turned = dp.adjust(START, dp.Seen(around, pixels, pixel_sigma=1.2))
    assert float(turned.mounting.height) == pytest.approx(float(one.mounting.height), abs=1e-7)
    assert float(turned.mounting_deviations.height) == pytest.approx(float(one.mounting_deviations.height), rel=1e-6)
    # The last residuals are the landmarks' and agree with `locate`, which carries their sigma too.
    views = dp.Views(pixels.unsqueeze(0), size=TRUE.size)
    located = dp.locate(views, named, START, pixel_sigma=1.2)
    assert torch.allclose(located.cameras.center[0], one.cameras.center[0], atol=0.05)


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_landmarks_are_evidence(count: int) -> None:
    """With the horizon and the height: two tell the rest, one the heading, where the camera's place is known."""
    known = dp.Landmarks(LANDMARKS[:count], names=["mast", "gate"][:count], sigma=0.05)
    pieces = [dp.Seen(known, seen(points=LANDMARKS[:count]), pixel_sigma=0.5), dp.Horizon(_horizon(), 1.0)]
    place = {"position": 0.02} if count == 1 else {}
    start = made(tilt_deg=25.0, roll_deg=0.0, heading_deg=20.0, height=6.1)
    found = dp.adjust(start, pieces, priors={"height": 0.5, **place})
    assert float(found.mounting.heading) == pytest.approx(30.0, abs=0.05)
    assert float(found.mounting.height) == pytest.approx(6.0, abs=0.05)
    assert bool(found.mounting_covariance.isfinite().all())


def _horizon() -> torch.Tensor:
    """Two pixels on the horizon of `TRUE`, at its left and at its right."""
    ahead = torch.tensor([20.0, 40.0], dtype=D).deg2rad()
    far = 1e7 * torch.stack([ahead.sin(), ahead.cos(), torch.zeros(2, dtype=D)], dim=-1)
    pixels, _ = TRUE.project(far + torch.tensor([0.0, 0, 6], dtype=D))
    return pixels


def test_priors_weigh_as_measurements() -> None:
    """About scattered means, with landmarks and a focal length that is known to 20 px: the truth in 93 to 97 %."""
    random = torch.Generator().manual_seed(2)
    S = 600
    off = {name: torch.randn(S, dtype=D, generator=random) for name in ("tilt", "heading", "height", "focal")}
    priors = {
        "tilt": (20 + 0.5 * off["tilt"], 0.5),
        "heading": (30 + 3 * off["heading"], 3.0),
        "height": (6 + 0.1 * off["height"], 0.1),
        "focal": (900 + 20 * off["focal"], 20.0),
    }
    pixels = seen() + torch.randn(S, 6, 2, dtype=D, generator=random)
    found = dp.adjust(made(focal=1000.0), dp.Seen(LANDMARKS, pixels), priors=priors)
    parts = [within(*each) for each in zip(found.mounting, TRUE.mounting(), found.mounting_deviations, strict=True)]
    focal = found.covariance.deviations["f_x"]
    assert 0.92 <= within(found.camera.K[:, 0, 0], torch.tensor(900.0, dtype=D), focal) <= 0.98
    assert all(0.92 <= part <= 0.98 for part in parts), parts
    point = dp.back_project([[500.0, 500.0]], TRUE, GROUND)[0]
    measured = dp.measure(
        seen(TRUE, point) + torch.randn(S, 1, 2, dtype=D, generator=random), found, GROUND, pixel_sigma=1.0
    )
    low, high = measured.interval()
    assert 0.93 <= float(((low <= point) & (point <= high))[..., :2].to(D).mean()) <= 0.97


def test_intrinsics_of_a_calibration_go_along() -> None:
    """What a calibration leaves open of the focal length comes back in the pose and what is measured from it."""
    board = dp.Chessboard(6, 5, 0.2)
    plain = TRUE.without_pose()
    views = dp.synthetic.corner_views(dp.synthetic.random_cameras(plain, board, 6), board, noise_px=0.5)
    calibration = dp.calibrate(views, board, "none")
    camera = START.at(START.R, START.t)
    exact = dp.adjust(camera.at(START.R, START.t), dp.Seen(LANDMARKS, seen(), 0.01))
    both = dp.adjust(calibration, dp.Seen(LANDMARKS, seen(), 0.01))
    assert bool((both.mounting_deviations.position > 3 * exact.mounting_deviations.position).any())
    torch.testing.assert_close(both.covariance.shared, calibration.covariance_of_kept_poses.shared)
    assert both.knows_intrinsics
    assert not exact.knows_intrinsics


SHORE = torch.tensor([[2.0, 20], [10, 26], [18, 22], [25, 35], [6, 14]], dtype=D)
WATERLINE = torch.cat([SHORE, torch.full((5, 1), -1.3, dtype=D)], dim=-1)


def test_the_level_of_a_waterline_is_found_along() -> None:
    exact = dp.adjust(START, [dp.Coplanar(SHORE, seen(TRUE, WATERLINE)), dp.Seen(LANDMARKS[:1], seen()[:1])])
    torch.testing.assert_close(exact.cameras.R[0], TRUE.R, atol=1e-7, rtol=0)


@pytest.mark.slow
def test_a_waterline_of_unknown_level_tells() -> None:
    """Error bars hold with its level found along."""
    random = torch.Generator().manual_seed(4)
    noisy = (
        pixels + torch.randn(600, *pixels.shape, dtype=D, generator=random)
        for pixels in (seen(TRUE, WATERLINE), seen()[:2])
    )
    found = dp.adjust(START, [dp.Coplanar(SHORE, next(noisy)), dp.Seen(LANDMARKS[:2], next(noisy))])
    parts = [within(*each) for each in zip(found.mounting, TRUE.mounting(), found.mounting_deviations, strict=True)]
    assert all(0.92 <= part <= 0.98 for part in parts), parts


def test_a_robust_minimum_is_one_to_rounding() -> None:
    """Where reweighting creeps: the gradient of the loss, written down, moves nothing by a part of its deviation."""
    generator = torch.Generator().manual_seed(3)
    pixels = seen() + 2.0 * torch.randn(6, 2, dtype=D, generator=generator)
    found = dp.adjust(START, dp.Seen(LANDMARKS, pixels, loss=dp.Cauchy(0.5)))
    assert bool(found.converged)
    values = torch.cat([part.reshape(-1) for part in found.mounting]).requires_grad_()

    def cost(values: torch.Tensor) -> torch.Tensor:
        camera = dp.Camera.mounted(*values[:4], position=values[4:], focal=900.0, size=(1280, 720))
        squared = (camera.project(LANDMARKS)[0] - pixels).square().sum(-1)
        return 0.25 * (squared / 0.25).log1p().sum() / 2

    gradient = torch.autograd.functional.jacobian(cost, values)
    step = torch.linalg.solve(torch.autograd.functional.hessian(cost, values), gradient)
    assert float((step.abs() / torch.cat([d.reshape(-1) for d in found.mounting_deviations])).max()) < 1e-7


# --------------------------------------------------------------------------------- what evidence does not tell


@pytest.mark.parametrize(
    ("pieces", "options", "text"),
    [
        (
            "heights",
            {},
            "heading and position: no evidence; fix them or give a prior, as fixed=.'heading', 'position'.",
        ),
        ("horizon", {}, "heading, position and height: no evidence"),
        ("horizon", {"fixed": ("heading", "position")}, "height: no evidence; fix it or give a prior"),
        ("none", {"priors": {"tilt": 1.0}, "fixed": ("position", "height")}, "roll and heading: no evidence"),
        ("one", {"free": ("focal",)}, "the evidence does not tell them apart; fix some of them"),
        (
            "horizon",
            {"fixed": ("heading", "position"), "priors": {"height": 1000.0}},
            "height: no evidence, for the prior on height is too wide; fix it or give a narrower prior, as fixed=",
        ),
        (
            "horizon",
            {"fixed": ("heading", "position", "height"), "priors": {"f_x": 1e5}},
            "focal: no evidence, for the prior on focal is too wide; .* priors=.'focal'",
        ),
        (
            "horizon",
            {"fixed": ("heading", "height"), "priors": {"x": 1.0}},
            "position: no evidence; fix it or give a p",
        ),
        ("vanishing", {"free": ("focal",), "fixed": ("position",)}, "height: no evidence"),
    ],
)
def test_what_is_lacking_is_named(pieces: str, options: dict[str, Any], text: str) -> None:
    feet = torch.tensor([[400.0, 500.0], [700, 400], [900, 650]], dtype=D)
    ground = dp.back_project(feet, TRUE, GROUND)[0]
    tops = seen(TRUE, ground + torch.tensor([0, 0, 1.7], dtype=D))
    horizon = dp.Horizon(seen(TRUE, TRUE.center + 1e9 * torch.tensor([[0.2, 1, 0], [0.9, 1, 0]], dtype=D)))
    given = {
        "heights": [dp.Heights(feet, tops, 1.7, 0.1), horizon],
        "horizon": [horizon],
        "none": [],
        "one": [dp.Seen(LANDMARKS[:3], seen()[:3])],
        "vanishing": [dp.VanishingPoints(["y", "x"], pixels=VANISHING)],
    }[pieces]
    with pytest.raises(dp.CalibrationError, match=text) as caught:
        dp.adjust(START, given, **options)
    lost = caught.value.calibration
    assert lost is not None
    assert int(lost.status) == Status.DEGENERATE
    assert bool(lost.covariance.undetermined_views.all() | lost.covariance.undetermined.any())


def test_a_camera_that_may_look_straight_down_says_how_it_is_told() -> None:
    """It leans beyond the vertical by 0.2 degrees: tilt folds back, and heading and roll are half a turn further."""
    leaning = made(tilt_deg=89.8, roll_deg=180.0, heading_deg=210.0, height=60.0)
    points = torch.tensor([[20.0, 10, 0], [-15, 12, 1], [10, -18, 2], [-12, -14, 0], [1, 2, 0.5]], dtype=D)
    down = made(tilt_deg=90.0, roll_deg=0.0, heading_deg=30.0, height=60.0)
    found = dp.adjust(down, dp.Seen(points, seen(leaning, points)), fixed=("heading",))
    assert float(found.mounting.tilt) == pytest.approx(89.8, abs=1e-6)
    assert float(found.mounting.heading) == pytest.approx(210.0, abs=1e-6)
    assert "half a turn further" in found.summary()


def test_fewer_residuals_than_unknowns_end_soon() -> None:
    with pytest.raises(dp.CalibrationError, match="the evidence does not tell them apart") as caught:
        dp.adjust(START, dp.Seen(LANDMARKS[:2], seen()[:2]))
    assert int(caught.value.calibration.iterations) <= 30  # type: ignore[union-attr]


def test_contradictions_are_named() -> None:
    wrong = seen() + torch.tensor([8.0, -5.0], dtype=D) * torch.tensor([1.0, -1, 1, -1, 1, -1], dtype=D).unsqueeze(-1)
    found = dp.adjust(START, [dp.Seen(LANDMARKS, wrong, 0.5), dp.Horizon([[327.13, 20.82], [854.16, 39.22]], 3.0)])
    assert "most of all Seen" in found.doubts
    assert found.doubts in found.message
    assert dp.measure([[500.0, 500.0]], found, GROUND, pixel_sigma=1.0).doubts == found.doubts
    assert float(found.consistency) > 3


# --------------------------------------------------------------------------- own observations, gradients, batches


class Above:
    """A post at x, y whose pixel column is known: an observation of a user's own."""

    def __init__(self, place: torch.Tensor, column: torch.Tensor, sigma: float) -> None:
        self.place, self.column, self.sigma = place, column, sigma

    def residuals(self, camera: dp.Camera) -> torch.Tensor:
        pixels, valid = camera.project(self.place)
        return torch.where(valid, (pixels[..., 0] - self.column) / self.sigma, torch.nan).unsqueeze(-1)


def test_an_observation_of_a_users_own_joins() -> None:
    own = Above(LANDMARKS, seen()[:, 0], 1.0)
    assert isinstance(own, dp.Observation)
    horizon = dp.Horizon(seen(TRUE, TRUE.center + 1e9 * torch.tensor([[0.2, 1, 0], [0.9, 1, 0]], dtype=D)))
    found = dp.adjust(START, [own, horizon], priors={"height": (6.0, 0.001)})
    torch.testing.assert_close(found.cameras.R[0], TRUE.R, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.mounting.position, TRUE.mounting().position, atol=1e-4, rtol=0)


@pytest.mark.plain
def test_residuals_of_a_users_own_of_another_shape_are_refused() -> None:
    class Flat:
        def residuals(self, camera: dp.Camera) -> torch.Tensor:
            return camera.K[..., 0, 0]

    with pytest.raises(ValueError, match=r"Flat.residuals: want a tensor \(\*B, M, k\) of numbers"):
        dp.adjust(START, Flat())


def test_gradients_go_through_the_minimum() -> None:
    """Against finite differences: by pixels, points, heights, a prior's mean and the camera's focal length."""
    base = torch.tensor([[0.3, -0.4], [0.5, 0.2], [-0.6, 0.1], [0.2, 0.3], [-0.1, -0.5], [0.4, 0.4]], dtype=D)

    def outcome(x: torch.Tensor) -> torch.Tensor:
        pixels = seen() + base + torch.nn.functional.pad(x[:2].reshape(1, 2), (0, 0, 1, 4))
        points = LANDMARKS + torch.nn.functional.pad(x[2:5].reshape(1, 3), (0, 0, 2, 3))
        camera = made(focal=900 + x[5], tilt_deg=22.0)
        priors = {"tilt": (19.5 + x[6], 0.5)}
        pieces = [
            dp.Seen(points, pixels, sigma=0.02, loss=dp.SoftL1(1.0)),
            dp.Horizon([[327.13, 20.0], [854, 40.0]], 3.0),
        ]
        found = dp.adjust(camera, pieces, priors=priors, differentiable=x.requires_grad)
        m = found.mounting
        return torch.cat([torch.stack([m.tilt, m.roll, m.heading, m.height]), m.position])

    x = torch.zeros(7, dtype=D, requires_grad=True)
    value = outcome(x)
    slopes = torch.stack([torch.autograd.grad(part, x, retain_graph=True)[0] for part in value])
    direction = 1e-4 * torch.tensor([1.0, -2, 1, 1, -1, 30, 0.5], dtype=D)
    numeric = (outcome(direction) - outcome(-direction)) / 2
    torch.testing.assert_close(slopes @ direction, numeric, rtol=1e-5, atol=1e-8)


def test_forty_frames_of_a_drone_in_one_call() -> None:
    """Straight down and around it, where tilt, roll and heading are no good coordinates; a batch is what a loop gives."""
    random = torch.Generator().manual_seed(3)
    F = 40
    tilt = 90 - 3 * torch.rand(F, dtype=D, generator=random)
    tilt[:3] = 90
    path = torch.rand(F, 2, dtype=D, generator=random) * 20
    heading = torch.linspace(0, 359, F, dtype=D)
    frames = dp.Camera.mounted(60.0, tilt, 0.0, heading, focal=2000.0, size=(4000, 3000), position=path)
    points = torch.cat(
        [torch.rand(8, 2, dtype=D, generator=random) * 60 - 20, torch.rand(8, 1, dtype=D, generator=random)], 1
    )
    pixels = frames.project(points)[0] + torch.randn(F, 8, 2, dtype=D, generator=random)
    start = dp.Camera.mounted(50.0, 90.0, focal=2000.0, size=(4000, 3000))
    found = dp.adjust(start, dp.Seen(points, pixels))
    assert bool(found.converged.all())
    off = (found.cameras[..., 0].center - frames.center).norm(dim=-1)
    spread = found.covariance.about_middle
    assert float(off.amax()) < 0.5
    assert spread.shared.shape == (F, 4, 4)
    alone = dp.adjust(start, dp.Seen(points, pixels[7]))
    torch.testing.assert_close(found.cameras.R[7], alone.cameras.R, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.covariance.between(0, 0)[7], alone.covariance.between(0, 0), rtol=1e-4, atol=1e-9)
    ground = dp.measure(pixels[:, :4], found, GROUND, pixel_sigma=1.0)
    assert ground.points.shape == (F, 4, 3)


def test_roll_and_heading_may_be_any_angle_near_the_vertical() -> None:
    random = torch.Generator().manual_seed(5)
    for tilt in (89.9, -89.9):
        drone = dp.Camera.mounted(50.0, tilt, 20.0, 90.0, focal=1000.0, size=(1280, 960))
        pixels = torch.tensor([[100.0, 100], [1100, 100], [600, 900], [200, 800]], dtype=D)
        plane = dp.Plane.z(0.0 if tilt > 0 else 100.0)
        points, _ = dp.back_project(pixels, drone, plane)
        found = dp.adjust(drone, [dp.Seen(points, pixels + torch.randn(200, 4, 2, dtype=D, generator=random))])
        spread, truth = found.mounting_deviations, drone.mounting()
        assert within(found.mounting.heading, truth.heading, spread.heading) >= 0.93
        assert within(found.mounting.roll, truth.roll, spread.roll) >= 0.93
        both = torch.tensor([0.0, 1, -1 if tilt > 0 else 1, 0, 0, 0], dtype=D)  # what the two make together
        sum_of_both = (both @ found.mounting_covariance @ both).sqrt()
        total = found.mounting.roll + both[2] * found.mounting.heading
        assert float(sum_of_both.amax()) < 1
        assert within(total, truth.roll + both[2] * truth.heading, sum_of_both) >= 0.9


def test_turns_are_known_of_a_camera_that_looks_straight_down() -> None:
    drone = dp.Camera.mounted(60.0, 90.0, focal=2000.0, size=(4000, 3000))
    with pytest.raises(ValueError, match="priors: want turn_x, turn_y and turn_z"):
        dp.adjust(drone, priors={"tilt": 1.0, "roll": 1.0, "heading": 5.0}, fixed=("position", "height"))
    known = dp.adjust(drone, priors={"turn_x": 1.0, "turn_y": 1.0, "turn_z": 5.0}, fixed=("position", "height"))
    below = dp.measure([[1999.5, 1499.5]], known, GROUND, pixel_sigma=0.0).deviations[0, :2]
    one_degree = 60 * torch.pi / 180
    assert below.tolist() == pytest.approx([one_degree, one_degree], rel=1e-6)


@pytest.mark.plain
@pytest.mark.parametrize(
    ("call", "text"),
    [
        (
            lambda: dp.adjust("mast"),  # type: ignore[arg-type]
            "camera: want dp.Camera",
        ),
        (
            lambda: dp.adjust(START, ["horizon"]),  # type: ignore[list-item]
            "observations: want observations such as",
        ),
        (
            lambda: dp.adjust(START, dp.Horizon),  # type: ignore[arg-type]
            "observations: want observations such as",
        ),
        (lambda: dp.adjust(START, priors={"pitch": 1.0}), "priors: want names from tilt, roll, heading"),
        (lambda: dp.adjust(START, fixed=("focus",)), "fixed: want names from"),
        (lambda: dp.adjust(START, fixed="tilt"), "fixed: want several names"),
        (lambda: dp.adjust(START, priors={"tilt": -1.0}), "priors: want a positive standard deviation for 'tilt'"),
        (lambda: dp.adjust(START, priors={"tilt": (1, 2, 3)}), "priors: want a deviation or"),
        (lambda: dp.adjust(START, priors={"tilt": 1.0}, fixed=("tilt",)), "got 'tilt', also in priors"),
        (lambda: dp.adjust(START, priors={"tilt": 1.0, "turn_x": 1.0}), "got both 'tilt' and 'turn_x'"),
        (lambda: dp.adjust(START, priors={"height": (-3.0, 1.0)}), "priors: want a height above the ground"),
        (lambda: dp.adjust(START, priors={"tilt": (200.0, 1.0)}), "priors: want a tilt in degrees below the horizon"),
        (lambda: dp.adjust(START, priors={"focal": (-900.0, 1.0)}), "priors: want a focal length in px, more than 0"),
        (lambda: dp.adjust(START, priors=0.3), "priors: want a mapping from names, got "),  # type: ignore[arg-type]
        (lambda: dp.Seen(LANDMARKS[:0], seen()[:0]), "landmarks: want some, got none"),
        (lambda: dp.Seen(LANDMARKS, seen()[:4]), "pixels: want one for each of 6 landmarks, got 4"),
        (lambda: dp.Seen(LANDMARKS, seen(), sigma=[1.0, 2.0]), "sigma: want a number"),
        (lambda: dp.Horizon([[1.0, float("nan")]]), "pixels: want finite pixels"),
        (lambda: dp.Horizon([[1.0, 2.0]], pixel_sigma=0.0), "pixel_sigma: want a deviation in px, more than 0"),
        (lambda: dp.Heights([[1.0, 2.0]], [[1.0, 1.0], [2, 2]], 1.0, 0.1), "tops: want one for each of 1 feet, got 2"),
        (lambda: dp.Heights([[1.0, 2.0]], [[1.0, 1.0]], -1.0, 0.1), "height: want a height in world units"),
        (lambda: dp.Lengths([[1.0, 2.0]], [[1.0, 1.0]], [1.0, 2.0], 0.1), "length: want a number or one for each"),
        (lambda: dp.VanishingPoints(["up"], pixels=[[1.0, 2.0]]), "directions: want 'x', 'y', 'z' or vectors"),
        (lambda: dp.VanishingPoints(["x"]), "pixels: want pixels or segments, got neither"),
        (lambda: dp.VanishingPoints("x", pixels=[[1.0, 2.0]]), "directions: want one for each line"),
        (lambda: dp.Seen(LANDMARKS[:2], seen()[:2], [1.0, -2.0]), "more than 0 and finite, got -2 at 1"),
        (lambda: dp.Lengths([[1.0, 2], [3, 4]], [[1.0, 1]], 1.0, 0.1), "ends: want one for each of 2 starts, got 1"),
        (
            lambda: dp.Lengths([[1.0, 2], [3, 4]], [[1.0, 1], [3, 4]], 1.0, 0.1),
            "ends: want other pixels .* at 1; leave",
        ),
        (lambda: dp.Heights([[1.0, 2.0]], [[1.0, 2.0]], 1.0, 0.1), "tops: want other pixels than the feet"),
        (
            lambda: dp.VanishingPoints(["x"], segments=[[[1.0, 2], [1, 2]]]),
            "segments: want other pixels than the first",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(call: Any, text: str) -> None:
    with pytest.raises((TypeError, ValueError), match=text):
        call()


def test_a_place_far_from_the_origin_wants_float64() -> None:
    """In national grid coordinates float32 moves a mast by decimetres, which its priors said to know to centimetres."""
    far = dp.Camera.mounted(60.0, 50.0, fov_deg=70.0, size=(1600, 1200)).to(torch.float64)
    far = far.shifted(torch.tensor([-642700.0, -8304290, 0], dtype=torch.float64))
    known = {"priors": {"height": 0.05}, "fixed": ("tilt", "roll", "heading", "position")}
    with pytest.warns(UserWarning, match="float32: the scene is so far from the world's origin"):
        dp.adjust(far.to(torch.float32), **known)  # type: ignore[arg-type]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dp.adjust(far, **known)  # type: ignore[arg-type]
        dp.adjust(dp.Camera.mounted(60.0, 50.0, fov_deg=70.0, size=(1600, 1200)).to(torch.float32), **known)  # type: ignore[arg-type]


def test_a_lens_can_be_held_where_there_is_one(K: torch.Tensor, lens: dp.BrownConrady) -> None:
    for own, names in ((lens, ("k1", "k2", "p1", "p2", "k3")), (None, ())):
        parameters = PoseParameters(Parametrisation.of(dp.Camera(K, distortion=own)))
        if names:
            assert [parameters.names[i] for i in parameters.positions("fixed", "distortion")] == list(names)
        else:
            with pytest.raises(ValueError, match="fixed: want names from .*, got 'distortion'"):
                parameters.positions("fixed", "distortion")
        assert [parameters.names[i] for i in parameters.positions("fixed", "principal_point")] == ["c_x", "c_y"]


def test_verdict_and_text_of_one_camera_and_of_many() -> None:
    pieces = dp.Seen(LANDMARKS, seen(), pixel_sigma=1.0)
    one = dp.adjust(START, pieces)
    assert one.verdict.startswith("Usable: ")
    assert len(repr(one)) < 400  # a line, not all of its tensors
    two = dp.adjust(START, dp.Seen(LANDMARKS, torch.stack([seen(), seen() + 0.1]), pixel_sigma=1.0))
    assert two.verdict == "2 of 2 cameras converged."


def test_lines_have_a_deviation_each() -> None:
    """The deviations of segments are one for all, or one for each line."""
    segments = torch.rand(3, 2, 2, dtype=D) * 500
    directions = torch.eye(3, dtype=D)
    given = dp.VanishingPoints(directions, segments=segments, pixel_sigma=torch.tensor([0.5, 1.0, 2.0], dtype=D))
    assert len(given) == 3
    with pytest.raises(ValueError, match="pixel_sigma"):
        dp.VanishingPoints(directions, segments=segments, pixel_sigma=torch.tensor([0.5, 1.0], dtype=D))


BELOW = "the camera is below all landmarks and not upright"


def test_exchanged_axes_are_a_reason_in_the_verdict() -> None:
    """Residuals are those of noise: level ground mirrored is level ground, seen from below."""
    ground = torch.tensor([[-8.0, 20], [10, 26], [18, 22], [25, 35], [6, 14]], dtype=D)
    level = torch.nn.functional.pad(ground, (0, 1))
    found = dp.adjust(START, dp.Seen(level[:, [1, 0, 2]], seen(TRUE, level)))
    assert found.remarks[0].startswith(f"{BELOW}: are x and y exchanged")
    assert found.verdict == f"Usable: {BELOW}."
    assert dp.adjust(START, dp.Seen(level, seen(TRUE, level))).verdict == "Usable: nothing speaks against it."


@pytest.mark.parametrize("roll", [90.0, -90.0])
def test_a_facade_in_an_upright_photograph_of_a_camera_on_its_side(roll: float) -> None:
    """From the street all landmarks are above, and a photograph as its sensor recorded it lies on its side."""
    street = dp.Camera.mounted(1.6, -15.0, roll, focal=800.0, size=(640, 480)).to(D)
    facade = torch.tensor([[-4.0, 30, 4], [5, 30, 6], [-3, 30.5, 14], [4, 30, 19], [0, 30, 10], [2, 31, 12]], dtype=D)
    found = dp.adjust(street, dp.Seen(facade, seen(street, facade)))
    assert float(found.mounting.height) < float(facade[:, 2].min())
    assert found.remarks == ("",)


@pytest.mark.parametrize("order", [[0, 1, 2], [1, 0, 2]])
def test_one_of_many_knows_what_speaks_against_it(order: list[int]) -> None:
    """And nothing that speaks against another."""
    noise = torch.randn(3, len(LANDMARKS), 2, generator=torch.Generator().manual_seed(0), dtype=D)
    pixels = (seen() + noise * torch.tensor([1.0, 30.0, 1.0], dtype=D)[:, None, None])[order]
    many = dp.adjust(START, dp.Seen(LANDMARKS, pixels, pixel_sigma=1.0), throw=False)
    for i, one in enumerate(many):
        alone = dp.adjust(START, dp.Seen(LANDMARKS, pixels[i], pixel_sigma=1.0), throw=False)
        assert bool(one.doubts) == (order[i] == 1)
        assert one.verdict == alone.verdict
        assert one.unknown == alone.unknown
        assert one.parts[0].shape == alone.parts[0].shape
        assert one.summary() == alone.summary()
        assert one.to_dict() == pytest.approx(alone.to_dict())


# ------------------------------------------------------------------------------------------------- the other pose


def from_afar(count: int = 60) -> tuple[dp.Camera, torch.Tensor, torch.Tensor]:
    """A camera far from four landmarks on the ground, which it sees nearly without perspective; and noisy pixels."""
    camera = made(height=78.3, tilt_deg=51.5, roll_deg=0.0, heading_deg=0.0, position=[0.0, -62.3], focal=2500.0)
    points = torch.tensor([[13.5, -4.1, 0], [-0.9, 4.3, 0], [-5.0, -1.2, 0], [-7.2, -0.4, 0]], dtype=D)
    noise = torch.randn(count, 4, 2, generator=torch.Generator().manual_seed(0), dtype=D)
    return camera, points, seen(camera, points) + noise


@pytest.mark.parametrize("heading", [0.0, 180.0])
def test_the_mirrored_pose_is_told_or_taken_wherever_the_start_is(heading: float) -> None:
    """What is said to be known lies within its deviations; else the other pose is said, and it is the true one."""
    camera, points, pixels = from_afar()
    start = camera if heading == 0 else made(height=60, tilt_deg=50, heading_deg=heading, position=[0, 80], focal=2500)
    found = dp.adjust(start, dp.Seen(points, pixels, pixel_sigma=1.0), throw=False)
    other = found.rivals
    assert other is not None
    off = (found.mounting.heading + 90) % 360 - 90
    wrong = off.abs() > 90
    doubtful = other.ratio < 100
    assert bool((doubtful | ~wrong)[found.converged].all())
    assert int((~doubtful).sum()) > 5
    there = (other.heading[wrong] + 90) % 360 - 90
    assert bool((there.abs() < 30).all())
    for one in (found[i] for i in range(10)):
        assert ("another pose explains the evidence nearly as well" in one.doubts) == bool(one.rivals.ratio < 100)
    named = [str(i) for i in doubtful.nonzero().flatten().tolist()]
    assert f"of cameras {', '.join(named)} nearly as well" in found.doubts


@pytest.mark.parametrize("heading", [0.0, 180.0])
def test_deviations_hold_the_doubt_between_two_poses(heading: float) -> None:
    """A point on the ground is as uncertain as if it were known only from which pose it was measured, and how likely."""
    camera, points, pixels = from_afar()
    start = camera if heading == 0 else made(height=60, tilt_deg=50, heading_deg=heading, position=[0, 80], focal=2500)
    found = dp.adjust(start, dp.Seen(points, pixels, pixel_sigma=1.0), throw=False)
    assert found.has_alternatives
    place = torch.tensor([[8.0, 5.0, 0.0]], dtype=D)
    measured = dp.measure(camera.project(place)[0].expand(60, 1, 2), found, dp.Plane.z(0.0), pixel_sigma=0.01)
    known = found.converged & measured.deviations.isfinite().all(-1).squeeze(-1)
    off = ((measured.points - place) / measured.deviations)[known, 0, :2]
    assert int(known.sum()) > 20
    assert 0.5 < float(off.square().mean().sqrt()) < 1.5
    doubtful = found.ambiguous[:, 0] & found.converged
    kept, other = found.cameras.center[doubtful, 0], found.alternatives.center[doubtful, 0]
    p = 1 / (1 + found.rivals.ratio[doubtful, None])
    far = (kept - other).norm(dim=-1) * p.sqrt().squeeze(-1)
    assert bool((found.positions.deviations[doubtful, 0].norm(dim=-1) > 0.4 * far).all())  # a large turn, straightened
    again = dp.Calibration.from_fields(found.to_fields(), found.camera)
    torch.testing.assert_close(again.positions.deviations, found.positions.deviations)


def test_landmarks_with_relief_have_one_pose() -> None:
    found = dp.adjust(START, dp.Seen(LANDMARKS, seen() + 0.5, pixel_sigma=1.0))
    assert found.rivals is not None
    assert bool(found.rivals.ratio.isinf())
    assert not found.doubts
    assert dp.adjust(START, dp.Horizon(torch.tensor([[100.0, 120.0], [900.0, 130.0]])), throw=False).rivals is None


@pytest.mark.parametrize("start", [(6.0, 20.0, (642700.0, 8304290.0)), (8.0, 30.0, (642702.0, 8304287.0))])
def test_exact_pixels_far_from_the_origin(start: tuple[float, float, tuple[float, float]]) -> None:
    """Places round to nanometres there, which residuals of exact pixels feel: no pose is told to be the minimum."""
    truth = dp.Camera.mounted(6.0, 20.0, position=(642700.0, 8304290.0), focal=1200.0, size=(1280, 960))
    pixels = torch.tensor([[200.0, 500], [1100, 420], [640, 900], [300, 800], [900, 700], [500, 600]], dtype=D)
    points, _ = dp.back_project(pixels, truth, dp.Plane.z(0.0))
    height, tilt, position = start
    begin = dp.Camera.mounted(height, tilt, position=position, focal=1200.0, size=(1280, 960))
    found = dp.adjust(begin, dp.Seen(points, pixels))
    torch.testing.assert_close(found.mounting.height, torch.tensor(6.0, dtype=D), rtol=1e-6, atol=0)
    torch.testing.assert_close(found.mounting.position, truth.mounting().position, rtol=0, atol=1e-5)
