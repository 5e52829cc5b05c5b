"""`Chessboard`: where the corners lie, in both frames, worked out by hand."""

import dataclasses

import numpy as np
import pytest
import torch

from diffproj.targets.chessboard import Chessboard


def test_opencv_frame_by_hand():
    """x to the right along a row, y down, z = 0."""
    board = Chessboard(columns=3, rows=2, square=10.0)
    expected = [[0, 0, 0], [10, 0, 0], [20, 0, 0], [0, 10, 0], [10, 10, 0], [20, 10, 0]]
    assert board.points.dtype == torch.float64
    assert board.points.tolist() == expected


def test_paper_frame_by_hand():
    """x from the top left corner down, y from there to the right, the same order of corners."""
    board = Chessboard(columns=3, rows=2, square=10.0, axes="paper")
    assert board.points.tolist() == [[0, 0, 0], [0, 10, 0], [0, 20, 0], [10, 0, 0], [10, 10, 0], [10, 20, 0]]


@pytest.mark.parametrize("part", ["points", "outline"])
def test_the_frames_differ_by_a_rotation(part):
    """Corner by corner, paper = Q opencv with a proper rotation Q: both right-handed, z into and out of the board."""
    Q = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]], dtype=torch.float64)
    assert torch.linalg.det(Q) == pytest.approx(1)
    opencv, paper = (getattr(Chessboard(axes=axes), part) for axes in ("opencv", "paper"))
    torch.testing.assert_close(opencv @ Q.T, paper, rtol=0, atol=0)


def test_default_is_the_papers_board():
    board = Chessboard()
    assert (board.columns, board.rows, board.square, board.axes) == (9, 6, 25.0, "opencv")
    assert (board.size, len(board), board.points.shape) == ((9, 6), 54, (54, 3))
    assert board.points.amax(dim=0).tolist() == [200.0, 125.0, 0.0]
    assert repr(board) == "Chessboard(columns=9, rows=6, square=25.0, axes='opencv')"


def test_outline_is_one_square_beyond():
    """Clockwise as seen on the upright board, from the top left."""
    board = Chessboard(columns=3, rows=2, square=10.0)
    assert board.outline.tolist() == [[-10, -10, 0], [30, -10, 0], [30, 20, 0], [-10, 20, 0]]


def test_points_are_fresh():
    """A caller that writes into the points spoils nobody else's."""
    board = Chessboard()
    board.points.fill_(7.0)
    assert board.points.sum() != 7.0 * board.points.numel()


def test_a_board_is_a_value():
    assert Chessboard() == Chessboard(9, 6, 25.0)
    assert Chessboard() != Chessboard(axes="paper")
    assert len({Chessboard(), Chessboard()}) == 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        Chessboard().rows = 7


@pytest.mark.plain  # checks of types at run time refuse what duck typing takes
def test_numpy_numbers_become_plain_ones():
    board = Chessboard(columns=np.int64(5), rows=np.int32(4), square=np.float32(2.5))
    assert repr(board) == "Chessboard(columns=5, rows=4, square=2.5, axes='opencv')"


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"columns": 1}, ValueError, "columns: want at least 2 .*, got 1"),
        ({"rows": 0}, ValueError, "rows: want at least 2 .*, got 0"),
        ({"rows": -6}, ValueError, "rows: .*got -6"),
        ({"columns": 9.0}, TypeError, "columns"),
        ({"columns": "9"}, TypeError, "columns"),
        ({"rows": True}, TypeError, "rows"),
        ({"square": 0.0}, ValueError, "square: want a positive, finite side, got 0.0"),
        ({"square": -25.0}, ValueError, "square: .*got -25.0"),
        ({"square": float("nan")}, ValueError, "square: .*got nan"),
        ({"square": float("inf")}, ValueError, "square: .*got inf"),
        ({"square": "wide"}, TypeError, "square"),
        ({"square": None}, TypeError, "square"),
        ({"axes": "left"}, ValueError, "axes: want one of 'opencv', 'paper', got 'left'"),
        ({"axes": None}, (TypeError, ValueError), "axes"),
    ],
)
def test_mistakes_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        Chessboard(**arguments)
