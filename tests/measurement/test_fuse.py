"""`fuse`: the best estimate of several cameras' measurements, its covariance, and cameras that disagree."""

import math
import warnings

import pytest
import torch

import diffproj as dp
from diffproj.measurement.agreement import log_tail

D = torch.float64
K = torch.tensor([[900.0, 0, 640], [0, 900, 480], [0, 0, 1]], dtype=D)
GROUND = dp.Plane.z(0.0)
BOARD = dp.Chessboard(columns=4, rows=3, square=2.0, axes="paper")  # z up


def camera(where: tuple[float, float, float], onto: tuple[float, float] = (3.0, 2.0)) -> dp.Camera:
    """At a place over the ground z = 0, its axis through a point of it."""
    center, target = torch.tensor(where, dtype=D), torch.tensor([*onto, 0.0], dtype=D)
    z = (target - center) / (target - center).norm()
    x = torch.linalg.cross(z, torch.tensor([0.0, 0, 1], dtype=D))
    x = x / x.norm()
    R = torch.stack([x, torch.linalg.cross(z, x), z])
    return dp.Camera(K, R, -R @ center, size=(1280, 960))


PLACES = ((20.0, 2.0, 8.0), (3.0, -15.0, 6.0), (-9.0, 12.0, 10.0))
POINTS = torch.tensor([[1.0, 1, 0], [4, 0, 0], [2, 5, 0], [7, 6, 0]], dtype=D)


def located(truth: dp.Camera, noise: torch.Tensor) -> dp.Calibration:
    """The camera's poses from the board's corners on the ground, seen with noise `(*B, 12, 2)`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        seen = dp.Views((truth.project(BOARD.points)[0] + noise).unsqueeze(-3), size=truth.size)
        return dp.locate(seen, BOARD, truth.without_pose())


def measured(seed: int, points: torch.Tensor = POINTS, batch: tuple[int, ...] = ()) -> list[dp.Measurement]:
    """What the three cameras measure of points, each located by itself, with noise of 1 px."""
    g = torch.Generator().manual_seed(seed)
    found = []
    for place in PLACES:
        truth = camera(place)
        calibration = located(truth, torch.randn(*batch, 12, 2, dtype=D, generator=g))
        pixels = truth.project(points)[0] + torch.randn(*batch, len(points), 2, dtype=D, generator=g)
        found.append(dp.measure(pixels, calibration, GROUND, view=0, pixel_sigma=1.0))
    return found


def test_it_is_the_weighted_mean_that_one_writes_down() -> None:
    found = measured(0)
    fused = dp.fuse(found)

    def moved_to(xy: torch.Tensor, one: dp.Measurement) -> tuple[torch.Tensor, torch.Tensor]:
        """What it measured and its information, linearised there: pixels, and their covariance by its own slopes."""
        seen_by, own = one._sight.camera, one.points[:, :2].detach()

        def image(at: torch.Tensor) -> torch.Tensor:
            return seen_by.project(torch.nn.functional.pad(at.reshape(4, 2), (0, 1)))[0].flatten()

        there, here = (torch.func.jacrev(image)(at.flatten()) for at in (xy, own))
        C = here @ one.joint().reshape(4, 3, 4, 3)[:, :2, :, :2].reshape(8, 8) @ here.mT
        y = xy.flatten() + torch.linalg.solve(there, one._sight.pixels.flatten() - image(xy.flatten()))
        return y, there.mT @ torch.linalg.inv(C) @ there

    at = fused.points[:, :2]
    moved = [moved_to(at, one) for one in found]
    C = torch.linalg.inv(sum(information for _, information in moved))
    want = C @ sum(information @ y for y, information in moved)
    torch.testing.assert_close(at.flatten(), want, rtol=1e-7, atol=1e-9)
    joint = fused.joint().reshape(4, 3, 4, 3)[:, :2, :, :2].reshape(8, 8)
    torch.testing.assert_close(joint, C, rtol=1e-6, atol=1e-12)
    assert not fused.points[:, 2].any()
    assert bool((fused.deviations[:, :2] < torch.stack([one.deviations[:, :2] for one in found]).amin(0)).all())
    assert fused.names == ("camera 0", "camera 1", "camera 2")
    assert fused.scale == 1
    assert fused.doubts == ""


def test_sampling_reproduces_covariance_and_false_alarms() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.CameraDisagreementWarning)
        fused = dp.fuse(measured(5, batch=(600,)))
    off = (fused.points - POINTS)[..., :2].flatten(-2)
    C = fused.joint().reshape(600, 4, 3, 4, 3)[:, :, :2, :, :2].reshape(600, 8, 8)
    standard = (off * torch.linalg.solve(C, off)).sum(-1) / 8
    assert 0.95 < float(standard.mean()) < 1.25  # above 1, for deviations are told by 18 residuals of each camera
    low, high = fused.lengths([[0, 3]]).interval()
    length = (POINTS[3] - POINTS[0]).norm()
    assert 0.92 < float(((low <= length) & (length <= high)).double().mean()) < 0.98
    assert int(fused.disagrees.any(-1).sum()) <= 3
    assert 0.02 < float((fused.chance < 0.1).double().mean()) < 0.13  # cautious: the pixels' noise is known exactly


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_a_camera_that_was_moved_is_named(moved: int) -> None:
    found = measured(1)
    found[moved] = measured(1, POINTS + torch.tensor([0.4, -0.3, 0], dtype=D))[moved]  # 0.5 m off
    names = ["mast", "roof", "gate"]
    with pytest.warns(dp.CameraDisagreementWarning, match=f"{names[moved]} disagrees with the other cameras"):
        fused = dp.fuse(dict(zip(names, found, strict=True)))
    assert fused.disagrees.tolist() == [c == moved for c in range(3)]
    assert names[moved] in fused.doubts
    assert float(fused.scale) > 2
    reach = 3 * fused.deviations[:, :2]
    assert bool(((fused.points - POINTS)[:, :2].abs() < reach).all())  # the deviations hold the disagreement
    others = dp.fuse([one for c, one in enumerate(found) if c != moved])
    assert not bool(others.disagrees.any())


def test_of_two_cameras_nothing_tells_which_one_is_wrong() -> None:
    found = measured(2)[:2]
    found[1] = measured(2, POINTS + 1 - torch.tensor([0, 0, 1.0], dtype=D))[1]
    with pytest.warns(dp.CameraDisagreementWarning, match="mast and roof disagree by more than"):
        fused = dp.fuse({"mast": found[0], "roof": found[1]})
    assert fused.disagrees.tolist() == [True, True]


@pytest.mark.parametrize("landmarks", [4, 5, 12])
@pytest.mark.parametrize("px", [5.0, 20.0, 300.0])
def test_a_camera_that_is_far_off_is_named_alone(landmarks: int, px: float) -> None:
    """However few landmarks each was located by, and however far the estimate is drawn away."""
    g, found = torch.Generator().manual_seed(0), []
    survey = torch.tensor([[-4.0, -3, 0], [8, -3, 0.5], [9, 7, 1], [-3, 8, 0], [2, 3, 2]], dtype=D)
    survey = torch.cat([survey, survey + 1, survey - torch.tensor([1.0, -1, 0], dtype=D)])[:landmarks]
    for place in PLACES:
        truth = camera(place)
        seen = truth.project(survey)[0] + 0.5 * torch.randn(landmarks, 2, dtype=D, generator=g)
        one = dp.locate(dp.Views(seen[None], size=truth.size), dp.Landmarks(survey), truth.without_pose())
        pixels = truth.project(POINTS)[0] + 0.5 * torch.randn(4, 2, dtype=D, generator=g)
        found.append(dp.measure(pixels + torch.tensor([px * (place == PLACES[1]), 0.0]), one, GROUND, pixel_sigma=0.5))
    with pytest.warns(dp.CameraDisagreementWarning, match="camera 1 disagrees with the other cameras"):
        fused = dp.fuse(found)
    assert fused.disagrees.tolist() == [False, True, False]
    assert bool(((fused.points - POINTS)[:, :2].abs() < 4 * fused.deviations[:, :2]).all())


def test_the_normal_of_a_plane_may_point_to_either_side() -> None:
    pixels = [camera(place).project(POINTS + torch.tensor([0, 0, 0.25]))[0] for place in PLACES[:2]]
    planes = [dp.Plane([0.0, 0, 2], 0.5), dp.Plane([0.0, 0, -4], -1.0)]
    one, other, turned = (
        dp.measure(pixels[c], camera(PLACES[c]), planes[p], pixel_sigma=1.0) for c, p in ((0, 0), (1, 0), (1, 1))
    )
    want, fused = dp.fuse([one, other]), dp.fuse([one, turned])
    torch.testing.assert_close(fused.points, want.points)
    torch.testing.assert_close(fused.covariance, want.covariance)


def test_no_points_are_joined_to_none() -> None:
    none = dp.measure(torch.zeros(0, 2, dtype=D), camera(PLACES[0]), GROUND, pixel_sigma=1.0)
    fused = dp.fuse([none, none])
    assert fused.points.shape == (0, 3)
    assert fused.to_dict()["point"] == []


def test_the_summary_says_whose_errors_the_deviations_hold() -> None:
    truths = [camera(place) for place in PLACES[:2]]
    alone = [dp.measure(one.project(POINTS)[0], one, GROUND, pixel_sigma=1.0) for one in truths]
    posed = measured(0)[:2]
    for names, pair, held in (
        (("a", "b"), alone, "noise of the pixels alone:"),
        (("a", "b"), posed, "noise of the pixels and the pose:"),
        (("mast", "roof"), [posed[0], alone[1]], "noise of the pixels and the pose of mast:"),
    ):
        assert held in dp.fuse(dict(zip(names, pair, strict=True))).summary()
    uncertain = 0.01 * torch.eye(4, dtype=D)
    for one, held in ((truths[0], "pixels and the plane"), (located(truths[0], 0 * BOARD.points[:, :2]), "")):
        given = {"pixel_sigma": 1.0, "plane_covariance": uncertain}
        text = dp.measure(truths[0].project(POINTS)[0], one, GROUND, **given).summary()
        assert f"noise of the {held or 'pixels, the pose and the plane'}:" in text


def test_what_a_camera_does_not_see_others_tell() -> None:
    pixels = camera(PLACES[0]).project(POINTS)[0].clone()
    pixels[1] = torch.nan
    first = dp.measure(pixels, located(camera(PLACES[0]), torch.zeros(12, 2, dtype=D)), GROUND, view=0, pixel_sigma=1.0)
    second = measured(3)[1]
    fused = dp.fuse([first, second])
    assert fused.seen.tolist() == [[True, False, True, True], [True] * 4]
    assert bool(fused.valid.all())
    # The second camera's pose, better known by the points that both see, helps the point that it alone sees.
    assert float(fused.deviations[1].norm()) < float(second.deviations[1].norm())
    neither = dp.fuse([first, dp.measure(pixels, camera(PLACES[0]), GROUND, pixel_sigma=1.0)])
    assert neither.valid.tolist() == [True, False, True, True]
    assert bool(neither.covariance[1].isnan().all())
    columns = neither.to_dict()
    assert columns["cameras"] == [2, 0, 2, 2]
    assert columns["reason"] == ["VALID", "NOT_MEASURED", "VALID", "VALID"]
    assert "point 1   not measured" in neither.summary()
    assert "0 to 1    not both points are measured" in neither.summary()
    assert repr(neither) == "FusedMeasurement(2 cameras, 4 points, 1 not measured)"


def test_batches_heights_and_gradients() -> None:
    heights = dp.Plane.per_point([0.0, 0.0, 1.0], torch.tensor([0.0, 0.5, 1.0, 2.0], dtype=D))
    points = POINTS + torch.tensor([[0, 0, h] for h in (0.0, 0.5, 1.0, 2.0)], dtype=D)
    pair = [camera(place) for place in PLACES[:2]]
    pixels = [one.project(points)[0].requires_grad_() for one in pair]
    alone = [dp.measure(p, one, heights, pixel_sigma=1.0) for p, one in zip(pixels, pair, strict=True)]
    fused = dp.fuse(alone)
    torch.testing.assert_close(fused.points, points, rtol=0, atol=1e-9)
    (slope,) = torch.autograd.grad(fused.points[0, 0], pixels[0], retain_graph=True)
    assert slope[0].abs().sum() > 0
    assert torch.autograd.grad(fused.deviations.sum(), pixels[0])[0].isfinite().all()

    def x_of_first(p: torch.Tensor) -> torch.Tensor:
        return dp.fuse([dp.measure(p, pair[0], heights, pixel_sigma=1.0), alone[1]]).points[0, 0]

    step = torch.zeros_like(pixels[0])
    step[0, 0] = 1e-3
    difference = (x_of_first(pixels[0].detach() + step) - x_of_first(pixels[0].detach() - step)) / 2e-3
    torch.testing.assert_close(slope[0, 0], difference.detach(), rtol=1e-6, atol=1e-12)

    both = dp.Camera.stack([pair[0], pair[0]])
    twice = torch.stack([pixels[0].detach(), pixels[0].detach() + 1])
    batch = dp.fuse([dp.measure(twice, both, heights, pixel_sigma=1.0), alone[1]])
    for b in range(2):
        one = dp.fuse([dp.measure(twice[b], pair[0], heights, pixel_sigma=1.0), alone[1]])
        torch.testing.assert_close(batch.points[b], one.points)
        torch.testing.assert_close(batch.covariance[b], one.covariance)


def test_the_tail_of_the_f_distribution() -> None:
    # scipy.stats.f.logsf(chi2 / count, count, freedom) and chi2.logsf, and nothing that could be unlike
    chi2, count, freedom = (
        torch.tensor(x, dtype=D)
        for x in (
            [20.0, 20, 12, 4, 1e4, 300, 5e4, 50, 0],
            [8, 8, 2, 2, 8, 40, 8, 8, 0],
            [18.0, math.inf, 5, 3.7, 2, 50, math.inf, 1e12, math.inf],
        )
    )
    want = [-2.981131177, -4.572117429, -3.059438579, -1.355841892, -7.131398755, -23.474587449, -24971.411746155]
    want = torch.tensor([*want, -17.012928521, 0], dtype=D)
    torch.testing.assert_close(log_tail(chi2, count, freedom), want, rtol=1e-9, atol=1e-9)


def test_it_refuses_what_cannot_be_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, _ = measured(4)
    with pytest.raises(ValueError, match="want those of two cameras or more, got 1"):
        dp.fuse([first])
    with pytest.raises(
        ValueError, match="want the same points of each camera, got 4 of camera 0 and 2 of gate|camera 1"
    ):
        dp.fuse([first, measured(4, POINTS[:2])[1]])
    pixels = camera(PLACES[1]).project(POINTS)[0]
    with pytest.raises(ValueError, match="want one plane, in one world frame, got different ones of a and b"):
        dp.fuse({"a": first, "b": dp.measure(pixels, camera(PLACES[1]), dp.Plane.z(1.0), pixel_sigma=1.0)})
    uncertain = dp.measure(
        pixels, camera(PLACES[1]), GROUND, pixel_sigma=1.0, plane_covariance=0.01 * torch.eye(4, dtype=D)
    )
    with pytest.raises(ValueError, match="want an exact plane, got an uncertain one"):
        dp.fuse([first, uncertain])
    exact = dp.measure(pixels, camera(PLACES[1]), GROUND, pixel_sigma=0.0)
    with pytest.raises(ValueError, match="want points with an uncertainty of their own, got camera 1 without"):
        dp.fuse([first, exact])
    with pytest.raises(TypeError, match="got fused ones for camera 0; fuse all cameras at once"):
        dp.fuse([dp.fuse([first, second]), second])
    monkeypatch.setattr("diffproj.measurement.fuse.MOST_POINTS", 5)
    many = dp.measure(pixels[:1].expand(2, 6, 2), camera(PLACES[1]), GROUND, pixel_sigma=1.0)
    with pytest.raises(ValueError, match="want at most 5 points at once, got 6"):
        dp.fuse([many, many])


@pytest.mark.plain
def test_wrong_types_are_named() -> None:
    for wrong in (None, 3, "measurements", [1, 2], {"a": 1, "b": 2}):
        with pytest.raises(TypeError, match="measurements: want what dp.measure gives for each camera"):
            dp.fuse(wrong)


def test_photographs_of_one_calibration_share_its_errors() -> None:
    """Twice the same tells no more than once; two photographs of one camera tell at most as if they were independent."""
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
    pixels = calibration.views.pixels[:2, ::9]
    one, other = (dp.measure(pixels[v], calibration, GROUND, view=v, pixel_sigma="detector") for v in (0, 1))
    twice = dp.fuse([one, one])
    torch.testing.assert_close(twice.covariance, one.covariance, rtol=1e-6, atol=1e-12)
    both = dp.fuse([one, other])
    least = torch.minimum(one.deviations, other.deviations)[:, :2]
    assert bool((both.deviations[:, :2] > 0.9 * least).all())


def test_cameras_of_one_rig_share_its_errors(tmp_path) -> None:
    """They tell at least what the best of them tells, and no more than if they were independent; from a file as well."""
    pair = {name: dp.example_views(name)[:6] for name in ("left", "right")}
    rig = dp.calibrate_rig(pair, dp.Chessboard())
    dp.save_camera(tmp_path / "rig.json", rig)
    again = dp.load(tmp_path / "rig.json")
    assert isinstance(again, dp.RigCalibration)
    new = {name: dp.example_views(name)[6:7] for name in pair}
    for source in (rig, again):
        located = {name: dp.locate(new[name], dp.Chessboard(), source[name]) for name in pair}
        for cameras in ({name: source[name] for name in pair}, located):
            seen = {
                name: dp.measure(one.views.pixels[0, ::9], one, GROUND, view=0, pixel_sigma="detector")
                for name, one in cameras.items()
            }
            fused = dp.fuse(seen)
            alone = torch.stack([one.covariance[:, :2, :2] for one in seen.values()])
            information = torch.linalg.inv(alone).mean(0)
            bound = torch.linalg.inv(information).diagonal(dim1=-2, dim2=-1).sqrt()
            assert bool((fused.deviations[:, :2] > 0.8 * bound).all())
            independent = torch.linalg.inv(torch.linalg.inv(alone).sum(0)).diagonal(dim1=-2, dim2=-1).sqrt()
            assert bool((fused.deviations[:, :2] > 1.1 * independent).all())
    apart = {name: dp.calibrate(views, dp.Chessboard()) for name, views in pair.items()}
    seen = {
        name: dp.measure(one.views.pixels[0, ::9], one, GROUND, view=0, pixel_sigma="detector")
        for name, one in apart.items()
    }
    alone = torch.stack([one.covariance[:, :2, :2] for one in seen.values()])
    independent = torch.linalg.inv(torch.linalg.inv(alone).sum(0)).diagonal(dim1=-2, dim2=-1).sqrt()
    fused = dp.fuse(seen)
    assert bool((fused.deviations[:, :2] / fused.scale < 1.05 * independent).all())


def test_frames_of_a_camera_that_stands_still_share_its_pose() -> None:
    """However many they are, they tell no more of it."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator, dtype=D)

    truth = dp.Camera.mounted(10.0, 35.0, heading_deg=50.0, focal=1000.0, size=(1920, 1080))
    points, _ = dp.back_project(torch.tensor([[960.0, 700.0], [500.0, 800.0]], dtype=D), truth, GROUND)
    pixels, draws = truth.project(points)[0], 200
    height, tilt = 10 + 0.1 * normal(draws), 35 + 0.5 * normal(draws)
    guess = dp.Camera.mounted(height, tilt, heading_deg=50.0, focal=1000.0, size=(1920, 1080))
    known = dp.adjust(guess, priors={"height": 0.1, "tilt": 0.5}, fixed=("roll", "heading", "position"))
    for frames in (2, 8):
        seen = [dp.measure(pixels + 0.5 * normal(draws, 2, 2), known, GROUND, pixel_sigma=0.5) for _ in range(frames)]
        fused = dp.fuse(seen)
        low, high = fused.interval()
        within = ((low <= points) & (points <= high))[..., :2].double().mean()
        assert 0.9 < float(within) < 0.99
        assert bool((fused.deviations[..., :2] > 0.9 * seen[0].deviations[..., :2]).all())
    exact = dp.fuse([dp.measure(pixels, truth, GROUND, pixel_sigma=0.5) for _ in range(4)])
    one = dp.measure(pixels, truth, GROUND, pixel_sigma=0.5)
    torch.testing.assert_close(exact.covariance, one.covariance / 4)  # an exact camera has no errors to share


def test_cameras_that_were_adjusted_to_the_same_landmarks_share_their_errors() -> None:
    """As those that `locate` found by them do."""
    generator = torch.Generator().manual_seed(1)
    truths = [camera(place) for place in PLACES]
    survey = torch.tensor([[0, 0, 0], [6, 0, 0], [0, 4, 0], [6, 4, 0], [3, 2, 1.0]], dtype=D)
    surveyed = survey + 0.05 * torch.randn(survey.shape, generator=generator, dtype=D)
    found = []
    for one in truths:
        seen = one.project(survey)[0] + 0.3 * torch.randn((5, 2), generator=generator, dtype=D)
        posed = dp.adjust(one, [dp.Seen(surveyed, seen, pixel_sigma=0.3, sigma=0.05)])
        found.append(dp.measure(one.project(POINTS)[0], posed, GROUND, pixel_sigma=0.3))
    fused = dp.fuse(found)
    information = torch.linalg.inv(torch.stack([one.covariance[:, :2, :2] for one in found])).mean(0)
    bound = torch.linalg.inv(information).diagonal(dim1=-2, dim2=-1).sqrt()
    assert bool((fused.deviations[:, :2] > 0.8 * bound).all())


def test_far_points_are_not_drawn_towards_the_cameras() -> None:
    """Near the horizon each camera's own deviation grows with what it measures, and would weigh it."""
    mast, far, draws = dp.Camera.mounted(2.0, 0.0, focal=500.0, size=(640, 480)), 100.0, 2000
    pixel = mast.project(torch.tensor([[1.0, far, 0.0]], dtype=D))[0]
    noise = torch.randn((10, draws, 1, 2), generator=torch.Generator().manual_seed(2), dtype=D)
    alone = [dp.measure(pixel + one, mast, GROUND, pixel_sigma=1.0) for one in noise]
    fused = dp.fuse(alone)
    assert abs(float(fused.points[..., 1].median()) / far - 1) < 0.005
    low, high = fused.interval()
    assert 0.93 < float(((low <= far) & (far <= high))[..., 1].double().mean()) < 0.97
    assert float(alone[0].nonlinear.double().mean()) > 0.9
    assert not bool(fused.nonlinear.any())  # ten together are sure enough
    two = dp.fuse(alone[:2])
    assert float(two.nonlinear.double().mean()) > 0.5
    assert "nonlinear" in dp.fuse([dp.measure(pixel, mast, GROUND, pixel_sigma=1.0)] * 2).summary()


def test_pinholes_without_a_lens_are_joined() -> None:
    views = dp.example_views("left")
    calibration = dp.calibrate(views, dp.Chessboard(), "none")
    found = [dp.measure(views.pixels[v, :3], calibration, GROUND, v, 0.5) for v in (0, 1)]
    fused = dp.fuse(found)
    assert bool((fused.deviations[:, :2] > 0.9 * torch.minimum(*(one.deviations[:, :2] for one in found))).all())


def test_one_of_a_fleet_shares_the_fleets_errors_in_its_own_place() -> None:
    left, right = (dp.example_views(name)[:9] for name in ("left", "right"))
    fleet = dp.calibrate(dp.Views(torch.stack([left.pixels, right.pixels]), size=left.size), dp.Chessboard())
    many = dp.measure(fleet.views.pixels[:, 0, ::9], fleet, GROUND, view=0, pixel_sigma=0.3)
    one = dp.measure(fleet.views.pixels[0, 0, ::9], fleet[0], GROUND, view=0, pixel_sigma=0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.CameraDisagreementWarning)
        fused = dp.fuse([many, one])
    torch.testing.assert_close(fused.covariance[0], one.covariance, rtol=1e-6, atol=1e-12)


def test_what_all_cameras_extrapolate_is_said() -> None:
    views = dp.example_views("left")
    calibration = dp.calibrate(views, dp.Chessboard())
    pixels = torch.tensor([[10.0, 240.0], [320.0, 240.0]], dtype=D)
    one, other = (dp.measure(pixels, calibration, GROUND, view, 0.5) for view in (0, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.CameraDisagreementWarning)
        fused = dp.fuse([one, other])
    assert fused.extrapolated is not None
    assert fused.extrapolated.tolist() == [True, False]
    assert "extrapolated" in fused.summary()
    assert fused.to_dict()["extrapolated"] == [True, False]
