"""The two poses of a plane: the other one, its odds, the warning, and the error bars that hold the doubt."""

import json
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix, rotation_matrix_to_axis_angle
from torch import Tensor

import diffproj as dp
from diffproj.calibration.fitting import closed_form
from diffproj.calibration.results.ambiguity import OtherPoses, difference

D = torch.float64
BOARD = dp.Chessboard()
SIGMA = 0.3


class Flat:
    """A target of any points on z = 0."""

    def __init__(self, xy: Tensor) -> None:
        self.points = torch.nn.functional.pad(xy.to(D), (0, 1))


def marker(side: float) -> Flat:
    return Flat(side / 2 * torch.tensor([(-1.0, -1), (1, -1), (1, 1), (-1, 1)]))


SIX_POINTS = Flat(torch.tensor([(3.0, 8), (41, 12), (17, 45), (30, 29), (8, 33), (48, 40)]))


def rotations(vectors: Tensor) -> Tensor:
    return axis_angle_to_rotation_matrix(vectors.reshape(-1, 3)).reshape(*vectors.shape[:-1], 3, 3)


def pinhole(f: float, side: int = 1200) -> dp.Camera:
    middle = (side - 1) / 2
    return dp.Camera(torch.tensor([[f, 0, middle], [0, f, middle], [0, 0, 1]], dtype=D), size=(side, side))


def leaning(
    camera: dp.Camera,
    target: Any,
    count: int,
    depth: float,
    tilt: tuple[float, float],
    noise: float = SIGMA,
    seed: int = 0,
    angle: tuple[float, float] = (0.0, 8.0),
) -> tuple[Tensor, dp.Camera]:
    """Noisy corners `(count, N, 2)` and the true cameras: targets that lean that far off the line of sight, which is
    so many degrees off the axis."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=draw, dtype=D)

    def about(direction: Tensor, by: Tensor) -> Tensor:
        axis = torch.stack([direction.cos(), direction.sin(), torch.zeros_like(by)], dim=-1)
        return rotations(axis * torch.deg2rad(by).unsqueeze(-1))

    off = about(uniform(0, 2 * math.pi), uniform(*angle))
    lean = about(uniform(0, 2 * math.pi), uniform(*tilt))
    roll = rotations(torch.stack([torch.zeros(count), torch.zeros(count), uniform(-3.1, 3.1)], dim=-1).to(D))
    R = off @ lean @ roll
    t = off[..., 2] * depth - R @ target.points.mean(0)
    truth = camera.at(R, t)
    pixels, valid = truth.project(target.points)
    assert bool(valid.all())
    return pixels + noise * torch.randn(pixels.shape, generator=draw, dtype=D), truth


def tilt_error(cameras: dp.Camera, truth: dp.Camera) -> Tensor:
    """Angles in degrees between normals."""
    return torch.rad2deg((cameras.R[..., 2] * truth.R[..., 2]).sum(-1).clamp(-1, 1).acos())


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    """Of a camera of f 800 whose corners have 0.3 px of noise."""
    cameras = dp.synthetic.random_cameras(pinhole(800.0), BOARD, 13, seed=8)
    pixels, _ = cameras.project(BOARD.points)
    noise = SIGMA * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(5), dtype=D)
    return dp.calibrate(dp.Views(pixels + noise, size=(1200, 1200)), BOARD, "none")


@pytest.fixture
def quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.AmbiguousPoseWarning)
        yield


# ------------------------------------------------------------------------------------------------------ the lower pose


def lowest_of_opencv(points: Tensor, pixels: Tensor, camera: dp.Camera) -> Tensor:
    """The least sum of squares of each view: OpenCV's two poses, each refined."""
    world, K = points.numpy(), camera.K.numpy()
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    lowest = []
    for seen in pixels.numpy():
        _, vectors, shifts, _ = cv2.solvePnPGeneric(world, seen, K, None, flags=cv2.SOLVEPNP_IPPE)
        poses = [cv2.solvePnPRefineLM(world, seen, K, None, *pose, stop) for pose in zip(vectors, shifts, strict=True)]
        off = [cv2.projectPoints(world, *pose, K, None)[0].reshape(-1, 2) - seen for pose in poses]
        lowest.append(min(float(np.square(each).sum()) for each in off))
    return torch.tensor(lowest, dtype=D)


def test_a_view_that_was_found_in_the_higher_of_its_poses() -> None:
    truth = pinhole(600.0).at(
        rotations(torch.tensor([[0.3, 0.15, 0.8]], dtype=D)), torch.tensor([[-250.0, 150, 3000]], dtype=D)
    )
    noise = 0.2 * torch.from_numpy(np.random.default_rng(347).standard_normal((54, 2)))
    pixels = truth.project(BOARD.points)[0] + noise
    with pytest.warns(dp.AmbiguousPoseWarning, match="two poses fit view 1, and"):
        found = dp.locate(dp.Views(pixels), BOARD, pinhole(600.0))
    assert found.residuals.square().sum().item() == pytest.approx(3.797, abs=1e-3)  # the other: 3.991
    assert tilt_error(found.cameras, truth).item() == pytest.approx(0.9, abs=0.1)
    assert tilt_error(found.alternatives, truth).item() == pytest.approx(51, abs=1)
    other = found.alternatives.project(BOARD.points)[0] - pixels
    assert other.square().sum().item() == pytest.approx(3.991, abs=1e-3)
    # Averaged over sigma: 54 corners less a pose leave 102 degrees of freedom, and two are known to be about 0.3 px.
    assert found.likelihood_ratio.item() == pytest.approx((1 + 0.194 / (3.797 + 2 * 0.3**2)) ** 52, rel=0.02)


@pytest.mark.usefixtures("quiet")
@pytest.mark.parametrize(
    "count", [pytest.param(100, id="quick"), pytest.param(3000, id="full", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(("target", "depth"), [(BOARD, 2500.0), (marker(50.0), 800.0), (SIX_POINTS, 600.0)])
def test_no_pose_is_above_the_better_of_opencvs_two(target: Any, depth: float, count: int) -> None:
    """Of random views a few in a hundred once ended in the higher pose; now none of 3000 of each kind."""
    camera = pinhole(600.0)
    pixels, _ = leaning(camera, target, count, depth, (0.0, 60.0), noise=0.2, angle=(0.0, 20.0))
    found = dp.locate(dp.Views(pixels), target, camera, throw=False)
    lowest = lowest_of_opencv(target.points, pixels, camera)
    assert (found.residuals.square().sum((-2, -1)) <= lowest * (1 + 1e-6)).all()


@pytest.mark.parametrize("angle", [(70.0, 80.0), (80.0, 95.0), (95.0, 110.0)])
@pytest.mark.parametrize("target", [BOARD, marker(50.0)], ids=["board", "marker"])
def test_a_view_at_the_edge_of_a_fisheye(target: Any, angle: tuple[float, float]) -> None:
    """Beyond 75 degrees the start was a guess, and 18 to 44 of 100 boards were not found."""
    K = torch.tensor([[300.0, 0, 639.5], [0, 300, 639.5], [0, 0, 1]], dtype=D)
    camera = dp.Camera(K, distortion=dp.KannalaBrandt(torch.tensor([0.02, -0.005, 0.001, 0], dtype=D)))
    depth = 5 * float((target.points - target.points.mean(0)).norm(dim=-1).max())
    pixels, truth = leaning(camera, target, 60, depth, (0.0, 50.0), noise=0.0, angle=angle)
    found = dp.locate(dp.Views(pixels), target, camera)
    assert found.rms < 1e-8
    assert tilt_error(found.cameras, truth).max() < 1e-4
    assert not bool(found.ambiguous.any())


@pytest.mark.parametrize("target", [BOARD, marker(50.0)], ids=["board", "marker"])
def test_a_view_at_the_edge_of_a_wide_rectilinear_lens(target: Any) -> None:
    """Between 70 and 80 degrees off the axis 2 of 100 were not found."""
    depth = 5 * float((target.points - target.points.mean(0)).norm(dim=-1).max())
    camera = pinhole(300.0, 10_000)
    pixels, truth = leaning(camera, target, 100, 2 * depth, (0.0, 50.0), noise=0.0, angle=(70.0, 80.0))
    found = dp.locate(dp.Views(pixels), target, camera)
    assert found.rms < 1e-8
    assert tilt_error(found.cameras, truth).max() < 1e-4


def test_the_mirrored_pose_of_a_board_seen_edge_on_is_a_rotation() -> None:
    sight = torch.tensor([0.0, 0, 1], dtype=D)
    for lean in (0.0, 30.0, 89.0, 89.9, 90.0):
        R = rotations(torch.tensor([math.radians(lean), 0, 0], dtype=D)).reshape(3, 3)
        other, shift = closed_form.other_pose(R, 100 * sight, marker(10.0).points)
        torch.testing.assert_close(other @ other.mT, torch.eye(3, dtype=D), rtol=0, atol=1e-12)
        torch.testing.assert_close(other[:, 2], 2 * (R[:, 2] @ sight) * sight - R[:, 2], rtol=0, atol=1e-12)
        torch.testing.assert_close(shift, 100 * sight, rtol=0, atol=1e-10)


# ----------------------------------------------------------------------------------------------------------- the odds

HARD = {
    "marker of 50 px": (marker(50.0), 800.0, (20.0, 20.0)),
    "marker of 27 px": (marker(27.0), 800.0, (20.0, 20.0)),
    "board of 40 px": (BOARD, 4000.0, (10.0, 10.0)),
}


@pytest.mark.usefixtures("quiet")
@pytest.mark.parametrize("name", HARD)
def test_every_wrong_pose_is_flagged(name: str, calibration: dp.Calibration) -> None:
    """Of 1000 views of each kind 50, 322 and 235 ended in the wrong pose, all of them flagged."""
    target, depth, tilt = HARD[name]
    pixels, truth = leaning(pinhole(800.0), target, 200, depth, tilt)
    for known in (calibration, calibration.camera):
        found = dp.locate(dp.Views(pixels), target, known)
        kept, other = tilt_error(found.cameras, truth), tilt_error(found.alternatives, truth)
        wrong = other < kept
        assert int(wrong.sum()) >= 5
        assert int((wrong & ~found.ambiguous).sum()) <= 1  # less than 1 in 100 of those that are not flagged
        assert bool((found.likelihood_ratio >= 1).all())


@pytest.mark.usefixtures("quiet")
def test_every_wrong_pose_at_the_edge_of_a_fisheye_is_flagged() -> None:
    K = torch.tensor([[300.0, 0, 639.5], [0, 300, 639.5], [0, 0, 1]], dtype=D)
    camera = dp.Camera(K, distortion=dp.KannalaBrandt(torch.tensor([0.02, -0.005, 0.001, 0], dtype=D)))
    pixels, truth = leaning(camera, BOARD, 100, 3500.0, (10.0, 20.0), angle=(60.0, 95.0))
    found = dp.locate(dp.Views(pixels), BOARD, camera)
    wrong = tilt_error(found.alternatives, truth) < tilt_error(found.cameras, truth)
    assert int(wrong.sum()) >= 5
    assert int((wrong & ~found.ambiguous).sum()) <= 1
    near, _ = leaning(camera, BOARD, 50, 300.0, (15.0, 50.0), angle=(60.0, 95.0))
    assert not bool(dp.locate(dp.Views(near), BOARD, camera).ambiguous.any())


@pytest.mark.usefixtures("quiet")
@pytest.mark.parametrize("name", HARD)
def test_the_odds_are_those_that_happen(name: str, calibration: dp.Calibration) -> None:
    target, depth, _ = HARD[name]
    pixels, truth = leaning(pinhole(800.0), target, 400, depth, (5.0, 40.0))
    found = dp.locate(dp.Views(pixels[:, None]), target, calibration)  # each camera alone: its residuals are its own
    wrong = tilt_error(found.alternatives, truth[:, None]) < tilt_error(found.cameras, truth[:, None])
    wrong, claimed = wrong & found.likelihood_ratio.isfinite(), 1 / (1 + found.likelihood_ratio)
    for low, high in ((0, 0.05), (0.05, 0.15), (0.15, 0.3), (0.3, 0.5 + 1e-9)):
        inside = (claimed >= low) & (claimed < high)
        n = int(inside.sum())
        expected = claimed[inside].sum().item()
        spread = (claimed * (1 - claimed))[inside].sum().sqrt().item()
        assert n >= 10
        assert abs(int(wrong[inside].sum()) - expected) < 3 * spread + 1, (low, high)


@pytest.mark.usefixtures("quiet")
def test_few_corners_alone_claim_no_more_than_they_know() -> None:
    """Four corners leave two degrees of freedom, and two stand for the 0.3 px of noise that corners usually have."""
    pixels, _ = leaning(pinhole(800.0), marker(50.0), 50, 800.0, (20.0, 20.0))
    found = dp.locate(dp.Views(pixels[:, None]), marker(50.0), pinhole(800.0))
    other = (found.alternatives.project(marker(50.0).points)[0] - pixels[:, None]).square().sum((-2, -1))
    own = found.residuals.square().sum((-2, -1))
    squares = own + torch.where(own < 2 * 0.3**2 * 6.9, 2 * 0.3**2, 0.0)  # unless they tell of far more
    power = torch.where(own < 2 * 0.3**2 * 6.9, 2.0, 1.0)
    ratio = (1 + (other - own) / squares) ** power
    ratio = torch.where(found.likelihood_ratio.isfinite(), ratio, torch.inf)
    torch.testing.assert_close(found.likelihood_ratio, ratio, rtol=1e-4, atol=0)


def test_noise_that_contradicts_the_calibration_is_not_its_own(calibration: dp.Calibration) -> None:
    """Ten times the calibration's noise: its level would make every wrong pose certain."""
    pixels, truth = leaning(pinhole(800.0), marker(120.0), 200, 800.0, (20.0, 20.0), noise=10 * SIGMA)
    with pytest.warns(dp.AmbiguousPoseWarning), pytest.warns(dp.CameraMismatchWarning, match="times the|exceed the"):
        found = dp.locate(dp.Views(pixels), marker(120.0), calibration)
    wrong = tilt_error(found.alternatives, truth) < tilt_error(found.cameras, truth)
    assert int(wrong.sum()) > 10
    assert int((wrong & ~found.ambiguous).sum()) <= 1


def test_easy_views_have_one_pose(calibration: dp.Calibration) -> None:
    for side in ("left", "right"):
        found = dp.calibrate(dp.example_views(side), BOARD)  # type: ignore[arg-type]
        assert not bool(found.ambiguous.any())
        assert "poses" not in found.message
        located = dp.locate(dp.example_views(side), BOARD, found.camera)  # type: ignore[arg-type]
        assert bool(located.likelihood_ratio.isinf().all())
        assert torch.equal(located.alternatives.R, located.cameras.R)
        assert torch.equal(located.covariance.full(), located.covariance_of_kept_poses.full())
    for target, depth, tilt, known in (
        (BOARD, 600.0, (15.0, 50.0), calibration.camera),
        (BOARD, 300.0, (0.0, 50.0), calibration.camera),
        (marker(120.0), 400.0, (20.0, 50.0), calibration),
    ):
        pixels, _ = leaning(pinhole(800.0), target, 100, depth, tilt)
        assert not bool(dp.locate(dp.Views(pixels), target, known).ambiguous.any())


@pytest.mark.usefixtures("quiet")
@pytest.mark.parametrize("loss", [dp.Huber(0.2), dp.Cauchy(0.2), dp.Cauchy(1.0)])
def test_a_robust_loss_makes_no_second_pose(loss: Any) -> None:
    """The other pose fits three corners and leaves the fourth 30 px off, which Cauchy's loss hardly minds."""
    camera = pinhole(800)
    R = rotations(torch.tensor([0.42, 0.31, 0.3], dtype=D))
    pixels, _ = camera.at(R, torch.tensor([20.0, 10, 400], dtype=D)).project(marker(100).points)
    pixels = pixels + 0.2 * torch.randn(8, 4, 2, generator=torch.Generator().manual_seed(0), dtype=D)
    alone = [dp.locate(dp.Views(one[None], size=camera.size), marker(100), camera, loss=loss) for one in pixels[:4]]
    together = dp.locate(dp.Views(pixels, size=camera.size), marker(100), camera, loss=loss)
    assert not any(bool(one.ambiguous) for one in alone)
    # A corner that is three deviations off counts or not: one view has minima half a degree apart, and says so.
    apart = ((together.alternatives.R * together.cameras.R).sum((-2, -1)) - 1).div(2).clamp(-1, 1).acos().rad2deg()
    assert bool((apart[together.ambiguous] < 2).all())


def test_exact_corners_leave_no_doubt() -> None:
    for target, depth in ((marker(27.0), 800.0), (BOARD, 4000.0)):
        pixels, truth = leaning(pinhole(800.0), target, 50, depth, (20.0, 20.0), noise=0.0)
        found = dp.locate(dp.Views(pixels), target, pinhole(800.0))
        assert not bool(found.ambiguous.any())
        assert tilt_error(found.cameras, truth).max() < 1e-3


# ----------------------------------------------------------------------------------------------------- the error bars


def test_the_step_between_poses_takes_the_middle_along() -> None:
    """Also where the world's origin is far away, about which a turn would move the target by far more."""
    middle = torch.tensor([500.0, 4000, 0], dtype=D)
    R = rotations(torch.tensor([[0.3, 0.1, 0.5], [-0.3, 0.1, 0.4]], dtype=D))
    t = torch.tensor([[0.0, 0, 900], [10, 0, 880]], dtype=D) - R @ middle
    step = difference((R[0], t[0]), (R[1], t[1]), middle)
    moved = torch.linalg.cross(step[:3], R[0] @ middle) + step[3:]
    torch.testing.assert_close(moved, torch.tensor([10.0, 0, -20], dtype=D), rtol=0, atol=1e-9)
    torch.testing.assert_close(rotations(step[:3]) @ R[0], R[1])


def test_the_covariance_of_a_pose_holds_the_doubt(calibration: dp.Calibration) -> None:
    """Without the other pose normals of such boards were off by 3.8 of their standard deviations (RMS); now by 1.0."""
    target, depth, tilt = HARD["board of 40 px"]
    pixels, truth = leaning(pinhole(800.0), target, 400, depth, tilt)
    with pytest.warns(dp.AmbiguousPoseWarning):
        found = dp.locate(dp.Views(pixels[:, None]), target, calibration)
    off = rotation_matrix_to_axis_angle((truth.R @ found.cameras.R[:, 0].mT).contiguous())
    for known, low, high in ((found.covariance, 0.9, 1.15), (found.covariance_of_kept_poses, 2.5, 6.0)):
        deviation = known.view(0).diagonal(dim1=-2, dim2=-1).sqrt()[:, -6:-3]
        for axis in range(2):
            assert low < (off / deviation)[:, axis].square().mean().sqrt() < high
    probability = 1 / (1 + found.likelihood_ratio[:, 0])
    omega = rotation_matrix_to_axis_angle((found.alternatives.R[:, 0] @ found.cameras.R[:, 0].mT).contiguous())
    extra = probability[:, None, None] * omega.unsqueeze(-1) * omega.unsqueeze(-2)
    added = found.covariance.view(0) - found.covariance_of_kept_poses.view(0)
    torch.testing.assert_close(added[:, -6:-3, -6:-3], extra, rtol=1e-6, atol=1e-12)
    assert torch.equal(found.covariance.shared, found.covariance_of_kept_poses.shared)


@pytest.mark.parametrize("plane", [dp.Plane.z(0.0), dp.Plane([0.0, 1.0, 0.0], 62.5)], ids=["board", "upright"])
def test_measured_points_hold_the_doubt(plane: dp.Plane, calibration: dp.Calibration) -> None:
    target, depth, tilt = HARD["board of 40 px"]
    pixels, truth = leaning(pinhole(800.0), target, 400, depth, tilt)
    with pytest.warns(dp.AmbiguousPoseWarning):
        found = dp.locate(dp.Views(pixels[:, None]), target, calibration)
    middle = torch.tensor([100.0, 62.5, 0], dtype=D)
    on = plane.tangents() @ torch.tensor([[0.0, 200, 500], [0, 100, 0]], dtype=D)
    known = middle + on.mT
    # Their own noise is tiny: what is left is the pose's.
    measured = dp.measure(truth.project(known)[0], found, plane, view=0, pixel_sigma=1e-6)
    sound = measured.valid & measured.deviations.isfinite().all(-1)
    assert sound.double().mean() > 0.95
    free = plane.normal.abs() < 0.5
    standard = ((measured.points - known) / measured.deviations)[..., free]
    assert ((standard.abs() < 1.96)[sound].double().mean(0) - 0.95).abs().max() < 0.04
    if bool(plane.normal[2] > 0):
        assert (standard[sound].square().mean(0).sqrt() - 1).abs().max() < 0.15


def test_a_point_that_the_other_pose_puts_nowhere_is_not_determined(calibration: dp.Calibration) -> None:
    target, depth, tilt = HARD["board of 40 px"]
    pixels, _ = leaning(pinhole(800.0), target, 30, depth, tilt)
    with pytest.warns(dp.AmbiguousPoseWarning):
        found = dp.locate(dp.Views(pixels), target, calibration)
    view = int((found.ambiguous & (tilt_error(found.cameras, found.alternatives) > 15)).nonzero()[0])
    # A plane just below the camera, along the axis of the turn between the poses: the turn lifts its horizon.
    camera, other = found.cameras[view], found.alternatives[view]
    axis = rotation_matrix_to_axis_angle((other.R @ camera.R.mT).reshape(1, 3, 3)).squeeze(0)
    down = torch.linalg.cross(axis, torch.tensor([0.0, 0, 1], dtype=D))
    down = down / down.norm()
    plane = dp.Plane(camera.R.mT @ down, 50.0 - down @ camera.t)
    u, v = torch.meshgrid(torch.arange(280.0, 920, 40), torch.arange(360.0, 840, 20), indexing="xy")
    seen = torch.stack([u, v], dim=-1).reshape(-1, 2).to(D)
    measured = dp.measure(seen, found, plane, view, "detector")
    _, there = dp.back_project(seen, other, plane)
    lost = measured.valid & ~there
    assert bool(lost.any())
    assert bool(measured.deviations[lost].isinf().all())
    assert bool(measured.deviations[measured.valid & there].isfinite().all())
    first, second = lost.nonzero().flatten()[:2].tolist()
    assert bool(measured.lengths([[first, second]]).deviation.isinf().all())


# ------------------------------------------------------------------------------------------- options, shapes, messages


def stacked(calibration: dp.Calibration, count: int) -> dp.Calibration:
    """The same calibration as many times side by side."""
    pixels = calibration.views.pixels.expand(count, *calibration.views.pixels.shape)
    return dp.calibrate(dp.Views(pixels, size=(1200, 1200)), BOARD, "none")


@pytest.mark.usefixtures("quiet")
def test_a_batch_gives_what_each_gives_alone(calibration: dp.Calibration) -> None:
    pixels, _ = leaning(pinhole(800.0), marker(50.0), 12, 800.0, (20.0, 20.0))
    batch = pixels.reshape(3, 4, 4, 2)
    together = dp.locate(dp.Views(batch), marker(50.0), calibration)
    assert together.ambiguous.shape == together.likelihood_ratio.shape == (3, 4)
    assert together.alternatives.batch_shape == (3, 4)
    for camera in range(3):
        alone = dp.locate(dp.Views(batch[camera]), marker(50.0), calibration)
        torch.testing.assert_close(alone.likelihood_ratio, together.likelihood_ratio[camera], rtol=1e-6, atol=0)
        torch.testing.assert_close(alone.alternatives.R, together.alternatives.R[camera], rtol=0, atol=1e-6)
    assert "of camera (0,)" in together.message
    several = dp.locate(dp.Views(batch), marker(50.0), stacked(calibration, 3))
    torch.testing.assert_close(several.likelihood_ratio, together.likelihood_ratio, rtol=1e-6, atol=0)


@pytest.mark.usefixtures("quiet")
@pytest.mark.parametrize(
    "options",
    [{"loss": dp.Huber(0.6)}, {"loss": dp.Cauchy(1.0)}, {"weights": torch.tensor(1.0, dtype=D)}],
    ids=["huber", "cauchy", "weights"],
)
def test_other_losses_and_weights(options: dict[str, Any]) -> None:
    """A few wrong corners, which a robust loss bears; weights have no unit."""
    pixels, truth = leaning(pinhole(800.0), BOARD, 60, 4000.0, (10.0, 10.0))
    if "loss" in options:
        pixels[:, 3, 0] += 15.0
        clear, _ = leaning(pinhole(800.0), BOARD, 60, 600.0, (20.0, 40.0))
        clear[:, 3, 0] += 15.0
        assert not bool(dp.locate(dp.Views(clear), BOARD, pinhole(800.0), **options).ambiguous.any())
    found = dp.locate(dp.Views(pixels), BOARD, pinhole(800.0), **options)
    wrong = tilt_error(found.alternatives, truth) < tilt_error(found.cameras, truth)
    assert int(wrong.sum()) > 3
    assert bool(found.ambiguous[wrong].all())
    if "weights" in options:
        scaled = dp.locate(dp.Views(pixels), BOARD, pinhole(800.0), weights=options["weights"] * 1e6)
        torch.testing.assert_close(scaled.likelihood_ratio, found.likelihood_ratio, rtol=1e-3, atol=0)


def test_missing_corners_and_views() -> None:
    pixels, _ = leaning(pinhole(800.0), BOARD, 3, 8000.0, (20.0, 20.0))
    visible = torch.ones(3, 54, dtype=torch.bool)
    visible[0], visible[1, 30:] = False, False
    with pytest.warns(dp.AmbiguousPoseWarning) as told:
        found = dp.locate(dp.Views(pixels, visible, size=(1200, 1200)), BOARD, pinhole(800.0))
    assert len(told) == 1
    assert found.ambiguous.tolist()[0] is False
    assert found.ambiguous.tolist()[1] is True
    assert "view 1" not in str(told[0].message)
    assert bool(found.likelihood_ratio[0].isinf())


def test_what_is_said(calibration: dp.Calibration) -> None:
    pixels, _ = leaning(pinhole(800.0), marker(27.0), 30, 800.0, (20.0, 20.0))
    views = dp.Views(pixels, names=[f"photo {n}.jpg" for n in range(30)], size=(1200, 1200))
    with pytest.warns(dp.AmbiguousPoseWarning, match=r"^locate: two poses fit photo .*more views.*; see alternatives"):
        found = dp.locate(views, marker(27.0), calibration)
    assert found.message.startswith("converged: no step lowers the error any more; two poses fit photo")
    view = int(found.ambiguous.nonzero()[0])
    line = next(line for line in found.summary().splitlines() if f"photo {view}.jpg" in line)
    assert f"another pose is {float(found.likelihood_ratio[view]):.2g} times less likely" in line
    with warnings.catch_warnings():
        warnings.simplefilter("error", dp.AmbiguousPoseWarning)
        with pytest.raises(dp.AmbiguousPoseWarning):
            dp.locate(views, marker(27.0), calibration)


def test_calibrate_tells_its_ambiguous_views_without_a_warning() -> None:
    cameras = dp.synthetic.random_cameras(pinhole(800.0), BOARD, 8, seed=8)
    near, _ = cameras.project(BOARD.points)
    near = near + SIGMA * torch.randn(near.shape, generator=torch.Generator().manual_seed(1), dtype=D)
    far, _ = leaning(pinhole(800.0), BOARD, 2, 5000.0, (10.0, 10.0), seed=3)
    found = dp.calibrate(dp.Views(torch.cat([near, far]), size=(1200, 1200)), BOARD, "none")
    assert found.ambiguous.tolist() == [False] * 8 + [True] * 2
    assert "two poses fit view 9, view 10" in found.message
    for view in range(10):
        wide, own = found.covariance.between(view, view), found.covariance_of_kept_poses.between(view, view)
        assert torch.equal(wide, own) == (view < 8)
    assert (
        found.covariance.view(9)[-6:-3, -6:-3].trace()
        > 4 * found.covariance_of_kept_poses.view(9)[-6:-3, -6:-3].trace()
    )
    assert torch.equal(found.covariance.shared, found.covariance_of_kept_poses.shared)


def test_files_keep_the_other_pose(tmp_path: Path, calibration: dp.Calibration) -> None:
    pixels, _ = leaning(pinhole(800.0), marker(27.0), 6, 800.0, (20.0, 50.0))
    pixels = torch.cat([pixels, leaning(pinhole(800.0), marker(27.0), 1, 100.0, (30.0, 30.0), noise=0.01)[0]])
    with pytest.warns(dp.AmbiguousPoseWarning):
        found = dp.locate(dp.Views(pixels, size=(1200, 1200)), marker(27.0), calibration)
    dp.save_camera(tmp_path / "located.json", found)
    again = dp.load_calibration(tmp_path / "located.json")
    assert torch.equal(again.likelihood_ratio, found.likelihood_ratio)
    assert torch.equal(again.alternatives.R, found.alternatives.R)
    assert torch.equal(again.alternatives.t, found.alternatives.t)
    assert torch.equal(again.covariance.full(), found.covariance.full())
    assert again.summary() == found.summary()


def test_files_of_before_are_read(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    dp.save_camera(path, dp.calibrate(dp.example_views("left"), BOARD))
    document = json.loads(path.read_text())
    del document["calibration"]["other_poses"]
    path.write_text(json.dumps(document))
    found = dp.load_calibration(path)
    assert "poses" not in found.message
    assert found.summary()
    assert found.covariance.shared.isfinite().all()
    assert dp.measure(found.views.pixels[0, :2], found, dp.Plane.z(0.0), view=0).deviations.isfinite().all()
    with pytest.raises(ValueError, match="alternatives: want a calibration that was computed here"):
        _ = found.ambiguous


def test_the_probability_is_that_of_the_ratio() -> None:
    others = OtherPoses(torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3), torch.tensor([3.0, torch.inf]))
    assert others.probability.tolist() == [0.25, 0.0]
