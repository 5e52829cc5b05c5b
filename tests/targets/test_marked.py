"""Boards with markers: that they are those of OpenCV and Kalibr, and are found, in whole or in part."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.targets.codes import contradicted
from diffproj.targets.finders import _spacing_of
from tests.targets.boards_in_view import camera_before, errors, photographed

CHARUCO = dp.CharucoBoard(8, 6, square=20.0, marker=15.0, dictionary="4X4_1000")
SMALL = dp.CharucoBoard(7, 5, square=20.0, marker=14.0, dictionary="5X5_100")
LEGACY = dp.CharucoBoard(8, 6, square=20.0, marker=15.0, dictionary="4X4_1000", legacy=True)
APRIL = dp.AprilGrid(5, 4, tag=20.0, spacing=0.3)
REAL = os.environ.get("DIFFPROJ_CHARUCO", "")


def opencv_board(board: dp.CharucoBoard) -> cv2.aruco.CharucoBoard:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary)
    made.setLegacyPattern(board.legacy)
    return made


@pytest.mark.parametrize("board", [CHARUCO, SMALL, LEGACY, dp.CharucoBoard(5, 7, 0.04, 0.03, "DICT_6X6_250")])
def test_a_charuco_board_is_opencvs(board):
    made = opencv_board(board)
    np.testing.assert_allclose(board.points.numpy(), made.getChessboardCorners(), rtol=1e-6)
    for number, quad in zip(made.getIds().ravel().tolist(), made.getObjPoints(), strict=True):
        np.testing.assert_allclose(board.markers[number], np.asarray(quad)[:, :2], rtol=1e-6)


@pytest.mark.parametrize("board", [CHARUCO, SMALL, LEGACY], ids=["4x4", "5x5", "legacy"])
def test_a_charuco_board_that_opencv_drew_is_read(board):
    made = opencv_board(board)
    step = 40
    image = made.generateImage((step * board.columns + 80, step * board.rows + 80), marginSize=40)
    found = dp.detect(cv2.GaussianBlur(image, (0, 0), 1.0), board)
    truth = board.points[:, :2].numpy() / board.square * step + 39.5
    assert bool(found.visible.all())
    assert np.abs(found.pixels[0].numpy() - truth).max() < 0.1


def test_the_print_is_opencvs():
    made = opencv_board(CHARUCO).generateImage((80 * 8, 80 * 6))
    drawn = CHARUCO.artwork.darkness((0.0, 0.0), 0.25, (480, 640))
    assert (np.abs(drawn - (made < 128)) > 0.5).mean() < 0.01  # but for pixels across an edge


def test_an_april_grid_is_counted_as_kalibr_does():
    """The layout that Kalibr's own source draws, for 2 x 2 tags: 0, 1, 2, 3 at the bottom, 4 above 0, 8 above that."""
    board = dp.AprilGrid(2, 2, tag=10.0, spacing=0.3)
    x, y = board.points[:, :2].T.reshape(2, 4, 4)
    assert x[0].tolist() == [0, 10, 13, 23]
    assert y[:, 0].tolist() == [0, 10, 13, 23]
    # OpenCV reads tag 0 at the bottom left, and finds its corner at the bottom right first.
    art = board.artwork
    image = np.uint8(np.rint(255 * (1 - art.darkness((-3.0, -3.0), 0.1, (350, 350)))))
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    quads, numbers, _ = cv2.aruco.ArucoDetector(family, parameters).detectMarkers(image)
    middles = {int(k): quad.reshape(4, 2).mean(0) for k, quad in zip(numbers.ravel(), quads, strict=True)}
    assert sorted(middles) == [0, 1, 2, 3]
    assert middles[1][0] > middles[0][0]
    assert middles[2][1] < middles[0][1]
    found = dp.detect(cv2.GaussianBlur(image, (0, 0), 1.0), board)
    truth = (board.corners + 3) / 0.1 - 0.5
    assert np.abs(found.pixels[0].numpy() - truth).max() < 0.1


@pytest.mark.parametrize(
    ("board", "side"), [(CHARUCO, 20), (SMALL, 20), (LEGACY, 20), (APRIL, 24)], ids=["4x4", "5x5", "legacy", "april"]
)
def test_corners_are_where_they_are(board, side):
    """Measured on better rendered images: 0.012 px for ChArUco, 0.016 to 0.019 px for AprilGrid, both coordinates."""
    every = []
    for seed in range(2):
        camera = camera_before(board, seed, side)
        off, inside = errors(dp.detect(photographed(camera, board, seed), board), camera, board)
        assert len(off) >= inside
        every.append(off)
    off = np.concatenate(every)
    assert np.sqrt((off**2).mean()) < 0.05
    assert off.max() < 0.5


@pytest.mark.parametrize(("board", "side"), [(CHARUCO, 24), (APRIL, 30)], ids=["charuco", "april"])
def test_half_a_board_is_enough(board, side):
    seen = 0
    for seed in range(3):
        camera = camera_before(board, seed + 20, side, whole=False)
        found = dp.detect(photographed(camera, board, seed), board)
        off, inside = errors(found, camera, board)
        assert off.max() < 0.5
        assert len(off) >= 0.9 * inside
        seen += len(off) < len(board)
    assert seen


def test_a_hand_before_the_board_hides_what_it_covers():
    camera = camera_before(CHARUCO, 3, 22)
    image = photographed(camera, CHARUCO)
    truth = camera.project(CHARUCO.points)[0]
    u, v = truth[10].round().int().tolist()
    image[v - 12 : v + 13, u - 12 : u + 13] = 150
    found = dp.detect(image, CHARUCO)
    assert not bool(found.visible[0, 10])
    assert int(found.visible.sum()) > 25
    assert errors(found, camera, CHARUCO)[0].max() < 0.5


@pytest.mark.parametrize("board", [LEGACY, CHARUCO], ids=["legacy", "ordinary"])
def test_the_other_pattern_is_told(board):
    image = photographed(camera_before(board, 1, 22), board)
    other = dp.CharucoBoard(8, 6, 20.0, 15.0, "4X4_1000", legacy=not board.legacy)
    with pytest.raises(dp.BoardNotFoundError, match=f"give legacy={board.legacy}"):
        dp.detect(image, other)


@pytest.mark.parametrize(
    ("board", "exchanged", "told"),
    [
        (SMALL, dp.CharucoBoard(5, 7, 20.0, 14.0, "5X5_100"), "a ChArUco board with 7 x 5 squares, columns first."),
        (
            LEGACY,
            dp.CharucoBoard(6, 8, 20.0, 15.0, "4X4_1000"),
            "a ChArUco board with 8 x 6 squares, columns first, of the legacy pattern: give legacy=True.",
        ),
        (APRIL, dp.AprilGrid(4, 5, tag=20.0, spacing=0.3), "an AprilGrid with 5 x 4 tags, columns first."),
    ],
    ids=["charuco", "legacy", "april"],
)
def test_columns_and_rows_exchanged_are_told(board, exchanged, told):
    image = photographed(camera_before(board, 1, 24), board)
    with pytest.raises(dp.BoardNotFoundError) as caught:
        dp.detect(image, exchanged)
    assert f"There is {told}" in str(caught.value)


def test_another_dictionary_is_not_found():
    image = photographed(camera_before(CHARUCO, 1, 22), CHARUCO)
    with pytest.raises(dp.BoardNotFoundError, match=r"want a ChArUco board with 8 x 6 squares.*dictionary and legacy"):
        dp.detect(image, dp.CharucoBoard(8, 6, 20.0, 15.0, "6X6_250"))
    with pytest.raises(dp.BoardNotFoundError, match=r"AprilGrid with 5 x 4 tags.*36h11"):
        dp.detect(image, APRIL)


@pytest.mark.parametrize("board", [CHARUCO, APRIL], ids=["charuco", "april"])
def test_the_same_camera_as_from_a_chessboard(board):
    """Corners seen with equal noise give the same camera, within deviations."""
    K = torch.tensor([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]], dtype=torch.float64)
    camera = dp.Camera(K, distortion=dp.BrownConrady(torch.tensor([-0.2, 0.05, 0, 0, 0]).double()), size=(640, 480))
    for target in (board, dp.Chessboard(7, 5, 20.0)):
        cameras = dp.synthetic.random_cameras(camera, target, 12, seed=3)
        found = dp.calibrate(dp.synthetic.corner_views(cameras, target, noise_px=0.05, seed=1), target)
        deviations = torch.stack(list(found.covariance.deviations.values())[:4])
        off = (found.shared[:4] - torch.tensor([600.0, 600, 320, 240], dtype=torch.float64)).abs()
        assert bool((off < 4 * deviations).all())


def test_names_and_numbers_that_cannot_be():
    with pytest.raises(ValueError, match=r"dictionary: want one of .*4X4_1000.*, got '4x4'"):
        dp.CharucoBoard(8, 6, 20.0, 15.0, "4x4")
    with pytest.raises(ValueError, match="dictionary: want one of at least 60 markers, .*got 4X4_50 with 50"):
        dp.CharucoBoard(12, 10, 20.0, 15.0, "4X4_50")
    with pytest.raises(ValueError, match="marker: want a side below that of the square, 20, got 20"):
        dp.CharucoBoard(8, 6, 20.0, 20.0, "4X4_50")
    with pytest.raises(ValueError, match="spacing: .* it is a ratio, not a length"):
        dp.AprilGrid(6, 6, 88.0, 26.4)
    with pytest.raises(ValueError, match="rows: want at most 587 tags"):
        dp.AprilGrid(30, 30, 88.0)


@pytest.mark.slow
@pytest.mark.skipif(not REAL, reason="DIFFPROJ_CHARUCO names no folder with PhotonVision's photographs")
@pytest.mark.parametrize(
    ("folder", "legacy", "corners", "rms"),
    [("lifecam_480", False, 790, 0.229), ("lifecam_1280_legacy", True, 584, 0.284)],
)
def test_photographs_of_a_real_board(folder, legacy, corners, rms):
    """At least the corners, and at most the error, of OpenCV 5's own detector. Measured: 811, .134; 631, .276 px."""
    board = dp.CharucoBoard(8, 8, 25.4, 19.05, "4X4_1000", legacy)
    found = dp.detect(Path(REAL) / folder, board)
    calibration = dp.calibrate(found, board)
    assert int(found.visible.sum()) >= corners
    assert float(calibration.rms) <= rms


@pytest.mark.parametrize("legacy", [True, False])
def test_the_other_pattern_is_told_where_it_is_the_same_one_square_further_on(legacy):
    board = dp.CharucoBoard(7, 4, square=20.0, marker=15.0, dictionary="4X4_1000", legacy=legacy)
    photo = photographed(camera_before(board, 3, side_px=28, tilt_deg=20), board)
    camera = camera_before(board, 3, side_px=28, tilt_deg=20)
    assert errors(dp.detect(photo, board), camera, board)[0].max() < 0.2
    other = dp.CharucoBoard(7, 4, 20.0, 15.0, "4X4_1000", legacy=not legacy)
    with pytest.raises(dp.BoardNotFoundError, match=f"give legacy={legacy}"):
        dp.detect(photo, other)


def of_either_pattern(legacy: bool) -> tuple[dp.CharucoBoard, dp.CharucoBoard]:
    """A board whose markers stand alike on the other pattern but for those at the ends of rows, and that other."""
    board, other = (dp.CharucoBoard(7, 4, 20.0, 15.0, "4X4_1000", legacy=kind) for kind in (legacy, not legacy))
    return board, other


def covered(photo: np.ndarray, camera: dp.Camera, places: np.ndarray, radius: float) -> np.ndarray:
    """A photograph with grey discs, their radius in px, before places on a board's plane."""
    points = torch.from_numpy(np.column_stack([places, np.zeros(len(places))]))
    for u, v in camera.project(points)[0].round().int().tolist():
        photo = cv2.circle(photo.copy(), (u, v), round(radius), 128, -1, cv2.LINE_AA)
    return photo


@pytest.mark.parametrize("legacy", [True, False])
def test_the_other_pattern_is_told_where_markers_at_the_ends_of_rows_are_not_read(legacy):
    """By the corners of the column that only the true one has; their markers were the only ones to tell it before."""
    board, other = of_either_pattern(legacy)
    camera = camera_before(board, 3, side_px=28, tilt_deg=20)
    ends = [quad.mean(axis=0) for number, quad in board.markers.items() if number % 7 == 3]
    photo = covered(photographed(camera, board), camera, np.array(ends), 7)
    found = dp.detect(photo, board)
    assert bool(found.visible.all())
    assert errors(found, camera, board)[0].max() < 0.2
    with pytest.raises(dp.BoardNotFoundError, match=f"one of the .* pattern: give legacy={legacy}"):
        dp.detect(photo, other)


@pytest.mark.parametrize("legacy", [True, False])
def test_where_its_own_end_is_covered_a_board_may_be_of_either_pattern(legacy):
    """It is refused. Where that end is out of view, it is the pattern that was asked for."""
    board, other = of_either_pattern(legacy)
    K = torch.tensor([[500.0, 0, 159.5], [0, 500.0, 119.5], [0, 0, 1]], dtype=torch.float64)
    t = torch.tensor([-70.0, -40.0, 280.0], dtype=torch.float64)
    camera = dp.Camera(K, size=(320, 240)).at(torch.eye(3, dtype=torch.float64), t)
    photo = photographed(camera, board)
    column = 6 if legacy else 1
    hand = np.array([[column * 20.0 + step, 10.0 * row] for row in range(9) for step in (-5, 5, 15)])
    hand = covered(photo, camera, hand if legacy else hand - [10, 0], 18)
    for asked in (board, other):
        with pytest.raises(dp.BoardNotFoundError, match=r"may as well be of the (legacy|ordinary) pattern"):
            dp.detect(hand, asked)
    cut = photo[:, :235] if legacy else photo[:, 85:]
    found = dp.detect(cut, board)
    assert not found.visible[0].reshape(3, 6)[:, -1 if legacy else 0].any()
    truth = camera.project(board.points)[0] - torch.tensor([0 if legacy else 85, 0])
    assert float((found.pixels[0] - truth)[found.visible[0]].norm(dim=-1).max()) < 0.2


def test_markers_that_are_not_read_have_their_own_codes_where_corners_were_found():
    """Of a grid of 5 x 4 tags, the first 4 columns have the corners of one of 4 x 4, and other tags."""
    camera = camera_before(APRIL, 0, 24)
    image = photographed(camera, APRIL)
    corners = camera.project(APRIL.points)[0].numpy()
    narrow = dp.AprilGrid(4, 4, tag=20.0, spacing=0.3)
    assert not contradicted(image, APRIL, 2, corners)
    assert contradicted(image, narrow, 2, corners.reshape(8, 10, 2)[:, :8].reshape(-1, 2))
    nothing = np.full_like(corners, np.nan)
    assert not contradicted(image, APRIL, 2, nothing)
    ordinary = photographed(camera_before(CHARUCO, 3, 22), CHARUCO)
    corners = camera_before(CHARUCO, 3, 22).project(CHARUCO.points)[0].numpy()
    assert not contradicted(ordinary, CHARUCO, 1, corners)
    assert contradicted(ordinary, LEGACY, 1, corners)


@pytest.mark.parametrize(("given", "true"), [(0.2, 0.3), (0.5, 0.3), (0.3, 0.2), (0.25, 0.3), (0.27, 0.3), (0.33, 0.3)])
def test_another_spacing_of_tags_is_told(given, true):
    board = dp.AprilGrid(4, 3, tag=20.0, spacing=true)
    photo = photographed(camera_before(board, 1, side_px=40, tilt_deg=20), board)
    assert dp.detect(photo, board).visible.sum() > 30
    with pytest.raises(dp.BoardNotFoundError, match=rf"give spacing={true:.2f}|found none"):
        dp.detect(photo, dp.AprilGrid(4, 3, tag=20.0, spacing=given))


def test_perspective_makes_no_other_spacing():
    """Close to a tilted board sides and gaps shrink along it; their ratio, which was taken, says another spacing."""
    board = dp.AprilGrid(3, 2, tag=20.0, spacing=0.3)
    K = torch.tensor([[300.0, 0, 640], [0, 300, 480], [0, 0, 1]], dtype=torch.float64)
    for turn in (0.0, 0.8, 2.0):
        R = dp.rotation_from_euler(*torch.tensor([0.9, 0.3, turn], dtype=torch.float64))
        t = torch.tensor([0.0, 0, 90], dtype=torch.float64) - R @ board.points.mean(0)
        pixels, valid = dp.Camera(K, R, t).project(board.points)
        assert bool(valid.all())
        assert _spacing_of(pixels.reshape(4, 6, 2).numpy()) == pytest.approx(0.3, abs=1e-9)


@pytest.mark.parametrize(
    "board",
    [dp.CharucoBoard(3, 3, square=20.0, marker=15.0, dictionary="4X4_50"), dp.AprilGrid(1, 1, tag=20.0, spacing=0.3)],
    ids=["charuco", "april"],
)
def test_the_smallest_board_is_found(board):
    """An AprilGrid of one tag was accepted and printed, and never found."""
    camera = camera_before(board, 2, side_px=40, tilt_deg=20)
    found = dp.detect(photographed(camera, board), board)
    assert int(found.visible.sum()) == 4
    assert errors(found, camera, board)[0].max() < 0.1


def test_what_is_not_found_has_its_article():
    for board, words in (
        (dp.AprilGrid(6, 6, 22.0, 0.3), "an AprilGrid"),
        (dp.CircleGrid(4, 11, 20.0, 9.0, True), "an asym"),
    ):
        with pytest.raises(dp.BoardNotFoundError, match=f"photographs: want {words}"):
            dp.detect(np.zeros((60, 80), np.uint8), board)
