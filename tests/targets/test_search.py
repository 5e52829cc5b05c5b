"""The search for boards: what it finds, what it finds out about other boards, and that it does not invent."""

import time

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.targets import search
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.detection import BoardNotFoundError, BoardNotFoundWarning, detect
from diffproj.targets.lattice import as_grid, lattices
from diffproj.targets.numbering import follow
from diffproj.targets.saddles import Saddles, saddle_points
from diffproj.targets.search import Pattern, extent_of, find_pattern, matched
from diffproj.targets.synthetic import photograph

D = torch.float64


def scene(board, side, tilt=(0.3, -0.2, 0.1), lens=0.0, size=None, shift=(0.0, 0.0)):
    """A camera before the middle of a board of unit squares, each `side` px."""
    focal = 500.0
    size = size or (int(side * (board.columns + 5)), int(side * (board.rows + 5)))
    K = torch.tensor([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]], dtype=D)
    R = dp.rotation_from_euler(*torch.tensor(tilt, dtype=D))
    t = torch.tensor([*shift, focal / side], dtype=D) - R @ board.points.mean(0)
    return dp.Camera(K, distortion=dp.BrownConrady(torch.tensor([lens, 0, 0, 0, 0], dtype=D)), size=size).at(R, t)


def seen(board, camera, **options):
    """A rendered photograph and the true corners."""
    return photograph(camera, board, **options).numpy(), camera.project(board.points)[0].numpy()


@pytest.mark.parametrize(("size", "side"), [((9, 6), 8), ((5, 4), 14), ((3, 3), 30), ((11, 5), 10), ((4, 8), 8)])
def test_every_board_is_found_dark_and_light_exchanged_too(size, side):
    """Corners of the rough pattern are within a third of a square; blurred by a tenth of one, and noisy."""
    board = Chessboard(*size, 1.0)
    image, corners = seen(board, scene(board, side, lens=-0.15), blur_px=0.1 * side, noise=8 / 255)
    for shown in (image, 255 - image):
        grid = find_pattern(shown, board).grid
        assert grid is not None
        distance = np.linalg.norm(grid.reshape(-1, 1, 2) - corners, axis=-1)
        assert sorted(distance.argmin(axis=1)) == list(range(len(board)))
        assert distance.min(axis=1).max() < side / 3


@pytest.mark.slow
def test_a_strongly_bent_board():
    """A lens that moves the outermost corners by more than a square."""
    board = Chessboard(9, 6, 1.0)
    image, corners = seen(board, scene(board, 50, lens=-0.35, tilt=(0.5, 0.4, 0.3), size=(640, 480)))
    assert np.linalg.norm(detect(image, board).pixels[0].numpy() - corners, axis=-1).max() < 0.1


@pytest.mark.slow
def test_a_small_board_in_a_large_photograph_and_a_large_one():
    board = Chessboard(9, 6, 1.0)
    small, corners = seen(board, scene(board, 9, tilt=(0.2, 0.1, 0.0)))
    image = np.full((2000, 2600), 140, np.uint8)
    image[900 : 900 + small.shape[0], 1700 : 1700 + small.shape[1]] = small
    found = detect(image, board).pixels[0].numpy() - (1700, 900)
    assert np.linalg.norm(found - corners, axis=-1).max() < 0.2
    image, corners = seen(board, scene(board, 150, size=(2600, 2000)), blur_px=3.0)
    assert np.linalg.norm(detect(image, board).pixels[0].numpy() - corners, axis=-1).max() < 0.15


def straight(columns, rows, side, margin=None):
    """A board seen frontally, slightly blurred, on white, and its corners by row and column."""
    margin = side if margin is None else margin
    inside = np.kron(np.indices((rows + 1, columns + 1)).sum(axis=0) % 2, np.ones((side, side))) * 200 + 20
    image = np.pad(inside, margin, constant_values=230).astype(np.uint8)
    across, down = (margin + side * np.arange(1, count + 1) - 0.5 for count in (columns, rows))
    return cv2.GaussianBlur(image, (0, 0), 0.8), np.stack(np.meshgrid(across, down), axis=-1)


def off_grid(found, corners):
    """The farthest that a found corner is from the true one, in whichever order the board was found."""
    turns = (corners, corners[::-1], corners[:, ::-1], corners[::-1, ::-1])
    return min(float(np.nanmax(np.linalg.norm(found - turn, axis=-1))) for turn in turns)


def test_a_board_in_a_photograph_of_any_size():
    """Small squares in a small photograph show in a larger copy of it, and in a large one in a larger copy than most."""
    image, corners = straight(9, 6, 7)
    found = find_pattern(image, Chessboard(9, 6)).grid
    assert found is not None
    assert off_grid(found, corners) < 7 / 3
    image, corners = straight(9, 6, 8)
    large = np.full((1700, 2600), 230, np.uint8)
    large[1000 : 1000 + image.shape[0], 1500 : 1500 + image.shape[1]] = image
    found = find_pattern(large, Chessboard(9, 6)).grid
    assert found is not None
    assert off_grid(found - (1500, 1000), corners) < 8 / 3


@pytest.mark.parametrize("shape", [(12, 200), (200, 15), (1, 1)])
def test_a_strip_has_no_room_for_a_board(shape):
    assert find_pattern(np.zeros(shape, np.uint8), Chessboard(9, 6)) == Pattern(None, (0, 0))


def test_cloth_is_no_board():
    """A pattern as fine as a screen's or a fabric's is not even told as another board."""
    image, _ = straight(40, 30, 4, margin=60)
    assert find_pattern(image, Chessboard(9, 6)) == Pattern(None, (0, 0))


def test_a_small_print_beside_a_larger_board_is_none():
    """Where a larger board is in view, what looks like the one asked for is likely a part of another print."""
    image, _ = straight(12, 9, 40)
    small, _ = straight(5, 4, 10)
    image = np.pad(image, ((0, 0), (0, 200)), constant_values=230)
    image[200 : 200 + small.shape[0], -150 : -150 + small.shape[1]] = small
    found = find_pattern(image, Chessboard(5, 4))
    assert found.grid is None
    assert found.seen == (12, 9)


def with_holes(monkeypatch):
    """Every third corner escapes the search."""
    whole = search.lattices

    def lattices(saddles):
        for cells in whole(saddles):
            yield {cell: number for cell, number in cells.items() if sum(cell) % 3}

    monkeypatch.setattr(search, "lattices", lattices)


@pytest.mark.parametrize(("inverted", "margin"), [(False, 25), (True, 25), (False, 3)])
def test_where_a_part_is_found_other_detectors_are_asked(monkeypatch, inverted, margin):
    """Dark and light exchanged as well, and without the white margin that the first of them needs."""
    with_holes(monkeypatch)
    image, corners = straight(9, 6, 25, margin=margin)
    found = find_pattern(255 - image if inverted else image, Chessboard(9, 6)).grid
    assert found is not None
    assert np.isfinite(found).all()
    assert off_grid(found, corners) < 25 / 3


def test_where_no_detector_finds_the_board_the_part_is_told(monkeypatch):
    with_holes(monkeypatch)
    image, _ = straight(9, 6, 25)
    monkeypatch.setattr(cv2, "findChessboardCorners", lambda *_: (False, None))
    monkeypatch.setattr(cv2, "findChessboardCornersSB", lambda *_, flags: (False, None))
    assert find_pattern(image, Chessboard(9, 6)) == Pattern(None, (9, 6))


# --------------------------------------------------------------------------------------------- where no board is


def walls():
    rng = np.random.default_rng(0)
    row, column = np.indices((1500, 2000))
    brick = np.where((row % 40 < 4) | ((column + 40 * (row // 40 % 2)) % 80 < 4), 190, 110)
    yield "dim wall", np.linspace(0, 200, 2000)[None] + rng.normal(0, 8, (1500, 2000))
    yield "noise", rng.integers(0, 256, (1500, 2000))
    yield "brick", brick + rng.normal(0, 8, brick.shape)
    leaves = sum(
        cv2.resize(rng.normal(0, 40, (1500 // s, 2000 // s)).astype(np.float32), (2000, 1500)) for s in (4, 9, 25)
    )
    yield "foliage", 120 + leaves
    text = np.full((1500, 2000), 230, np.uint8)
    for line in range(20, 1500, 30):
        words = "".join(rng.choice(list("abcdefgHIKLMXxX#+ "), 110))
        cv2.putText(text, words, (10, line), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 30, 2)
    yield "text", text


def test_nothing_is_found_where_nothing_is_and_soon():
    """3 megapixels each: 0.1 to 0.4 s were measured; the classic detector alone takes minutes for some."""
    for name, image in walls():
        image = np.clip(image, 0, 255).astype(np.uint8)
        began = time.process_time()
        assert find_pattern(image, Chessboard(9, 6)).grid is None, name
        assert time.process_time() - began < 2.0, name


# ------------------------------------------------------------------------------------------------ another board


@pytest.mark.parametrize("asked", [(7, 6), (9, 5), (10, 7)])
def test_another_board_is_refused_by_its_name(asked):
    """A pattern that goes on beyond the outer corners, or ends within them, is another board."""
    board = Chessboard(9, 6, 1.0)
    image, _ = seen(board, scene(board, 20))
    with pytest.raises(BoardNotFoundError, match=r"pattern with 9 x 6 inner corners in 1 of them: .*Chessboard\(9, 6"):
        detect(image, Chessboard(*asked))
    other, _ = seen(Chessboard(*asked, 1.0), scene(Chessboard(*asked, 1.0), 20, size=image.shape[::-1]))
    with pytest.warns(BoardNotFoundWarning, match=r"image 1: found no board .*, but a pattern with 9 x 6; .*skipped"):
        assert len(detect([image, other], Chessboard(*asked))) == 1


def test_what_stands_beside_a_board_by_chance_is_no_part_of_it():
    grid = np.stack(np.meshgrid(np.arange(10.0), np.arange(7.0)), axis=-1)
    grid[:5, 9] = grid[0] = np.nan
    grid[0, 3] = 3.0, 0.0
    found = matched(grid, Chessboard(9, 6))
    assert found is not None
    assert np.array_equal(found, grid[1:, :9])
    assert extent_of(grid) == (9, 6)
    grid[:, 9] = grid[:, 8] + (1, 0)
    assert matched(grid, Chessboard(9, 6)) is None


def test_a_board_without_one_of_its_sides_is_none_and_one_with_holes_is():
    """Where a whole side is hidden, nothing says where the board ends; rows and columns may be exchanged."""
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1)
    holes = grid.copy()
    holes[2:4, 3:6] = np.nan
    turned = matched(holes.swapaxes(0, 1), Chessboard(9, 6))
    assert turned is not None
    assert np.array_equal(turned, holes, equal_nan=True)
    grid[5, 3:] = np.nan
    assert matched(grid, Chessboard(9, 6)) is None
    assert extent_of(grid) == (9, 5)
    assert matched(grid[:5], Chessboard(6, 6)) is None
    assert extent_of(np.full((4, 4, 2), np.nan)) == (0, 0)


def test_patterns_of_a_chessboard_are_one_pattern():
    board = Chessboard(9, 6, 1.0)
    saddles = saddle_points(seen(board, scene(board, 20))[0])
    (cells,) = lattices(saddles)
    assert sorted(as_grid(cells, saddles.points).shape) == [2, 6, 9]


def test_a_pattern_is_numbered_along_its_columns_from_a_point_at_its_edge_too():
    """Below the board stands a saddle point by chance, midway across from one of the row above but two columns on."""
    row, column = (np.append(place.ravel(), more) for place, more in zip(np.indices((6, 8)), (6, -1), strict=True))
    order = np.lexsort((column, row, (row != 5) | (column != 1)))  # the pattern starts at the last row
    points = np.stack([20.0 * column, 21.0 * row], axis=-1)[order].astype(np.float32) + 100
    phases = np.stack([1.0 - 2 * ((row + column) % 2), 0 * row], axis=-1)[order].astype(np.float32)
    (cells,) = lattices(Saddles(points, phases))
    assert as_grid(cells, points).shape == (6, 8, 2)


# ------------------------------------------------------------------------------------------- boards that look alike


@pytest.mark.parametrize(
    ("size", "roll"),
    [
        ((7, 5), 70),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (((8, 6), 70), ((7, 7), 70), ((6, 6), 30))),
    ],
)
def test_a_sequence_keeps_its_origin(size, roll):
    """The board rolls all the way round, step by step: every corner keeps its number."""
    board = Chessboard(*size, 1.0)
    angles = np.radians(np.arange(0, 361, roll))
    cameras = [scene(board, 20, tilt=(0.1, 0.1, float(angle)), size=(300, 300)) for angle in angles]
    images, corners = zip(*(seen(board, camera) for camera in cameras), strict=True)
    found = detect(list(images), board).pixels.numpy()
    turns = [np.rot90(corners[0].reshape(board.rows, board.columns, 2), k) for k in range(4)]
    (first,) = [k for k, turn in enumerate(turns) if np.abs(turn.reshape(-1, 2) - found[0]).max() < 0.5]
    for pixels, truth in zip(found, corners, strict=True):
        turned = np.rot90(truth.reshape(board.rows, board.columns, 2), first).reshape(-1, 2)
        assert np.abs(pixels - turned).max() < 0.5


def test_boards_with_one_origin_are_left_alone():
    grids = [np.zeros((6, 9, 2)), np.ones((6, 9, 2))]
    assert follow(grids, Chessboard(9, 6)) is grids


@pytest.mark.plain  # checks of types at run time stand between caller and function
def test_locate_says_that_the_origin_is_open():
    board = Chessboard(8, 6, 1.0)
    camera = scene(board, 20)
    views = dp.Views(camera.project(board.points)[0][None], size=camera.size)
    with pytest.warns(UserWarning, match="looks the same when turned by 180 degrees"):
        dp.locate(views, board, camera)
