"""The numbers of a chessboard's corners: every one that is seen keeps its own, however many others are hidden."""

import cv2
import numpy as np
import pytest

from diffproj.targets.chessboard import Chessboard
from diffproj.targets.detection import detect
from diffproj.targets.numbering import follow, in_order

SIZES = [(4, 3), (3, 4), (6, 3), (3, 3), (4, 4), (5, 4), (7, 5), (8, 6), (9, 6)]


def upright(board):
    """A board's corners seen from above, far enough from the image's corner."""
    columns, rows = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
    return np.stack([500 + 20.0 * columns - 2 * rows, 400 + 3.0 * columns + 18 * rows], axis=-1)


def orders(grid, board):
    """All in which a detector may return the corners, and whether the first square is dark where that of `grid` is."""
    even = [board.rows % 2 == 0, board.columns % 2 == 0]
    for k in range(8):
        up, left, across = k & 1, k & 2, k & 4
        turned, dark = grid[:: -1 if up else 1, :: -1 if left else 1], (not up or even[0]) == (not left or even[1])
        if not across:
            yield turned, dark
        elif board.rows == board.columns:
            yield turned.swapaxes(0, 1), dark


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("hidden", ["none", "a row in the middle", "a column in the middle", "the first corner"])
def test_each_corner_has_its_number_in_whatever_order_it_was_found(size, hidden):
    board = Chessboard(*size)
    grid = upright(board)
    if hidden == "a row in the middle":
        grid[board.rows // 2] = np.nan
    elif hidden == "a column in the middle":
        grid[:, board.columns // 2] = np.nan
        grid[0, 0] = np.nan
    elif hidden == "the first corner":
        grid[0, 0] = np.nan
    for given, dark in orders(grid, board):
        np.testing.assert_array_equal(in_order(given, dark, board), grid)


@pytest.mark.parametrize("size", SIZES)
def test_a_board_that_begins_light_is_turned_until_it_does_not(size):
    """Where no turn does, as where dark and light of an 8 x 6 board are exchanged, the first corner is at the top."""
    board = Chessboard(*size)
    grid = upright(board)
    found = in_order(grid, False, board)
    turn = 2 if board.turns == 1 else 1 if board.rows == board.columns and board.turns == 2 else 0
    turned = np.rot90(grid, turn), np.rot90(grid, -turn)
    assert any(np.array_equal(found, one) for one in turned)


def shaded(board, inverted, turned, side=40):
    """A board on white, of which the edge of a shadow hides the middle row, and how its corners are numbered."""
    fine = 4
    light = np.indices((board.rows + 1, board.columns + 1)).sum(axis=0) % 2 == int(not inverted)
    image = np.kron(np.where(light, 220.0, 30.0), np.ones((fine * side,) * 2))
    image = np.pad(image, 2 * fine * side, constant_values=220.0)
    v, u = (np.indices(image.shape) + 0.5) / fine
    image *= np.where(v - side * (board.rows // 2 + 3) > 0.05 * (u - u.mean()) - 1, 1.0, 0.3)
    image = cv2.GaussianBlur(image, (0, 0), 0.8 * fine).reshape(len(image) // fine, fine, -1, fine).mean(axis=(1, 3))
    image = np.rint(image + np.random.default_rng(0).normal(0, 1, image.shape)).clip(0, 255).astype(np.uint8)
    corners = np.stack(np.meshgrid(np.arange(board.columns), np.arange(board.rows)), axis=-1) * side + 3.0 * side - 0.5
    if turned:
        image, corners = image[::-1, ::-1].copy(), np.array(image.shape[::-1]) - 1 - corners
    return image, corners[::-1, ::-1] if inverted else corners


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("inverted", [False, True])
def test_a_shadow_along_the_middle_row_leaves_the_others_their_numbers(inverted, turned):
    """No square has four visible corners: the colours are those that each corner shows by itself."""
    board = Chessboard(6, 3)
    image, corners = shaded(board, inverted, turned)
    found = detect(image, board)
    seen = found.visible[0].numpy()
    assert not seen[board.columns + 1 : 2 * board.columns - 1].all()
    assert np.linalg.norm(found.pixels[0].numpy() - corners.reshape(-1, 2), axis=-1)[seen].max() < 0.3


def test_a_sequence_keeps_its_origin_where_a_row_in_the_middle_is_hidden():
    board = Chessboard(5, 3)
    whole = upright(board)
    holes = whole.copy()
    holes[1] = np.nan
    for later in (holes, holes[::-1, ::-1]):
        np.testing.assert_array_equal(follow([whole, later], board)[1], holes)
