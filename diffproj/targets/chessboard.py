"""The chessboard target: positions of its inner corners in the world, in the frame of OpenCV or of the paper."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import choice, instance, number, whole_number
from diffproj.targets.artwork import Artwork

Axes = Literal["opencv", "paper"]
"""The board's two world frames; see `Chessboard`."""
MOST = 10_000
"""Inner corners in a row or a column that a board may have, more than any that can be photographed."""


@dataclass(frozen=True)
class Chessboard:
    """A flat chessboard, described by its inner corners: the points where four squares meet.

    The corners are listed row by row, each row from left to right, as seen on an upright board. This order is the same
    in both frames, so the same pixels fit both; only the coordinates differ. With side `s`, the corner in row r and
    column c (both from 0) is at

    * `axes="opencv"`: `(c s, r s, 0)`: x to the right, y down, z into the board, away from the camera;
    * `axes="paper"`: `(r s, c s, 0)`: x from the top left corner down to the bottom left one, y from there to the top
      right, z out of the board, towards the camera (Siswantoro, Prabuwono and Abdullah, 2013).

    Both frames are right-handed and have their origin at the first inner corner.

    Args:
        columns: inner corners in a row: one less than the squares.
        rows: inner corners in a column: one less than the squares.
        square: the side of a square. Its unit is the world unit; 25 (mm) by default.
        axes: `"opencv"` or `"paper"`.

    Raises:
        TypeError: columns or rows are not integers, square is not a number, or axes no string.
        ValueError: fewer than 2 columns or rows or more than 10,000, a square that is not positive and finite, or
            unknown axes.

    Example:
        >>> board = Chessboard(columns=4, rows=3, square=10.0)
        >>> board.points[:5].tolist()
        [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [20.0, 0.0, 0.0], [30.0, 0.0, 0.0], [0.0, 10.0, 0.0]]
        >>> Chessboard(columns=4, rows=3, square=10.0, axes="paper").points[3].tolist()
        [0.0, 30.0, 0.0]
        >>> len(board), board.size
        (12, (4, 3))
    """

    columns: int = 9
    rows: int = 6
    square: float = 25.0
    axes: Axes | str = "opencv"

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns", _count("columns", self.columns))
        object.__setattr__(self, "rows", _count("rows", self.rows))
        want = "a positive, finite side"
        object.__setattr__(self, "square", number("square", self.square, want, above=0))
        choice("axes", self.axes, get_args(Axes))

    def __len__(self) -> int:
        """The number of inner corners, N."""
        return self.columns * self.rows

    @property
    def size(self) -> tuple[int, int]:
        """`(columns, rows)`, in OpenCV's order."""
        return self.columns, self.rows

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of its points."""
        return self.rows, self.columns

    @property
    def side(self) -> float:
        """The side of a square, in world units."""
        return self.square

    @property
    def title(self) -> str:
        """What it is, in words."""
        return f"board with {self.columns} x {self.rows} inner corners"

    @property
    def turns(self) -> int:
        """The number of turns in its plane after which the board looks the same: 1, 2 or 4.

        1 where columns + rows is odd: only such a board shows which corner is the first.

        Example:
            >>> Chessboard(9, 6).turns, Chessboard(8, 6).turns, Chessboard(7, 7).turns, Chessboard(6, 6).turns
            (1, 2, 2, 4)
        """
        if (self.columns + self.rows) % 2:
            return 1
        return 4 if self.columns == self.rows and self.columns % 2 == 0 else 2

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """The inner corners in the world, row by row, in the unit of `square`: a new float64 tensor on each access."""
        row, column = torch.meshgrid(
            torch.arange(self.rows, dtype=torch.float64, device="cpu"),
            torch.arange(self.columns, dtype=torch.float64, device="cpu"),
            indexing="ij",
        )
        return self._placed(row.flatten(), column.flatten())

    @property
    def outline(self) -> Float[Tensor, "4 3"]:
        """The outer corners of the printed squares, one square beyond the inner corners, in the unit of `square`.

        In the order top left, top right, bottom right, bottom left.

        Example:
            >>> Chessboard(columns=4, rows=3, square=10.0).outline.tolist()
            [[-10.0, -10.0, 0.0], [40.0, -10.0, 0.0], [40.0, 30.0, 0.0], [-10.0, 30.0, 0.0]]
        """
        top, right, bottom, left = -1.0, float(self.columns), float(self.rows), -1.0
        return self._placed(
            torch.tensor([top, top, bottom, bottom], dtype=torch.float64, device="cpu"),
            torch.tensor([left, right, right, left], dtype=torch.float64, device="cpu"),
        )

    @property
    def artwork(self) -> Artwork:
        """What is printed: its squares, dark at the top left."""
        x, y = (self.square * np.arange(count + 2.0) for count in self.size)
        dark = np.indices((self.rows + 1, self.columns + 1)).sum(axis=0) % 2 == 0
        corner, right, _, down = self.outline.numpy()
        along, below = right - corner, down - corner
        axes = corner, along / np.linalg.norm(along), below / np.linalg.norm(below)
        return Artwork(x, y, dark, np.zeros((0, 3)), axes)

    def _placed(self, row: Float[Tensor, " n"], column: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """World points in this board's frame from rows and columns in units of squares."""
        along = (column, row) if self.axes == "opencv" else (row, column)
        return torch.stack([*along, torch.zeros_like(row)], dim=-1) * self.square


def as_board(board: Chessboard) -> Chessboard:
    """A board as it is.

    Raises:
        TypeError: it is none.
    """
    return instance("board", board, Chessboard, "a dp.Chessboard", "dp.Chessboard(columns, rows, square) makes one")


def _count(name: str, value: object) -> int:
    want = f"at least 2 inner corners (one less than the squares), a whole number up to {MOST:,}"
    return whole_number(name, value, want, least=2, most=MOST)
