"""A board that is seen more than once in a photograph: the larger is taken, and it is said."""

import warnings

import numpy as np
import pytest

import diffproj as dp
from tests.targets.boards_in_view import SIZE, camera_before, photographed

# With the pixels of a side of the larger and the smaller board.
BOARDS = {
    "chessboard": (dp.Chessboard(7, 5, 20.0), 24, 18),
    "ChArUco": (dp.CharucoBoard(5, 4, square=20.0, marker=15.0, dictionary="4X4_1000"), 40, 32),
    "AprilGrid": (dp.AprilGrid(3, 2, tag=20.0, spacing=0.3), 52, 40),
    "circles": (dp.CircleGrid(7, 5, spacing=20.0, diameter=11.0), 24, 18),
    "asymmetric circles": (dp.CircleGrid(3, 9, spacing=14.0, diameter=11.0, asymmetric=True), 15, 12),
}


def side_by_side(board, sizes, seeds=(7, 8)):
    """A photograph of a board at the left, and of its double at the right, each with so many pixels for a side."""
    cameras = [camera_before(board, seed, side, tilt_deg=15) for seed, side in zip(seeds, sizes, strict=True)]
    return np.hstack([photographed(camera, board) for camera in cameras])


@pytest.mark.parametrize("kind", BOARDS)
@pytest.mark.parametrize("larger_is_left", [True, False])
def test_of_two_boards_the_larger_is_taken_and_it_is_said(kind, larger_is_left):
    board, large, small = BOARDS[kind]
    image = side_by_side(board, (large, small) if larger_is_left else (small, large))
    with pytest.warns(
        UserWarning, match=r"image 1: the .* is seen more than once; .* covers most .*: cover the others"
    ):
        views = dp.detect(image, board)
    assert views.visible[0].float().mean() > 0.8
    column = views.pixels[0, views.visible[0], 0]
    assert bool(((column < SIZE[0]) == larger_is_left).all())


def test_all_photographs_are_named_by_one_warning():
    board, large, small = BOARDS["chessboard"]
    twice, once = side_by_side(board, (large, small)), side_by_side(board, (large, small))
    once[:, SIZE[0] :] = 128
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        dp.detect([twice, once, twice], board)
    (one,) = told
    assert str(one.message).startswith("image 1, image 3: the board with 7 x 5 inner corners is seen more than once")
    assert "another number of squares" in str(one.message)


@pytest.mark.parametrize("kind", ["chessboard", "circles"])
def test_a_part_of_a_second_board_is_none(kind):
    """No more than a part of the pattern: as much of it alone would not be found."""
    board, large, small = BOARDS[kind]
    image = side_by_side(board, (large, small))
    image[:, SIZE[0] + SIZE[0] // 2 :] = 128
    assert dp.detect(image, board).visible.all()


def test_another_board_is_no_repetition():
    board, large, small = BOARDS["chessboard"]
    other = dp.Chessboard(6, 4, 20.0)
    shown = [
        photographed(camera_before(one, 7, side, tilt_deg=15), one) for one, side in ((board, large), (other, small))
    ]
    assert dp.detect(np.hstack(shown), board).visible.all()


def test_a_double_that_a_small_copy_shows_in_part_is_seen():
    """The larger board is found in a copy of half the size, in which the other has squares of 5 px and falls apart."""
    board, large, _ = BOARDS["chessboard"]
    with pytest.warns(UserWarning, match="seen more than once"):
        views = dp.detect(side_by_side(board, (large, 10)), board)
    assert bool((views.pixels[..., 0] < SIZE[0]).all())
