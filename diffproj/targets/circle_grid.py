"""The circle grid: black discs in rows and columns, or with every second line shifted."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from diffproj._core.arguments import number, whole_number
from diffproj.targets.artwork import Artwork

Lines = Literal["rows", "columns"]
"""Which lines of an asymmetric grid are shifted, every second of them."""

MOST = 1000
"""Circles in a row or a column that a board may have."""


@dataclass(frozen=True)
class CircleGrid:
    """A flat grid of black discs; its points are their centres, row by row, each row from left to right.

    The origin is the first centre, x runs to the right, y down, z into the board. With the spacing `s`, the circle in
    row r and column c (both from 0) is at `(c s, r s, 0)`. In an asymmetric grid every second line is shifted by `s`,
    and the circles of a line are `2 s` apart, as OpenCV and Kalibr have it: `((2 c + r % 2) s, r s, 0)` where the lines
    are rows, and `(c s, (2 r + c % 2) s, 0)` where they are columns.

    A circle's image is no circle, and its middle is not where the centre is seen: `calibrate`, `refine` and `locate`
    take that into account, for which they need the diameter.

    Args:
        columns: circles in a row.
        rows: circles in a column.
        spacing: as above. Its unit is the world unit.
        diameter: of a circle, in the same unit.
        asymmetric: whether every second line is shifted. `"rows"` or `"columns"` say which lines; True takes those of
            which there are more, so that OpenCV's pattern of `Size(4, 11)` is 4 x 11, or 11 x 4 lying on its side.

    Raises:
        TypeError: a number is something else.
        ValueError: fewer than 2 columns or rows, sides that are not positive and finite, circles that touch each other,
            or another word for asymmetric.

    Example:
        >>> board = CircleGrid(11, 4, spacing=20.0, diameter=15.0, asymmetric=True)
        >>> len(board), board.points[:3].tolist()
        (44, [[0.0, 0.0, 0.0], [20.0, 20.0, 0.0], [40.0, 0.0, 0.0]])
    """

    columns: int
    rows: int
    spacing: float
    diameter: float
    asymmetric: bool | Lines | str = False

    def __post_init__(self) -> None:
        want = f"at least 2 circles, a whole number up to {MOST:,}"
        for name in ("columns", "rows"):
            object.__setattr__(self, name, whole_number(name, getattr(self, name), want, least=2, most=MOST))
        for name in ("spacing", "diameter"):
            object.__setattr__(self, name, number(name, getattr(self, name), "a positive, finite length", above=0))
        asymmetric = bool(self.asymmetric) if isinstance(self.asymmetric, np.bool_) else self.asymmetric
        if not isinstance(asymmetric, bool) and not (isinstance(asymmetric, str) and asymmetric in get_args(Lines)):
            raise ValueError(f"asymmetric: want False, True, 'rows' or 'columns', got {self.asymmetric!r}")
        if asymmetric is True:
            asymmetric = "columns" if self.columns > self.rows else "rows"
        object.__setattr__(self, "asymmetric", asymmetric)
        if self.diameter >= 0.95 * self.apart:
            raise ValueError(
                f"diameter: want circles apart, less than {self.apart:g} at this spacing, got {self.diameter:g}"
            )

    def __len__(self) -> int:
        """The number of circles, N."""
        return self.columns * self.rows

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of its points."""
        return self.rows, self.columns

    @property
    def side(self) -> float:
        """The spacing."""
        return self.spacing

    @property
    def apart(self) -> float:
        """The least distance between two centres, in world units."""
        return self.spacing * 2**0.5 if self.asymmetric else self.spacing

    @property
    def title(self) -> str:
        """What it is, in words."""
        return f"{'asymmetric ' if self.asymmetric else ''}circle grid with {self.columns} x {self.rows} circles"

    @property
    def turns(self) -> int:
        """The number of turns in its plane after which the board looks the same: 1, 2 or 4.

        Example:
            >>> CircleGrid(7, 5, 20.0, 10.0).turns, CircleGrid(5, 5, 20.0, 10.0).turns
            (2, 4)
            >>> CircleGrid(4, 11, 20.0, 10.0, asymmetric=True).turns
            1
        """
        if self.asymmetric:
            return 2 - (self.rows if self.asymmetric == "rows" else self.columns) % 2
        return 4 if self.columns == self.rows else 2

    @property
    def places(self) -> Int[np.ndarray, "n 2"]:
        """The centres in units of the spacing, x and y: whole numbers."""
        row, column = np.indices(self.shape).reshape(2, -1)
        if self.asymmetric == "rows":
            column = 2 * column + row % 2
        elif self.asymmetric == "columns":
            row = 2 * row + column % 2
        return np.stack([column, row], axis=-1)

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """The centres in the world, row by row: a new float64 tensor on each access."""
        return torch.from_numpy(np.pad(self.places * self.spacing, ((0, 0), (0, 1))))

    @property
    def artwork(self) -> Artwork:
        """What is printed."""
        radius = self.diameter / 2
        centres = self.places * self.spacing + radius
        width, height = centres.max(axis=0) + radius
        discs = np.column_stack([centres, np.full(len(centres), radius)])
        _, right, down = np.eye(3)[[2, 0, 1]]
        x, y = np.array([0.0, width]), np.array([0.0, height])
        return Artwork(x, y, np.zeros((1, 1), dtype=bool), discs, (np.array([-radius, -radius, 0.0]), right, down))
