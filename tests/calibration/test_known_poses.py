"""`locate` with what is known of the pose: the same as `adjust`, error bars against sampling, the mirrored pose."""

import warnings
from typing import Any

import pytest
import torch

import diffproj as dp
from diffproj.calibration.evidence.adjustment import mounting_covariance

D = torch.float64
GROUND = dp.Plane.z(0.0)
TRUE = dp.Camera.mounted(6.0, 20.0, 2.0, 30.0, position=[3.0, -2.0], focal=900.0, size=(1280, 720))
LANDMARKS = torch.tensor([[10.0, 30, 1], [25, 28, 3], [4, 12, 0], [9, 11, 0.5], [14, 16, 0], [2, 18, 2]], dtype=D)
PIXELS = TRUE.project(LANDMARKS)[0]


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=D, generator=torch.Generator().manual_seed(seed))


def located(pixels: torch.Tensor, camera: Any = TRUE, points: Any = LANDMARKS, **known: Any) -> dp.Calibration:
    """Each row of pixels `(S, N, 2)` a camera of one view."""
    visible = pixels.isfinite().all(-1)
    views = dp.Views(pixels.unsqueeze(-3), visible.unsqueeze(-2), size=(1280, 720))
    return dp.locate(views, dp.Landmarks(points), camera, **known)


@pytest.mark.parametrize(
    "known",
    [
        {"priors": {"height": 0.05, "tilt": 0.2}},
        {"priors": {"position": (torch.tensor([3.1, -2.05], dtype=D), 0.05), "heading": (390.5, 0.5)}},
        {"fixed": ("height", "roll")},
        {"fixed": ("position",), "priors": {"turn": 0.3}},
        {"fixed": ("mounting",), "priors": {}},
    ],
)
def test_it_is_what_adjust_finds(known: dict[str, Any]) -> None:
    pixels = PIXELS + noise(6, 2)
    want = dp.adjust(TRUE, dp.Seen(LANDMARKS, pixels, pixel_sigma=0.8), **known)
    found = located(pixels, pixel_sigma=0.8, **known)
    torch.testing.assert_close(found.cameras.R, want.cameras.R, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.cameras.t, want.cameras.t, atol=1e-8, rtol=0)
    torch.testing.assert_close(
        found.covariance.poses,
        want.covariance.poses,
        atol=1e-12 + 1e-6 * float(want.covariance.poses.abs().max()),
        rtol=1e-6,
    )
    assert bool(found.positions.deviations.isfinite().all())


def test_what_is_fixed_keeps_its_value_in_every_view() -> None:
    """And has no deviation, however far it is from what the landmarks say; a turn by 360 degrees changes nothing."""
    mast = dp.Camera.mounted(6.2, 24.0, 0.0, 29.0, position=[3.0, -2.0], focal=900.0, size=(1280, 720))
    views = dp.Views(PIXELS + noise(3, 6, 2), size=(1280, 720))
    found = dp.locate(views, dp.Landmarks(LANDMARKS), mast, fixed=("height", "heading"))
    mounting = found.cameras.mounting()
    torch.testing.assert_close(mounting.height, torch.full((3,), 6.2, dtype=D), atol=1e-12, rtol=0)
    torch.testing.assert_close(mounting.heading, torch.full((3,), 29.0, dtype=D), atol=1e-10, rtol=0)
    spread = mounting_covariance(found, 1).diagonal()
    assert bool((spread[[2, 5]].abs() < 1e-12).all())
    assert bool((spread[[0, 1, 3, 4]] > 1e-8).all())
    assert int(found.degrees_of_freedom) == 3 * (12 - 4)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["fixed", "fixed, noise known", "priors"])
def test_intervals_hold_the_truth(which: str) -> None:
    """95 % intervals of a ground point and of the place, in 600 scenes with a noise of 1 px: 93 to 97 %."""
    S = 600
    off = noise(S, 2, seed=5)
    known: dict[str, Any] = {
        "fixed": {"fixed": ("height", "roll")},
        "fixed, noise known": {"fixed": ("height", "roll"), "pixel_sigma": 1.0},
        "priors": {
            "pixel_sigma": 1.0,
            "priors": {"height": (6 + 0.03 * off[:, :1], 0.03), "tilt": (20 + 0.1 * off[:, 1:], 0.1)},
        },
    }[which]
    found = located(PIXELS + noise(S, 6, 2, seed=1), **known)
    assert bool(found.converged.all())
    probe = torch.tensor([[600.0, 500], [200, 400], [1100, 650]], dtype=D)
    truth = dp.back_project(probe, TRUE, GROUND)[0]
    measured = dp.measure(probe + noise(S, 3, 2, seed=2), found, GROUND, view=0, pixel_sigma=1.0)
    low, high = measured.interval()
    assert 0.93 < float(((low <= truth) & (truth <= high))[..., :2].to(D).mean()) < 0.97
    z = (found.positions.points[:, 0] - TRUE.center)[:, :2] / found.positions.deviations[:, 0, :2]
    assert 0.9 < float(z.square().mean()) < (1.15 if "pixel_sigma" in known else 1.45)  # Student's t of 8: 1.33


def test_a_prior_on_the_tilt_tells_the_mirrored_pose() -> None:
    """Of a small flat target far away: alone the corners leave open which it is, with the tilt to 2 degrees they do not."""
    far = dp.Camera.mounted(25.0, 65.0, heading_deg=10.0, focal=900.0, size=(1280, 720))
    center = dp.back_project([[640.0, 360.0]], far, GROUND)[0][0]
    square = center + 0.5 * torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=D)
    pixels = far.project(square)[0] + 0.5 * noise(40, 4, 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.AmbiguousPoseWarning)
        alone = located(pixels, far, square, pixel_sigma=0.5)
    known = located(pixels, far, square, pixel_sigma=0.5, priors={"tilt": (65.0, 2.0), "roll": (0.0, 2.0)})
    assert int(alone.ambiguous.sum()) > 20
    assert int(known.ambiguous.sum()) == 0
    assert float((known.cameras[:, 0].mounting().tilt - 65).abs().max()) < 6
    # A tilt that is hardly known leaves it open, and says so.
    with pytest.warns(dp.AmbiguousPoseWarning):
        hardly = located(pixels, far, square, pixel_sigma=0.5, priors={"tilt": (65.0, 60.0)})
    assert int(hardly.ambiguous.sum()) > 20


def test_the_intrinsics_of_a_calibration_go_along() -> None:
    """As `adjust` has them; and two views err together, as the same focal length moves both."""
    board = dp.Chessboard(6, 5, 0.2)
    views = dp.synthetic.corner_views(dp.synthetic.random_cameras(TRUE.without_pose(), board, 6), board, noise_px=0.5)
    calibration = dp.calibrate(views, board, "none")
    priors = {"height": (6.0, 0.05)}
    want = dp.adjust(calibration, dp.Seen(LANDMARKS, PIXELS, 0.01), priors=priors)
    two = dp.Views(PIXELS.expand(2, 6, 2), size=(1280, 720))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = dp.locate(two, dp.Landmarks(LANDMARKS), calibration, pixel_sigma=0.01, priors=priors)
    phi = float(found.covariance.dispersion)
    torch.testing.assert_close(found.covariance.poses[0], want.covariance.poses[0], rtol=1e-3 * phi, atol=1e-9)
    torch.testing.assert_close(found.covariance.between(0, 1), found.covariance.poses[0], rtol=0.1, atol=1e-5)
    torch.testing.assert_close(found.covariance.shared, want.covariance.shared)


def test_how_steeply_a_camera_without_a_pose_looks_the_corners_tell() -> None:
    """A prior on its roll was refused, as of one that looks straight down; of one that does it still is."""
    found, level = (
        located(PIXELS[None], one, pixel_sigma=0.8, priors={"roll": (2.5, 0.01)})
        for one in (TRUE.without_pose(), dp.Camera.mounted(5.0, 10.0, focal=900.0, size=(1280, 720)))
    )
    torch.testing.assert_close(found.cameras.R, level.cameras.R, rtol=0, atol=1e-7)
    assert float(found.cameras.mounting().roll) == pytest.approx(2.5, abs=0.05)
    down = dp.Camera.mounted(30.0, 90.0, position=[12.0, 18.0], focal=900.0, size=(1280, 720))
    with pytest.raises(ValueError, match="for a camera that looks straight down"):
        located(down.project(LANDMARKS)[0][None], down.without_pose(), pixel_sigma=0.8, priors={"roll": (2.5, 0.01)})


def test_landmarks_far_from_the_origin() -> None:
    offset = torch.tensor([642735.0, 8304292.0, 0.0], dtype=D)
    there = TRUE.shifted(-offset)
    pixels = PIXELS + noise(6, 2)
    here, far = (
        located(pixels, camera, points, pixel_sigma=1.0, priors={"height": 0.05, "position": 0.1})
        for camera, points in ((TRUE, LANDMARKS), (there, LANDMARKS + offset))
    )
    torch.testing.assert_close(far.positions.points - offset, here.positions.points, atol=1e-6, rtol=0)
    torch.testing.assert_close(far.positions.covariance, here.positions.covariance, atol=1e-9, rtol=1e-5)


@pytest.mark.parametrize("known", [{}, {"priors": {"height": 0.05}}, {"fixed": ("roll",)}])
def test_a_wrong_landmark_among_six_is_rejected_where_the_noise_is_known(known: dict[str, Any]) -> None:
    """36 px off with a noise of 1 px: its own residual is no larger than others'. Each of the six in turn."""
    pixels, wrong = (PIXELS + noise(6, 2)).repeat(6, 1, 1), torch.eye(6, dtype=torch.bool)
    pixels[wrong] += torch.tensor([30.0, -20.0], dtype=D)
    found = located(pixels, pixel_sigma=1.0, reject_outliers=True, **known)
    assert torch.equal(found.rejected[:, 0], wrong)
    without = located(torch.where(wrong.unsqueeze(-1), torch.nan, pixels), pixel_sigma=1.0, **known)
    torch.testing.assert_close(found.cameras.center, without.cameras.center, atol=1e-6, rtol=0)
    assert not found.doubts


def test_rejected_is_what_those_that_were_kept_speak_against() -> None:
    """By the definition: the residual of each over its covariance, of its own noise and of a pose from the kept ones."""
    limit, generator = 4.0, torch.Generator().manual_seed(6)
    more = torch.rand(2, 3, dtype=D, generator=generator) * torch.tensor([20.0, 20, 3], dtype=D)
    points = torch.cat([LANDMARKS, more + torch.tensor([2.0, 10, 0], dtype=D)])
    pixels = TRUE.project(points)[0] + noise(50, 8, 2, seed=4)
    pixels[:, :2] += 12 * noise(50, 2, 2, seed=5)
    found = located(pixels, points=points, pixel_sigma=1.0, reject_outliers=limit)

    def seen(step: torch.Tensor, camera: dp.Camera) -> torch.Tensor:
        x, y, z = step[:3]
        o = torch.zeros_like(x)
        cross = torch.stack([o, -z, y, z, o, -x, -y, x, o]).unflatten(0, (3, 3))
        return camera.at(torch.matrix_exp(cross) @ camera.R, camera.t + step[3:]).project(points)[0]

    kept = found.used[:, 0]
    compared = 0
    for i in range(50):
        camera = found.cameras[i, 0]
        J = torch.autograd.functional.jacobian(lambda step, c=camera: seen(step, c), torch.zeros(6, dtype=D))
        pose = torch.linalg.inv((J[kept[i]].mT @ J[kept[i]]).sum(0))
        sign = torch.where(kept[i], -1.0, 1.0)[:, None, None]
        e = (camera.project(points)[0] - pixels[i]).unsqueeze(-1)
        size = (e.mT @ torch.linalg.solve(torch.eye(2, dtype=D) + sign * (J @ pose @ J.mT), e)).flatten().sqrt()
        if int(kept[i].sum()) > 4:
            assert bool((size[kept[i]] < limit + 1e-3).all())
            assert bool(((size > limit - 1e-3) | (e.flatten(1).norm(dim=-1) > limit))[~kept[i]].all())
            compared += int((~kept[i]).sum())
    assert compared > 40


def test_none_of_good_landmarks_is_rejected() -> None:
    found = located(PIXELS + noise(200, 6, 2, seed=3), pixel_sigma=1.0, reject_outliers=True)
    assert int(found.rejected.sum()) == 0


def test_priors_that_contradict_the_landmarks_are_told() -> None:
    found = located(PIXELS, pixel_sigma=1.0, priors={"tilt": (23.0, 0.1)})
    assert "times what" in found.doubts
    assert "times what" in dp.measure([[600.0, 500.0]], found, GROUND, view=0, pixel_sigma=1.0).doubts
    assert not located(PIXELS, pixel_sigma=1.0, priors={"tilt": (20.1, 0.1)}).doubts


@pytest.mark.parametrize(
    ("known", "text"),
    [
        ({"priors": {"focal": 10.0}, "pixel_sigma": 1.0}, "priors: want names of the pose, got 'focal', which locate"),
        ({"priors": {"height": 0.1}}, "pixel_sigma: want the noise of the pixels beside priors"),
        ({"fixed": ("hight",)}, "fixed: want names from tilt, roll, heading"),
        ({"fixed": ("height",), "priors": {"height": 1.0}}, "fixed: want what has neither a prior"),
        ({"fixed": ("height",), "loss": dp.Huber(1.0)}, "loss: want none beside fixed and priors"),
        ({"priors": {"tilt": (torch.ones(3, dtype=D), 1.0)}, "pixel_sigma": 1.0}, "priors: want values that broadcast"),
        ({"fixed": ("height",), "camera": dp.Camera(TRUE.K)}, "fixed: want a camera at the pose that 'height' is of"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(known: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        located(PIXELS, **known)
