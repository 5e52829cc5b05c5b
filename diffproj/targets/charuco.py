"""The ChArUco target: a chessboard with a square marker in each white square, as OpenCV makes it."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import flag, number, whole_number
from diffproj.targets.artwork import Artwork, on_paper
from diffproj.targets.dictionaries import dictionary_name, dictionary_named, marker_count, marker_modules

MOST = 1000
"""Squares in a row or a column that a board may have, more than any that can be photographed."""


@dataclass(frozen=True)
class CharucoBoard:
    """A flat chessboard whose white squares hold markers, so that each corner is known by itself.

    It may be seen in part, and it shows which way up it is. Points, markers and frame are those of OpenCV's
    `cv2.aruco.CharucoBoard`: the points are the inner corners, where four squares meet, row by row; the origin is the
    outer corner of the board's top left square, x runs to the right, y down, z into the board. So the first point is
    at `(square, square, 0)`.

    Args:
        columns: squares in a row, as OpenCV counts them.
        rows: squares in a column.
        square: the side of a square. Its unit is the world unit.
        marker: the side of a marker, in the same unit, its black border included.
        dictionary: the name of OpenCV's dictionary, such as `"4X4_1000"` or `"5X5_100"`.
        legacy: whether the board was made by OpenCV before 4.6, which began boards of an even number of rows with a
            white square. Others are the same.

    Raises:
        TypeError: a number or a name is something else.
        ValueError: fewer than 3 columns or rows, a marker that is not smaller than its square, a dictionary that
            OpenCV does not have, or one with too few markers.

    Example:
        >>> board = CharucoBoard(8, 6, square=25.0, marker=18.0, dictionary="5X5_100")
        >>> len(board), board.points[:2].tolist()
        (35, [[25.0, 25.0, 0.0], [50.0, 25.0, 0.0]])
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str
    legacy: bool = False

    def __post_init__(self) -> None:
        want = f"at least 3 squares, a whole number up to {MOST:,}"
        for name in ("columns", "rows"):
            object.__setattr__(self, name, whole_number(name, getattr(self, name), want, least=3, most=MOST))
        for name in ("square", "marker"):
            side = number(name, getattr(self, name), "a positive, finite side", above=0)
            object.__setattr__(self, name, side)
        if self.marker >= self.square:
            raise ValueError(f"marker: want a side below that of the square, {self.square:g}, got {self.marker:g}")
        object.__setattr__(self, "dictionary", dictionary_name(self.dictionary))
        object.__setattr__(self, "legacy", flag("legacy", self.legacy))
        need, there = len(self._marked()), marker_count(self.dictionary)
        if need > there:
            raise ValueError(
                f"dictionary: want one of at least {need} markers, got {self.dictionary} with {there}; it has to have "
                "one for every second square of columns x rows"
            )

    def __len__(self) -> int:
        """The number of inner corners, N."""
        return (self.columns - 1) * (self.rows - 1)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of its points."""
        return self.rows - 1, self.columns - 1

    @property
    def side(self) -> float:
        """The side of a square, in world units."""
        return self.square

    @property
    def title(self) -> str:
        """What it is, in words."""
        return f"ChArUco board with {self.columns} x {self.rows} squares"

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """The inner corners in the world, row by row: a new float64 tensor on each access."""
        row, column = np.indices((self.rows - 1, self.columns - 1)).reshape(2, -1) + 1.0
        return torch.from_numpy(np.stack([column, row, np.zeros_like(row)], axis=-1) * self.square)

    @property
    def corners(self) -> Float[np.ndarray, "n 2"]:
        """The points on the print, in the artwork's frame."""
        return self.points[:, :2].numpy()

    @property
    def pitch(self) -> float:
        """The distance from one marker's place to the next, in world units."""
        return self.square

    @property
    def apart(self) -> float:
        """The least distance between two corners, in world units."""
        return self.square

    @property
    def reach(self) -> float:
        """How far around a corner its neighbourhood is looked at, in world units."""
        return 0.5 * self.square

    @property
    def borders(self) -> tuple[int, ...]:
        """Widths in modules that the markers' black border may have."""
        return (1,)

    @property
    def markers(self) -> dict[int, Float[np.ndarray, "4 2"]]:
        """The markers' corners on the print by their numbers, in the order in which OpenCV finds them."""
        unit = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * self.marker / 2
        return {k: (np.array([c, r]) + 0.5) * self.square + unit for k, (r, c) in enumerate(self._marked())}

    @property
    def artwork(self) -> Artwork:
        """What is printed."""
        return self._artwork_with(1)

    def _artwork_with(self, border: int) -> Artwork:
        """What is printed, where the markers' black border has so many modules."""
        modules = dictionary_named(self.dictionary).markerSize + 2 * border
        margin = (self.square - self.marker) / 2
        within = np.concatenate([[0.0], margin + self.marker * np.arange(modules + 1) / modules])
        dark = np.kron(
            np.indices((self.rows, self.columns)).sum(axis=0) % 2 == self._first, np.ones((modules + 2,) * 2)
        )
        for k, (r, c) in enumerate(self._marked()):
            y, x = (place * (modules + 2) + 1 for place in (r, c))
            dark[y : y + modules, x : x + modules] = marker_modules(self.dictionary, k, border)
        x, y = (
            np.append((np.arange(count)[:, None] * self.square + within).ravel(), count * self.square)
            for count in (self.columns, self.rows)
        )
        return on_paper(x, y, dark > 0)

    @property
    def _first(self) -> int:
        """0 where the top left square is black, 1 where it is white."""
        return int(self.legacy and self.rows % 2 == 0)

    def _marked(self) -> list[tuple[int, int]]:
        """Row and column of the squares with markers, in the order of their numbers."""
        return [(r, c) for r in range(self.rows) for c in range(self.columns) if (r + c) % 2 != self._first]


def with_other_start(board: CharucoBoard) -> CharucoBoard | None:
    """The board with the first square of the other colour: the legacy one of an ordinary one, and back.

    None where both are the same: boards of an odd number of rows.
    """
    return replace(board, legacy=not board.legacy) if board.rows % 2 == 0 else None
