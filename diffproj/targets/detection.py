"""Detect a target's points in photographs, with sub-pixel accuracy and in a defined order."""

import functools
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from jaxtyping import Float, Shaped

from diffproj._core.arguments import function, whole_number
from diffproj._core.warn import warn_caller
from diffproj.targets.april_grid import AprilGrid
from diffproj.targets.boards import Board, as_target, with_article
from diffproj.targets.charuco import CharucoBoard
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.circle_grid import CircleGrid
from diffproj.targets.exif import exif_of
from diffproj.targets.finders import Found, find
from diffproj.targets.images import NotAnImageError, Orientation, Photograph, Source, grey, listed
from diffproj.targets.numbering import follow
from diffproj.targets.one_camera import doubts, named, told_of
from diffproj.targets.tasks import results_of
from diffproj.targets.videos import Frame, distinct
from diffproj.targets.views import Views

MANY = 5
"""Photographs without a board for one and the same reason above which they are named together."""


class BoardNotFoundWarning(UserWarning):
    """A photograph was skipped because no board was found in it; many that have nothing else to tell, together.

    Example:
        Where no photograph may be skipped, turn it into an error.

        >>> import warnings
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
    target: Board,
    progress: Callable[[int, int], object] | None = None,
    *,
    orientation: Orientation | str = "sensor",
    frames: int | None = None,
    executor: Executor | None = None,
) -> Views:
    """Detect a target's points in photographs of one camera.

    A `CharucoBoard` or an `AprilGrid` is found by its markers, as much of it as is in view. Each corner is placed by
    fitting the whole print around it; corners that do not fit, or lie off the surface through their neighbours, are
    hidden (`Views.visible`). At least 6 must be visible, on two rows and two columns, or all of a board of 4. Each is
    known by itself, however the board is turned. A ChArUco board with an odd number of columns and an even one of rows
    shows whether it is `legacy` by one end of its rows: where that is in view, but covered, it counts as not found.

    A `CircleGrid` is found as dark ellipses on a lattice, or light ones on dark, of which up to a quarter may be
    hidden; those that glare or a shadow draws aside are. The pixels are the middles of the ellipses; `calibrate` knows
    that a centre is seen elsewhere, by as much as the diameter says: circles that are clearly of another one count as
    not found, and the message says how wide they are. Its order is never mirrored, and where the board looks the same
    when turned (`CircleGrid.turns`), the rule for chessboards holds. Where it does so only since some circles are
    hidden, it counts as not found.

    A `Chessboard` is found as a pattern of saddle points of brightness, in copies of several sizes, and where only a
    part of it is found so, by OpenCV's detectors. Its dark and light may be exchanged, as in thermal images. Each
    corner is then placed by fitting its neighbourhood with two crossing edges, their blur and the light. Corners that
    do not look like corners, or lie off the surface through their neighbours, are sought once more, and hidden
    (`Views.visible`) if they stay so: behind a hand or a clip, in glare, beyond the photograph's border. Half of all
    corners, and of those along each side, must be visible.

    A chessboard's order is that of `Chessboard.points`. It is never mirrored: along a row, then down a column, is
    clockwise in the image. It starts at a dark corner of the board: the square between the first four corners is dark,
    and so is the one diagonally outside the first corner. Where columns + rows is odd, as on a 9 x 6 board, this
    determines the order: each corner keeps its number however the board is rotated. Other boards look the same when
    turned (`Chessboard.turns`): the first photograph takes the order whose first corner is closest to its top left, and
    each later one the order whose rows turn least from the photograph before.

    Args:
        photographs: a file, a folder, a pattern such as `"photos/left*.jpg"`, one image, or a list of files and
            images. An image is an array as OpenCV has it, `(H, W)`, `(H, W, 1)`, `(H, W, 3)` in BGR or `(H, W, 4)` in
            BGRA, of 8-bit or 16-bit integers (16 bits: contrast-stretched) or floats from 0 to 1; or a tensor as
            Kornia has it, `(C, H, W)` in RGB, of the same types, or `(B, C, H, W)`. All of one size. Of a folder,
            hidden files and those of other kinds are left out. A video (`.mp4`, `.mov`, `.avi`, `.mkv`, ...) gives
            sharp frames, at most 60 from all its parts, without those in which the board hardly moved.
        target: the board to look for; a chessboard has at least 3 x 3 inner corners.
        progress: called with `(done, total)` after each photograph.
        orientation: `"sensor"` counts a file's pixels as the sensor recorded them, whichever way up the camera was
            held: one lens has one principal point. `"upright"` turns each file as its EXIF data ask, as viewers do,
            and frames as their video asks.
        frames: of a video, take every n-th frame instead, sharp or not.
        executor: does the work on several cores or machines: any `concurrent.futures.Executor`, such as a
            `ProcessPoolExecutor`, Dask's `client.get_executor()` or `mpi4py.futures`. Each worker reads its own files.

    Returns:
        The views in which the board was found, in float64 pixels, named by their files (`"image 1"`, ... for arrays).
        Photographs without it are left out, each with a `BoardNotFoundWarning` that names it, and the size of a pattern
        that is there instead. Where the board is seen more than once, the one that covers most of the photograph is
        taken, with a warning. A warning also names photographs whose EXIF data tell of another camera, lens or zoom,
        of a mirror image, or, upright, of another turn than the others.

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
    return searched(photographs, target, progress, orientation=orientation, frames=frames, executor=executor).views


@dataclass(frozen=True)
class Searched:
    """What a search of photographs found.

    Attributes:
        views: those in which the board was found.
        photographs: the photograph of each view.
        beside: what was made of each of these, while it was decoded; empty where nothing was asked for.
        without: photographs without the board.
        broken: what is wrong with files that are no images, of those that may be.
    """

    views: Views
    photographs: tuple[Photograph, ...]
    beside: tuple[Any, ...]
    without: tuple[Photograph, ...]
    broken: tuple[NotAnImageError, ...]


def searched(
    photographs: Source | Iterable[Source],
    target: Board,
    progress: Callable[[int, int], object] | None = None,
    *,
    orientation: Orientation | str = "sensor",
    frames: int | None = None,
    executor: Executor | None = None,
    beside: Callable[[Shaped[np.ndarray, "h w"], Float[np.ndarray, "n 2"]], object] | None = None,
    may_be_broken: Collection[Path] = (),
) -> Searched:
    """What `detect` does, with all that it learns of the photographs.

    Args:
        photographs: as `detect` takes them, and so are those that follow.
        target: see there.
        progress: see there.
        orientation: see there.
        frames: see there.
        executor: see there.
        beside: makes something small of a grey photograph from 0 to 255 that shows the board, and of the corners' px,
            NaN where hidden. It runs where the photograph is decoded, so that nobody decodes it again.
        may_be_broken: folders, of which files that are no images are left out.

    Raises:
        NotAnImageError: a file is no image, or none of those that may be broken is one.
        Exception: as `detect`.
    """
    as_target(target)
    if progress is not None:
        function("progress", progress, "a function of (done, total)")
    if orientation not in get_args(Orientation):
        raise ValueError(f"orientation: want 'sensor' or 'upright', got {orientation!r}")
    raster: Orientation = "upright" if orientation == "upright" else "sensor"
    if executor is not None and (isinstance(executor, type) or not callable(getattr(executor, "submit", None))):
        got = f"the class {executor.__name__}" if isinstance(executor, type) else type(executor).__name__
        raise TypeError(f"executor: want a concurrent.futures.Executor, got {got}")
    if frames is not None:
        frames = whole_number("frames", frames, "a whole number from 1 on", least=1)
    listing = listed(photographs, frames)
    # One reading for size and corners: to decode a photograph takes as long as to find a board in it.
    search = functools.partial(
        _find, target=target, orientation=raster, beside=beside, may_be_broken=frozenset(may_be_broken)
    )
    results = results_of(search, listing, executor, progress)
    broken = [one for one in results if isinstance(one, NotAnImageError)]
    if len(broken) == len(listing):
        raise broken[0]
    pairs = [(photograph, one) for photograph, one in zip(listing, results, strict=True) if isinstance(one, Found)]
    listing, found = [photograph for photograph, _ in pairs], [one for _, one in pairs]
    size = _common_size(listing, [one.size for one in found])
    pairs = [(photograph, one) for photograph, one in pairs if one.grid is not None]
    if not pairs:
        raise BoardNotFoundError(_advice([photograph.label for photograph in listing], found, target))
    without = [photograph for photograph, one in zip(listing, found, strict=True) if one.grid is None]
    missed: dict[str, list[str]] = {}
    for photograph, one in zip(listing, found, strict=True):
        if one.grid is None and _sharpness(photograph) is None:
            missed.setdefault(_miss(one, target), []).append(photograph.label)
    for why, labels in missed.items():
        if len(labels) > MANY:
            warn_caller(f"{named(labels)}: {why}; photographs skipped", BoardNotFoundWarning)
        else:
            for label in labels:
                warn_caller(f"{label}: {why}; photograph skipped", BoardNotFoundWarning)
    for doubt in doubts([one.label for one, _ in pairs], [one.exif for _, one in pairs], raster == "upright"):
        warn_caller(doubt)
    repeated = [photograph.label for photograph, one in pairs if one.again]
    if repeated:
        warn_caller(_twice(repeated, target))
    seen = [photograph for photograph, _ in pairs]
    grids = [one.grid for _, one in pairs if one.grid is not None]
    grids = follow(grids, target) if isinstance(target, Chessboard | CircleGrid) else grids
    # Of a video, one view of each place: copies of a view make error bars too small.
    chosen = [k for k, photograph in enumerate(seen) if _sharpness(photograph) is not None]
    new = distinct([grids[k] for k in chosen], [_sharpness(seen[k]) or 0.0 for k in chosen], size)
    kept = sorted({*range(len(seen))} - {k for k, differs in zip(chosen, new, strict=True) if not differs})
    pixels = torch.from_numpy(np.stack([grids[k] for k in kept])).reshape(len(kept), len(target), 2)
    names = [seen[k].name for k in kept]
    told = [told_of(pairs[k][1].exif or pairs[k][0].exif, raster == "upright") for k in kept]
    views = Views(pixels, pixels.isfinite().all(dim=-1), names, size, told)
    made = () if beside is None else tuple(pairs[k][1].beside for k in kept)
    return Searched(views, tuple(seen[k] for k in kept), made, tuple(without), tuple(broken))


def _find(
    photograph: Photograph,
    target: Board,
    orientation: Orientation,
    beside: Callable[..., object] | None,
    may_be_broken: frozenset[Path],
) -> Found | NotAnImageError:
    """Read one photograph and find the target in it, the work of one task; of a broken one that may be so, why."""
    content = photograph.source.read_bytes() if isinstance(photograph.source, Path) else None
    try:
        image = grey(photograph, orientation, content)
    except NotAnImageError as error:
        if error.path.parent in may_be_broken:
            return error
        raise
    size = image.shape[1], image.shape[0]
    try:
        exif = None if content is None else exif_of(content)
        found = find(image, target)._replace(size=size, exif=exif)
        if beside is not None and found.grid is not None:
            found = found._replace(beside=beside(image, found.grid.reshape(-1, 2)))
    except Exception as error:
        raise RuntimeError(f"{photograph.label}: {type(error).__name__} while searching it: {error}") from error
    return found


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
    got = " and ".join(f"{w} x {h} px in {named(labels)}" for (w, h), labels in groups.items())
    if set(groups) == {most, most[::-1]}:
        raise ValueError(
            f"photographs: want one size, got {got}; some were turned after they were taken: give all as the sensor "
            "recorded them, for a turned one has another principal point"
        )
    raise ValueError(
        f"photographs: want one size, got {got}; one camera with one zoom gives one size: give those of {most[0]} x "
        f"{most[1]} px alone, and calibrate the others by themselves"
    )


def _miss(found: Found, target: Board) -> str:
    """What is said of a photograph without the board, after its name."""
    text = f"found no {target.title}"
    if found.hint:
        return f"{text}, but {found.hint}"
    return text + (f", but a pattern with {found.seen[0]} x {found.seen[1]}" if _telling(found.seen) else "")


def _twice(labels: list[str], target: Board) -> str:
    """What is said of photographs in which the board is seen more than once."""
    alone = isinstance(target, Chessboard | CircleGrid)
    differ = "another number of squares or circles" if alone else "markers of other numbers"
    return (
        f"{named(labels)}: the {target.title} is seen more than once; the one that covers most of the photograph was "
        f"taken, which need not always be the same one: cover the others, crop them off, or give them {differ}"
    )


def _telling(seen: tuple[int, int]) -> bool:
    """Whether a pattern is large enough to be a board that was described wrongly."""
    return min(seen) >= 3


def _advice(labels: list[str], found: list[Found], target: Board) -> str:
    seen = [one.seen for one in found if _telling(one.seen)]
    there = ""
    if seen:
        usual = max(set(seen), key=seen.count)
        there = (
            f" There is a pattern with {usual[0]} x {usual[1]} inner corners in {seen.count(usual)} of them: if that "
        )
        there += f"is the board, give Chessboard({usual[0]}, {usual[1]}, ...)."
    hints = [one.hint for one in found if one.hint]
    if hints:
        there = f" There is {hints[0]}."
    return (
        f"photographs: want {with_article(target)}, found none in {named(labels)}.{there} Check target, and that "
        f"{_CHECKS[type(target)]}"
    )


_CHECKS: dict[type, str] = {
    Chessboard: "the numbers count inner corners (one less than the squares each way), that the whole board is in view "
    "with a margin around it, and that the photographs are sharp and evenly lit",
    CharucoBoard: "the numbers count squares, columns first, that marker, dictionary and legacy are those that the "
    "board was made with, and that the photographs are sharp, evenly lit and not mirrored, with markers of 15 px or "
    "more",
    AprilGrid: "the numbers count tags, columns first, that the tags are of the family 36h11 and begin with number 0, "
    "and that the photographs are sharp, evenly lit and not mirrored, with tags of 25 px or more",
    CircleGrid: "the numbers count circles, columns first, that every second line is shifted where asymmetric says so, "
    "that the whole board is in view, and that the photographs are sharp and evenly lit, with circles of 6 px or more",
}
"""What may be wrong where a target is in no photograph."""
