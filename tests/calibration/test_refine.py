"""What `refine` and `locate` start from: cameras and poses of every shape, and what they say of those of no use."""

import warnings

import pytest
import torch

import diffproj as dp
from diffproj import synthetic

D = torch.float64
BOARD = dp.Chessboard(9, 6, 25.0)
K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D)
VIEWS = 4


@pytest.fixture(scope="module")
def seen() -> tuple[dp.Camera, dp.Views]:
    """Two cameras with four views each, corners to a tenth of a pixel."""
    lens = dp.BrownConrady(torch.tensor([-0.28, 0.08, 0.001, -0.001, 0.0], dtype=D))
    posed = synthetic.random_cameras(dp.Camera(K, distortion=lens, size=(640, 480)), BOARD, 2 * VIEWS, seed=1)
    truth = dp.Camera.stack([posed[:VIEWS], posed[VIEWS:]])
    return truth, synthetic.corner_views(truth, BOARD, noise_px=0.1, seed=1)


def test_poses_broadcast_to_the_views(seen: tuple[dp.Camera, dp.Views]) -> None:
    truth, views = seen
    twice = dp.Views(views.pixels[:1].expand(2, -1, -1, -1), size=views.size)
    wanted = dp.refine(twice, BOARD, truth[:1].expand(2, VIEWS))
    for poses in (truth[0], truth[:1]):
        found = dp.refine(twice, BOARD, poses)
        assert torch.equal(found.camera.K, wanted.camera.K)
        assert torch.equal(found.cameras.t, wanted.cameras.t)


def test_a_shape_that_fits_the_cameras_has_no_poses(seen: tuple[dp.Camera, dp.Views]) -> None:
    """Where both readings fit, as many views as cameras, the cameras have it."""
    truth, views = seen
    square = dp.Views(views.pixels[:, :2], size=views.size)
    nowhere = truth[:, 0].at(torch.eye(3, dtype=D), torch.tensor([0.0, 0, -1e6], dtype=D))
    found = dp.refine(square, BOARD, nowhere, fixed=("focal", "principal_point", "distortion"))
    assert float(found.rms.max()) < 0.2


def test_poses_of_no_use_are_named(seen: tuple[dp.Camera, dp.Views]) -> None:
    truth, views = seen
    t, R, nan_K = truth.t.clone(), truth.R.clone(), truth.K.clone()
    t[1, 2, 0], R[0, 3] = torch.nan, 1.1 * R[0, 3]
    nan_K[1] = torch.nan
    cases = {
        r"finite poses .* got NaN or infinity for 1 of 8 views, the first 'view 3' of camera 1; .*calibration.camera": (
            dp.Camera.unchecked(truth.K, truth.R, t, truth.distortion, truth.size)
        ),
        r"rotation matrices .* got others for 1 of 8 views, the first 'view 4' of camera 0": (
            dp.Camera.unchecked(truth.K, R, truth.t, truth.distortion, truth.size)
        ),
        "finite intrinsics, got NaN or infinity in camera 1;": dp.Camera.unchecked(
            nan_K, truth.R, truth.t, truth.distortion, truth.size
        ),
        r"broadcasts to \(2,\), or to \(2, 4\) with the poses to start from, got \(3,\)": truth[0, :3],
    }
    for message, camera in cases.items():
        with pytest.raises(ValueError, match=message):
            dp.refine(views, BOARD, camera)
    with pytest.raises(ValueError, match=r"broadcasts to \(2,\), got \(4,\); index it, or take calibration.camera"):
        dp.locate(views, BOARD, truth[0])
    with pytest.raises(ValueError, match="finite intrinsics"):
        dp.locate(views, BOARD, dp.Camera.unchecked(nan_K, R, t, truth.distortion, truth.size)[:, 0])


def test_locate_looks_at_no_pose(seen: tuple[dp.Camera, dp.Views]) -> None:
    truth, views = seen
    nowhere = dp.Camera.unchecked(
        truth.K[:, 0], torch.nan * truth.R[:, 0], torch.nan * truth.t[:, 0], truth.distortion[:, 0], truth.size
    )
    torch.testing.assert_close(dp.locate(views, BOARD, nowhere).cameras.t, truth.t, rtol=2e-3, atol=0.5)


def test_the_pose_of_a_view_without_corners_does_not_matter(seen: tuple[dp.Camera, dp.Views]) -> None:
    truth, views = seen
    hidden = views.visible.clone()
    hidden[0, 1] = False
    t = truth.t.clone()
    t[0, 1] = torch.nan
    start = dp.Camera.unchecked(truth.K, truth.R, t, truth.distortion, truth.size)
    found = dp.refine(dp.Views(views.pixels, hidden, size=views.size), BOARD, start)
    assert found.converged.all()
    assert found.cameras.t.isfinite().all()


# ------------------------------------------------------------------------------------------- another resolution's K


def without_size(views: dp.Views) -> dp.Views:
    return dp.Views(views.pixels, views.visible)


SAYS_MORE = pytest.mark.filterwarnings("ignore::diffproj.calibration.results.mismatch.CameraMismatchWarning")
"""That residuals want other intrinsics is told as well."""


@SAYS_MORE
@pytest.mark.parametrize("factor", [1 / 3, 0.5, 2 / 3, 1.5, 2.0, 3.0])
def test_intrinsics_of_another_resolution_are_warned_of(factor: float) -> None:
    views = dp.example_views("left")
    other = dp.Camera(K * torch.tensor([[factor], [factor], [1.0]], dtype=D))
    with pytest.warns(UserWarning, match=r"camera: its principal point .* photographs of 640 x 480 px, as if"):
        dp.locate(views, BOARD, other, throw=False)
    if factor in (1 / 3, 2.0):  # otherwise corners alone do not tell
        for act in (dp.locate, dp.refine):
            with pytest.warns(UserWarning, match=r"corners from \(\d+, \d+\) to \(\d+, \d+\), as if K were"):
                act(without_size(views), BOARD, other, throw=False)


@SAYS_MORE
@pytest.mark.plain
def test_the_warning_points_at_the_caller() -> None:
    half = dp.Camera(K * torch.tensor([[0.5], [0.5], [1.0]], dtype=D))
    for act in (dp.locate, dp.refine):
        with pytest.warns(UserWarning, match="principal point") as seen:
            act(dp.example_views("left"), BOARD, half, throw=False)
        assert {warning.filename for warning in seen} == {__file__}


@SAYS_MORE
def test_plausible_intrinsics_are_not_taken_for_another_resolutions(seen: tuple[dp.Camera, dp.Views]) -> None:
    truth, views = seen
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dp.locate(views, BOARD, dp.Camera(K, distortion=truth.distortion[0, 0]))
    for off in ((50, -40), (-60, 45)):
        moved = K + torch.tensor([[0.0, 0, off[0]], [0, 0, off[1]], [0, 0, 0]], dtype=D)
        for given in (views, without_size(views)):
            dp.locate(given, BOARD, dp.Camera(moved, distortion=truth.distortion[0, 0]))
    # One view of a board in a corner of the image, part of a photograph, and points of the normalised plane.
    camera = dp.Camera(K)
    corner = camera.at(torch.eye(3, dtype=D), torch.tensor([-300.0, -250, 700], dtype=D))
    alone = synthetic.corner_views(corner.expand(1), dp.Chessboard(5, 4, 20.0))
    dp.locate(alone, dp.Chessboard(5, 4, 20.0), camera)
    part = dp.Views(views.pixels - 200)
    dp.locate(part, BOARD, dp.Camera(camera.cropped(200, 200, 440, 280).K, distortion=truth.distortion[0, 0]))
    xy = truth.directions(views.pixels)[0]
    dp.locate(dp.Views(xy[..., :2] / xy[..., 2:]), BOARD, dp.Camera(torch.eye(3, dtype=D)))


def test_corners_outside_the_cameras_image_are_refused(seen: tuple[dp.Camera, dp.Views]) -> None:
    _, views = seen
    small = dp.Camera(K, size=(640, 480)).resized((320, 240))
    with pytest.raises(ValueError, match="camera: want that of the photographs, got one of 320 x 240 px, and corners"):
        dp.locate(without_size(views), BOARD, small)
