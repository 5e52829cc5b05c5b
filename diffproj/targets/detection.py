"""Detect a chessboard's corners in photographs, with sub-pixel accuracy and in a defined order."""

import functools
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from typing import NamedTuple, get_args

import numpy as np
import torch
from jaxtyping import Float

from diffproj._core.arguments import function, whole_number
from diffproj.targets.chessboard import Chessboard, as_board
from diffproj.targets.corners import refine_grid
from diffproj.targets.images import Orientation, Photograph, Source, as_8_bit, grey, listed
from diffproj.targets.numbering import follow, in_order
from diffproj.targets.search import find_pattern
from diffproj.targets.tasks import results_of
from diffproj.targets.videos import Frame, distinct
from diffproj.targets.views import Views


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
    *,
    orientation: Orientation | str = "sensor",
    frames: int | None = None,
    executor: Executor | None = None,
) -> Views:
    """Detect the board's inner corners in photographs of one camera.

    The board is found as a pattern of saddle points of brightness, in copies of several sizes, and where only a part of
    it is found so, by OpenCV's detectors. Its dark and light may be exchanged, as in thermal images. Each corner is
    then placed by fitting its neighbourhood with two crossing edges, their blur and the light. Corners that do not look
    like corners, or lie off the surface through their neighbours, are sought once more, and hidden (`Views.visible`) if
    they stay so: behind a hand or a clip, in glare, beyond the photograph's border. Half of all corners, and of those
    along each side, must be visible.

    The order is that of `Chessboard.points`. It is never mirrored: along a row, then down a column, is clockwise in the
    image. It starts at a dark corner of the board: the square between the first four corners is dark, and so is the one
    diagonally outside the first corner. Where columns + rows is odd, as on a 9 x 6 board, this determines the order:
    each corner keeps its number however the board is rotated. Other boards look the same when turned
    (`Chessboard.turns`): the first photograph takes the order whose first corner is closest to its top left, and each
    later one the order whose rows turn least from the photograph before.

    Args:
        photographs: a file, a folder, a pattern such as `"photos/left*.jpg"`, one image, or a list of files and
            images. An image is an array as OpenCV has it, `(H, W)`, `(H, W, 1)`, `(H, W, 3)` in BGR or `(H, W, 4)` in
            BGRA, of 8-bit or 16-bit integers (16 bits: contrast-stretched) or floats from 0 to 1; or a tensor as
            Kornia has it, `(C, H, W)` in RGB, of the same types, or `(B, C, H, W)`. All of one size. Of a folder,
            hidden files and those of other kinds are left out. A video (`.mp4`, `.avi`, `.mov`, `.mkv`) gives sharp
            frames, at most 60 from all its parts, without those in which the board hardly moved.
        board: the board to look for, with at least 3 x 3 inner corners.
        progress: called with `(done, total)` after each photograph.
        orientation: `"sensor"` counts a file's pixels as the sensor recorded them, whichever way up the camera was
            held: one lens has one principal point. `"upright"` turns each file as its EXIF data ask, as viewers do.
        frames: of a video, take each so-manieth frame instead, sharp or not.
        executor: does the work on several cores or machines: any `concurrent.futures.Executor`, such as a
            `ProcessPoolExecutor`, Dask's `client.get_executor()` or `mpi4py.futures`. Each worker reads its own files.

    Returns:
        The views in which the board was found, in float64 pixels, named by their files (`"image 1"`, ... for arrays).
        Photographs without it are left out, each with a `BoardNotFoundWarning` that names it, and the size of a pattern
        that is there instead.

    Raises:
        BoardNotFoundError: no photograph shows the board.
        FileNotFoundError: a file is missing.
        ValueError: a file is no image, an image has none of the layouts above, sizes differ, or the board has fewer
            than 3 x 3 inner corners. A missing file is told before the first is searched, a broken one at its turn.
        TypeError: an argument is of the wrong kind.

    Example:
        >>> squares = np.indices((7, 10)).sum(axis=0) % 2  # dark at the top left
        >>> image = np.full((340, 460), 255, dtype=np.uint8)
        >>> image[30:310, 30:430] = np.kron(squares, np.ones((40, 40))) * 255
        >>> views = detect(image, Chessboard(columns=9, rows=6))
        >>> views
        Views(1 view of 54 corners, 460 x 340 px, torch.float64)
        >>> views.pixels[0, :2].round(decimals=1).tolist()  # each edge is half a pixel before its first pixel
        [[69.5, 69.5], [109.5, 69.5]]
    """
    _check_board(board)
    if progress is not None:
        function("progress", progress, "a function of (done, total)")
    if orientation not in get_args(Orientation):
        raise ValueError(f"orientation: want 'sensor' or 'upright', got {orientation!r}")
    raster: Orientation = "upright" if orientation == "upright" else "sensor"
    if executor is not None and not callable(getattr(executor, "submit", None)):
        raise TypeError(f"executor: want a concurrent.futures.Executor, got {type(executor).__name__}")
    if frames is not None:
        frames = whole_number("frames", frames, "a whole number from 1 on", least=1)
    listing = listed(photographs, frames)
    # One reading for size and corners: to decode a photograph takes as long as to find a board in it.
    find = functools.partial(_find, board=board, orientation=raster)
    found = results_of(find, listing, executor, progress)
    size = _common_size(listing, [one.size for one in found])
    pairs = [(photograph, one.grid) for photograph, one in zip(listing, found, strict=True) if one.grid is not None]
    if not pairs:
        raise BoardNotFoundError(_advice([photograph.label for photograph in listing], found, board))
    for photograph, one in zip(listing, found, strict=True):
        if one.grid is None and _sharpness(photograph) is None:
            text = f"{_miss(photograph, one.seen, board)}; photograph skipped"
            warnings.warn(text, BoardNotFoundWarning, stacklevel=2)
    seen, grids = zip(*pairs, strict=True)
    grids = follow(list(grids), board)
    # Of a video, one view of each place: copies of a view make error bars too small.
    chosen = [k for k, photograph in enumerate(seen) if _sharpness(photograph) is not None]
    new = distinct([grids[k] for k in chosen], [_sharpness(seen[k]) or 0.0 for k in chosen], size)
    kept = sorted({*range(len(seen))} - {k for k, differs in zip(chosen, new, strict=True) if not differs})
    pixels = torch.from_numpy(np.stack([grids[k] for k in kept])).reshape(len(kept), len(board), 2)
    names = [seen[k].name for k in kept]
    return Views(pixels, pixels.isfinite().all(dim=-1), names=names, size=size)


class _Found(NamedTuple):
    """What was found in one photograph.

    Attributes:
        grid: `(rows, columns, 2)` px, in order, NaN where hidden; None where there is no such board.
        seen: `(columns, rows)` of the largest pattern where there is no such board; (0, 0) for none.
        size: `(width, height)` of the photograph.
    """

    grid: Float[np.ndarray, "rows columns 2"] | None
    seen: tuple[int, int]
    size: tuple[int, int]


def _find(photograph: Photograph, board: Chessboard, orientation: Orientation) -> _Found:
    """Read one photograph and find the board in it: the work of one task."""
    image = grey(photograph, orientation)
    size = image.shape[1], image.shape[0]
    try:
        pattern = find_pattern(as_8_bit(image), board)
        if pattern.grid is None:
            return _Found(None, pattern.seen, size)
        refined = refine_grid(image, pattern.grid)
        if not refined.is_board():
            return _Found(None, (0, 0), size)
        return _Found(in_order(refined.grid, image, board), board.size, size)
    except Exception as error:
        raise RuntimeError(f"{photograph.label}: {type(error).__name__} while searching it: {error}") from error


def _check_board(board: Chessboard) -> None:
    as_board(board)
    if min(board.size) < 3:
        got = f"{board.columns} x {board.rows}"
        raise ValueError(f"board: want at least 3 x 3 inner corners for OpenCV's detector, got {got}")


def _sharpness(photograph: Photograph) -> float | None:
    """Of a frame of a video that was chosen for its sharpness, so that it need not show the board; None for others."""
    return photograph.source.sharpness if isinstance(photograph.source, Frame) else None


def _common_size(listing: list[Photograph], sizes: list[tuple[int, int]]) -> tuple[int, int]:
    """The size of all photographs; where they differ, say which photographs are of which size."""
    groups: dict[tuple[int, int], list[str]] = {}
    for photograph, size in zip(listing, sizes, strict=True):
        groups.setdefault(size, []).append(photograph.label)
    if len(groups) == 1:
        return sizes[0]
    most = max(groups, key=lambda size: len(groups[size]))
    got = " and ".join(f"{w} x {h} px in {_named(labels)}" for (w, h), labels in groups.items())
    raise ValueError(
        f"photographs: want one size, got {got}; one camera with one zoom gives one size: give those of {most[0]} x "
        f"{most[1]} px alone, and calibrate the others by themselves"
    )


def _named(labels: list[str]) -> str:
    return ", ".join(labels[:3]) + (f" and {len(labels) - 3} more" if len(labels) > 3 else "")


def _miss(photograph: Photograph, seen: tuple[int, int], board: Chessboard) -> str:
    """What is said of a photograph without the board."""
    text = f"{photograph.label}: found no board with {board.columns} x {board.rows} inner corners"
    return text + (f", but a pattern with {seen[0]} x {seen[1]}" if _telling(seen) else "")


def _telling(seen: tuple[int, int]) -> bool:
    """Whether a pattern is large enough to be a board that was described wrongly."""
    return min(seen) >= 3


def _advice(labels: list[str], found: list[_Found], board: Chessboard) -> str:
    seen = [one.seen for one in found if _telling(one.seen)]
    there = ""
    if seen:
        usual = max(set(seen), key=seen.count)
        there = (
            f" There is a pattern with {usual[0]} x {usual[1]} inner corners in {seen.count(usual)} of them: if that "
        )
        there += f"is the board, give Chessboard({usual[0]}, {usual[1]}, ...)."
    return (
        f"photographs: want a board with {board.columns} x {board.rows} inner corners, found none in "
        f"{_named(labels)}.{there} Check that the numbers count inner corners (one less than the squares each way), "
        "that the whole board is in view with a margin around it, and that the photographs are sharp and evenly lit"
    )
