"""Detect a chessboard's corners in photographs, with sub-pixel accuracy and in a defined order."""

import warnings
from collections.abc import Callable, Iterable

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Shaped, UInt8

from diffproj._core.arguments import function
from diffproj.targets.chessboard import Chessboard, as_board
from diffproj.targets.images import Photograph, Source, as_8_bit, grey, listed
from diffproj.targets.views import Views

WINDOW = 0.30
"""Half the side of a corner's sub-pixel window, relative to the distance to its nearest neighbour."""

SMALLEST_WINDOW = 2
"""Minimum half side in px: a smaller window contains too few gradients for a stable result."""

LARGE = 1600
"""Longer side in px above which detection that fails is repeated at half the size."""

SMALLEST = 16
"""Shorter side in px of an image that is searched: less has no room for four squares, and OpenCV refuses it."""

_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)


class BoardNotFoundWarning(UserWarning):
    """A photograph was skipped because no board was found in it.

    Example:
        Where no photograph may be skipped, turn it into an error.

        >>> with warnings.catch_warnings():
        ...     warnings.simplefilter("error", BoardNotFoundWarning)  # ... and detect(...) here
    """


class BoardNotFoundError(ValueError):
    """No board was found in any of the photographs.

    Example:
        >>> try:
        ...     detect(np.zeros((480, 640), dtype=np.uint8), Chessboard())
        ... except BoardNotFoundError as error:
        ...     print(str(error)[:65])
        photographs: want a board with 9 x 6 inner corners, found none in
    """


def detect(
    photographs: Source | Iterable[Source],
    board: Chessboard,
    progress: Callable[[int, int], object] | None = None,
) -> Views:
    """Detect the board's inner corners in photographs of one camera.

    The corners come from OpenCV's `findChessboardCorners` and are refined with sub-pixel accuracy (`cv2.cornerSubPix`)
    in a window that scales with the board's image: half its side is 0.30 of the distance to the corner's nearest
    neighbour. A window of fixed size either includes neighbouring corners or gives away precision. If detection fails
    in a photograph of more than 1600 px on its longer side, it is repeated at half the size, and so on; refinement
    always uses the full size. Files are read as `cv2.imread` reads them.

    The order is that of `Chessboard.points`, whatever the detector returned. It is never mirrored: along a row, then
    down a column, is clockwise in the image. It starts at a dark corner of the board: the square between the first four
    corners is dark, and so is the one diagonally outside the first corner. Where columns + rows is odd, as on a 9 x 6
    board, this determines the order: each corner keeps its number however the board is rotated. Otherwise, of the
    remaining orders, that whose first corner is closest to the photograph's top left is chosen.

    Args:
        photographs: a file, a folder, a pattern such as `"photos/left*.jpg"`, one image, or a list of files and
            images. An image is an array as OpenCV has it, `(H, W)`, `(H, W, 1)`, `(H, W, 3)` in BGR or `(H, W, 4)` in
            BGRA, of 8-bit or 16-bit integers (16 bits: contrast-stretched) or floats from 0 to 1; or a tensor as
            Kornia has it, `(C, H, W)` in RGB, of the same types, or `(B, C, H, W)`. All of one size.
        board: the board to look for, with at least 3 x 3 inner corners.
        progress: called with `(done, total)` after each photograph.

    Returns:
        The views in which the board was found, in float64 pixels, named by their files (`"image 1"`, ... for arrays).
        Photographs without it are left out, each with a `BoardNotFoundWarning` that names it.

    Raises:
        BoardNotFoundError: no photograph shows the board.
        FileNotFoundError: a file is missing.
        ValueError: a file is no image, an image has none of the layouts above, sizes differ, or the board has fewer
            than 3 x 3 inner corners. All files are checked before the first is searched.
        TypeError: an argument is of the wrong kind.

    Example:
        >>> squares = np.indices((7, 10)).sum(axis=0) % 2  # dark at the top left
        >>> image = np.full((340, 460), 255, dtype=np.uint8)
        >>> image[30:310, 30:430] = np.kron(squares, np.ones((40, 40))) * 255
        >>> views = detect(image, Chessboard(columns=9, rows=6))
        >>> views
        Views(1 view of 54 corners, 460 x 340 px, torch.float64)
        >>> views.pixels[0, :2].round().tolist()  # each edge is half a pixel before its first pixel
        [[70.0, 70.0], [110.0, 70.0]]
    """
    _check_board(board)
    if progress is not None:
        function("progress", progress, "a function of (done, total)")
    listing = listed(photographs)
    size = _common_size(listing)
    corners = []
    for done, photograph in enumerate(listing, start=1):
        corners.append(find_corners(grey(photograph), board))
        if progress is not None:
            progress(done, len(listing))
    seen = [(photograph.name, c) for photograph, c in zip(listing, corners, strict=True) if c is not None]
    missed = [photograph.label for photograph, c in zip(listing, corners, strict=True) if c is None]
    if not seen:
        raise BoardNotFoundError(_advice(missed, board))
    for label in missed:
        text = f"{label}: found no board with {board.columns} x {board.rows} inner corners; photograph skipped"
        warnings.warn(text, BoardNotFoundWarning, stacklevel=2)
    return Views(torch.from_numpy(np.stack([c for _, c in seen])), names=[name for name, _ in seen], size=size)


def find_corners(image: Shaped[np.ndarray, "h w"], board: Chessboard) -> Float[np.ndarray, "n 2"] | None:
    """The board's corners in one grey image, refined and in order: `(N, 2)` px in float64; None if not found.

    Args:
        image: `(H, W)`, from 0 to 255, uint8 or float32.
        board: the board to look for.
    """
    rough = _rough_corners(as_8_bit(image), board)
    if rough is None:
        return None
    return in_order(refine_corners(image, rough).astype(np.float64), image, board)


def _rough_corners(image: UInt8[np.ndarray, "h w"], board: Chessboard) -> Float32[np.ndarray, "n 2"] | None:
    """OpenCV's detector; where it fails on a large photograph, again at half the size, and so on."""
    if min(image.shape) < SMALLEST:
        return None
    found, corners = cv2.findChessboardCorners(image, board.size)
    if found:
        return corners.reshape(-1, 2)  # OpenCV 4 gives (N, 1, 2), OpenCV 5 (N, 2)
    height, width = image.shape
    if max(height, width) <= LARGE:
        return None
    small = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    corners = _rough_corners(small, board)
    if corners is None:
        return None
    scale = np.array([width / (width // 2), height / (height // 2)], dtype=np.float32)
    return scale * corners + (scale - 1) / 2


def refine_corners(image: Shaped[np.ndarray, "h w"], corners: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 2"]:
    """Refine corners with sub-pixel accuracy, each in a window of its own size.

    Args:
        image: `(H, W)`, uint8 or float32.
        corners: `(N, 2)` px, float32, each within half a square of its true position.
    """
    half_sides = np.maximum(WINDOW * nearest_distance(corners), SMALLEST_WINDOW).astype(int)
    refined = corners.copy()
    for half_side in np.unique(half_sides):
        group = half_sides == half_side
        window = (int(half_side), int(half_side))
        start = np.ascontiguousarray(corners[group]).reshape(-1, 1, 2)
        refined[group] = cv2.cornerSubPix(image, start, window, (-1, -1), _STOP).reshape(-1, 2)
    return refined


def nearest_distance(corners: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """The distance from each corner `(N, 2)` to the nearest other one, `(N,)` px."""
    distance = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    return distance.min(axis=1)


def in_order(
    corners: Float[np.ndarray, "n 2"], image: Shaped[np.ndarray, "h w"], board: Chessboard
) -> Float[np.ndarray, "n 2"]:
    """Sort corners into the order of `Chessboard.points`; see `detect` for the rule.

    Args:
        corners: `(N, 2)` px, row by row in any of the orders that a detector may return.
        image: `(H, W)`, the grey image.
        board: the board; boards with rows = columns may be rotated by 90 degrees, others by 180.
    """
    grid = corners.reshape(board.rows, board.columns, 2)
    grids = [grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1]]
    if board.rows == board.columns:
        grids += [candidate.swapaxes(0, 1) for candidate in grids]
    grids = [candidate for candidate in grids if _turns_clockwise(candidate)] or [grid]
    grids = [candidate for candidate in grids if _starts_dark(candidate, image)] or grids
    first = min(grids, key=lambda candidate: np.linalg.norm(candidate[0, 0]))
    return np.ascontiguousarray(first).reshape(-1, 2)


def _turns_clockwise(grid: Float[np.ndarray, "rows columns 2"]) -> bool:
    """Whether top left, top right, bottom right, bottom left are clockwise in the image (v points down)."""
    u, v = np.stack([grid[0, 0], grid[0, -1], grid[-1, -1], grid[-1, 0]]).T
    return float(np.sum(u * np.roll(v, -1) - v * np.roll(u, -1))) > 0


def _starts_dark(grid: Float[np.ndarray, "rows columns 2"], image: Shaped[np.ndarray, "h w"]) -> bool:
    """Whether the square between the first four corners is one of the dark ones.

    Decided by the mean of all squares between corners, which is robust to noise and uneven illumination; squares
    outside the corners are not used, since the image's border may cut them off.
    """
    squares = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    u, v = np.rint(squares).astype(int).T
    height, width = image.shape
    values = image[v.clip(0, height - 1), u.clip(0, width - 1)].T.astype(float)
    same = np.indices(values.shape).sum(axis=0) % 2 == 0
    return bool(values[same].mean() < values[~same].mean())


def _check_board(board: Chessboard) -> None:
    as_board(board)
    if min(board.size) < 3:
        got = f"{board.columns} x {board.rows}"
        raise ValueError(f"board: want at least 3 x 3 inner corners for OpenCV's detector, got {got}")


def _common_size(listing: list[Photograph]) -> tuple[int, int]:
    """Read every photograph once, so that none fails after a long search, and return their common size."""
    first, *others = listing
    height, width = grey(first).shape
    for other in others:
        h, w = grey(other).shape
        if (h, w) != (height, width):
            raise ValueError(
                f"photographs: want one size, got {width} x {height} px in {first.label} and {w} x {h} px in "
                f"{other.label}; one camera, always held the same way up, gives one size"
            )
    return width, height


def _advice(missed: list[str], board: Chessboard) -> str:
    names = ", ".join(missed[:3]) + (f" and {len(missed) - 3} more" if len(missed) > 3 else "")
    return (
        f"photographs: want a board with {board.columns} x {board.rows} inner corners, found none in {names}. Check "
        "that the numbers count inner corners (one less than the squares each way), that the whole board is in view "
        "with a light margin around it, and that the photographs are sharp and evenly lit"
    )
