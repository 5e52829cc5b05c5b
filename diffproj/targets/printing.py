"""Print a target at true scale: a page with the board, a ruler to check the print by, and what the board is."""

import io
import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from diffproj._core.arguments import choice, file_path, number, numbers
from diffproj._core.atomic import write_whole
from diffproj._core.warn import warn_caller
from diffproj.targets.artwork import Artwork
from diffproj.targets.boards import Board, as_printed

if TYPE_CHECKING:  # it is slow to load
    from matplotlib.path import Path as Outline

PAPERS = {
    "A0": (841.0, 1189.0),
    "A1": (594.0, 841.0),
    "A2": (420.0, 594.0),
    "A3": (297.0, 420.0),
    "A4": (210.0, 297.0),
    "A5": (148.0, 210.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}
"""Widths and heights of papers, upright, in mm."""

LARGEST = 5000
"""Longer side in mm of the largest paper."""

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
"""Units that a target may be described in, in mm."""

SUFFIXES = (".pdf", ".svg", ".png")
"""Endings of the files that can be written."""

MARGIN = 10.0
"""Border of the page in mm that stays white: many printers cannot print there."""

FOOT = 14.0
"""Height in mm of the ruler and the words below the board."""

FINEST = 0.1
"""Width in mm below which parts of a board blur on paper: two dots of a printer of 600 dpi are .085 mm."""

MOST_PIXELS = 6e8
"""Pixels of a .png, each of which takes four bytes of memory while it is drawn: A0 at 600 dpi has 5.6e8."""

INCH = UNITS["in"]


def draw_target(
    target: Board,
    path: str | os.PathLike[str],
    paper: str | Sequence[float] = "A4",
    *,
    dpi: float = 600,
    unit: str = "mm",
) -> None:
    """Write a page with a target to print, at true scale.

    Below the board are a ruler, to check by measuring that nothing was scaled on the way to the paper, and the target's
    own description. A margin of 10 mm stays white. The page is turned where the board fits better so. Print at 100 %
    ("actual size"), glue the print to something flat, and measure a long distance on it. A warning says where parts are
    finer than printers print, as those of a board in metres that is taken to be in millimetres.

    Args:
        target: the board.
        path: a .pdf or .svg, which have no pixels, or a .png; replaced if there is one.
        paper: `"A0"` to `"A5"`, `"letter"`, `"legal"` or `"tabloid"`; or width and height in mm.
        dpi: pixels per inch of a .png.
        unit: the unit in which the target is described: `"mm"`, `"cm"`, `"m"` or `"in"`.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: the board does not fit on the paper (the message names the largest that does), a .png would have
            more than 600 million pixels, or the paper, the unit or the file's ending is unknown.
        OSError: the file cannot be written.
        ModuleNotFoundError: matplotlib is missing.

    Example:
        >>> import tempfile, diffproj as dp
        >>> board = dp.CharucoBoard(8, 6, square=25.0, marker=18.0, dictionary="5X5_100")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dp.draw_target(board, f"{folder}/board.pdf")
        >>> dp.draw_target(dp.Chessboard(11, 8, square=30.0), "board.pdf")
        Traceback (most recent call last):
        ...
        ValueError: target: want at most 277 x 176 mm on A4 with its margins, got 360 x 270 mm; the largest square that
        fits is 19.5 mm, and a larger paper takes more, such as paper=(380, 304) of a print shop. A board goes on one
        page, not over several: joined pieces are neither flat nor square enough
    """
    as_printed(target, "target")
    file = file_path("path", path)
    if file.suffix.lower() not in SUFFIXES:
        raise ValueError(f"path: want a file ending in {', '.join(SUFFIXES)}, got {str(file)!r}")
    dpi = number("dpi", dpi, "pixels per inch, from 50 to 5000", least=50, most=5000)
    scale = UNITS[choice("unit", unit, UNITS)]
    page = _page(target, paper, scale)
    if file.suffix.lower() == ".png":
        _check_pixels(page, dpi)
    finest = _finest(target) * scale
    if finest < FINEST:
        warn_caller(
            f"target: its finest parts are {finest:.2g} mm wide, finer than printers print; is it described in {unit}?"
        )
    write_whole(file, _drawn(target, page, scale, unit, file.suffix.lower()[1:], dpi))


def _check_pixels(page: tuple[float, float], dpi: float) -> None:
    """Check that a picture fits into memory.

    Raises:
        ValueError: it does not.
    """
    width, height = page
    most = math.floor(math.sqrt(MOST_PIXELS / (width * height)) * INCH)
    if dpi > most:
        raise ValueError(
            f"dpi: want at most {most} for a .png of {width:g} x {height:g} mm, got {dpi:g}; a .pdf or .svg has no "
            "pixels"
        )


def _finest(target: Board) -> float:
    """Width of the narrowest cell or disc of the print, in world units."""
    art = target.artwork
    if len(art.discs):
        return float(2 * art.discs[:, 2].min())
    return float(min(np.diff(art.x).min(), np.diff(art.y).min()))


def _page(target: Board, paper: str | Sequence[float], scale: float) -> tuple[float, float]:
    """Width and height of the page in mm, turned to suit the board.

    Raises:
        ValueError: the board does not fit either way.
    """
    if isinstance(paper, str):
        named = {name.lower(): size for name, size in PAPERS.items()}
        if paper.lower() not in named:
            raise ValueError(f"paper: want one of {', '.join(PAPERS)}, or (width, height) in mm, got {paper!r}")
        size = named[paper.lower()]
    else:
        want = f"(width, height) in mm, from 50 to {LARGEST}"
        size = numbers("paper", paper, want, 2)
        if not 50 <= min(size) <= max(size) <= LARGEST:
            raise ValueError(f"paper: want {want}, got {size}")
    width, height = (length * scale for length in target.artwork.size)
    room = {page: (page[0] - 2 * MARGIN, page[1] - 2 * MARGIN - FOOT) for page in ((*size,), (*reversed(size),))}
    fill = {page: min(across / width, down / height) for page, (across, down) in room.items()}
    best = max(fill, key=lambda page: fill[page])
    if fill[best] < 1 - 1e-9:
        what = {"Chessboard": "square", "CharucoBoard": "square", "AprilGrid": "tag"}.get(
            type(target).__name__, "spacing"
        )
        largest = math.floor(10 * target.side * scale * fill[best]) / 10
        name = paper if isinstance(paper, str) else f"{size[0]:g} x {size[1]:g} mm"
        across, down = room[best]
        needed = math.ceil(width + 2 * MARGIN), math.ceil(height + 2 * MARGIN + FOOT)
        own = f", such as paper=({needed[0]}, {needed[1]}) of a print shop" if max(needed) <= LARGEST else ""
        raise ValueError(
            f"target: want at most {across:g} x {down:g} mm on {name} with its margins, got {width:g} x {height:g} mm; "
            f"the largest {what} that fits is {largest:g} mm, and a larger paper takes more{own}. A board goes on one "
            "page, not over several: joined pieces are neither flat nor square enough"
        )
    return best[0], best[1]


def _drawn(target: Board, page: tuple[float, float], scale: float, unit: str, kind: str, dpi: float) -> bytes:
    """The page as the content of a file."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch

    width, height = page
    figure = Figure(figsize=(width / INCH, height / INCH), dpi=dpi)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.axis("off")
    art = target.artwork
    across, down = (length * scale for length in art.size)
    corner = np.array([(width - across) / 2, MARGIN + (height - 2 * MARGIN - FOOT - down) / 2])
    board = PathPatch(_outline(art, scale, corner), facecolor="black", linewidth=0, edgecolor="none", snap=False)
    axes.add_patch(board)
    length = 10.0 * min(10, int((width - 2 * MARGIN) / 10) - 1)
    left, top = MARGIN, height - MARGIN - FOOT + 4
    thin = {"color": "black", "linewidth": 0.5, "solid_capstyle": "butt", "snap": False}
    axes.plot([left, left + length], [top, top], **thin)
    for k in range(int(length) + 1):
        tall = 3.0 if k % 10 == 0 else 2.0 if k % 5 == 0 else 1.2
        axes.plot([left + k, left + k], [top, top - tall], **thin)
    small = {"fontsize": 6, "va": "top", "ha": "left", "parse_math": False}
    axes.text(left, top + 1, f"{length:g} mm from first to last mark: measure it, for printers scale", **small)
    axes.text(left, top + 5, f"diffproj.{target!r}, in {unit}", **small)
    written = io.BytesIO()
    metadata = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(kind)
    with rc_context({"svg.fonttype": "path", "path.simplify": False}):
        figure.savefig(written, format=kind, dpi=dpi, metadata=metadata, facecolor="white")
    return written.getvalue()


def _outline(art: Artwork, scale: float, corner: np.ndarray) -> "Outline":
    """All that is black as one path, so that no light shines between its parts."""
    from matplotlib.path import Path as Outline

    vertices, codes = [], []
    box = [Outline.MOVETO, Outline.LINETO, Outline.LINETO, Outline.LINETO, Outline.CLOSEPOLY]
    for row, cells in enumerate(art.dark):
        edges = np.flatnonzero(np.diff(np.pad(cells.astype(int), 1)))
        for first, last in edges.reshape(-1, 2):
            (left, right), (top, bottom) = art.x[[first, last]], art.y[[row, row + 1]]
            vertices += [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)]
            codes += box
    circle = Outline.unit_circle()
    for x, y, radius in art.discs:
        vertices += (np.array([x, y]) + radius * np.asarray(circle.vertices)).tolist()
        codes += np.asarray(circle.codes).tolist()
    return Outline(np.array(vertices) * scale + corner, codes)
