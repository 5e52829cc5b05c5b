"""The AprilGrid target: square tags with little squares between their corners, as Kalibr prints and counts them."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import number, whole_number
from diffproj.targets.artwork import Artwork
from diffproj.targets.dictionaries import dictionary_named, marker_count, marker_modules

FAMILY = "APRILTAG_36H11"
"""The family of the tags."""

BORDER = 2
"""Modules of black around a tag's code, as Kalibr prints them."""


@dataclass(frozen=True)
class AprilGrid:
    """A flat grid of AprilTags of the family 36h11, in the convention of Kalibr.

    It may be seen in part, and it shows which way up it is. Tag 0 is at the bottom left, tag 1 to the right of it; the
    tags stand `spacing * tag` apart, and a little black square fills the gap at each of their corners. The points are
    the tags' corners, row by row from the bottom, each row from left to right over all its tags; the origin is the
    bottom left corner of tag 0, x runs to the right, y up, z out of the board, towards the camera.

    Args:
        columns: tags in a row, Kalibr's `tagCols`.
        rows: tags in a column, `tagRows`.
        tag: the side of a tag with its black border, `tagSize`. Its unit is the world unit.
        spacing: the gap between two tags relative to the side of a tag, `tagSpacing`.

    Raises:
        TypeError: a number is something else.
        ValueError: fewer than 1 column or row, more tags than the family's 587, sides that are not positive and finite,
            or a spacing not below 1.

    Example:
        >>> board = AprilGrid(6, 6, tag=88.0, spacing=0.3)
        >>> len(board), [round(x, 6) for x in board.points[:4, 0].tolist()]
        (144, [0.0, 88.0, 114.4, 202.4])
    """

    columns: int
    rows: int
    tag: float
    spacing: float = 0.3

    def __post_init__(self) -> None:
        most = marker_count(FAMILY)
        for name in ("columns", "rows"):
            want = "at least 1 tag, a whole number"
            object.__setattr__(self, name, whole_number(name, getattr(self, name), want, least=1, most=most))
        object.__setattr__(self, "tag", number("tag", self.tag, "a positive, finite side", above=0))
        want = "the gap between tags relative to their side, above 0 and below 1, such as 0.3"
        spacing = number("spacing", self.spacing, want, above=0)
        if spacing >= 1:
            raise ValueError(f"spacing: want {want}, got {spacing:g}; it is a ratio, not a length")
        object.__setattr__(self, "spacing", spacing)
        if self.columns * self.rows > most:
            raise ValueError(f"columns, rows: want at most {most} tags, got {self.columns} x {self.rows}")

    def __len__(self) -> int:
        """The number of tags' corners, N."""
        return 4 * self.columns * self.rows

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of its points."""
        return 2 * self.rows, 2 * self.columns

    @property
    def side(self) -> float:
        """The side of a tag, in world units."""
        return self.tag

    @property
    def title(self) -> str:
        """What it is, in words."""
        return f"AprilGrid with {self.columns} x {self.rows} tags"

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """The tags' corners in the world, row by row from the bottom: a new float64 tensor on each access."""
        x, y = (self.tag * self._starts(2 * count) for count in (self.columns, self.rows))
        y, x = np.meshgrid(y, x, indexing="ij")
        return torch.from_numpy(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1))

    @property
    def by_spacing(self) -> Float[Tensor, "n 3"]:
        """How its points move as the tags move apart: their derivatives by `spacing`."""
        x, y = (self.tag * (np.arange(2 * count) // 2) for count in (self.columns, self.rows))
        y, x = np.meshgrid(y, x, indexing="ij")
        return torch.from_numpy(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1))

    @property
    def dictionary(self) -> str:
        """The name of the tags' family among OpenCV's dictionaries."""
        return FAMILY

    @property
    def corners(self) -> Float[np.ndarray, "n 2"]:
        """The points on the print, in the artwork's frame."""
        gap, height = self.tag * self.spacing, self.artwork_size[1]
        x, y, _ = self.points.numpy().T
        return np.stack([x + gap, height - gap - y], axis=-1)

    @property
    def pitch(self) -> float:
        """The distance from one tag's place to the next, in world units."""
        return self.tag * (1 + self.spacing)

    @property
    def apart(self) -> float:
        """The least distance between two corners, in world units."""
        return self.tag * self.spacing

    @property
    def reach(self) -> float:
        """How far around a corner its neighbourhood is looked at, in world units."""
        return 0.35 * self.tag

    @property
    def borders(self) -> tuple[int, ...]:
        """Widths in modules that the tags' black border may have: Kalibr's, and that of most other programs."""
        return (BORDER, 1)

    @property
    def markers(self) -> dict[int, Float[np.ndarray, "4 2"]]:
        """The tags' corners on the print by their numbers, in the order in which OpenCV finds them."""
        grid = self.corners.reshape(self.rows, 2, self.columns, 2, 2)
        # OpenCV's codes of this family lie upside down: its first corner is the bottom right one.
        return {
            r * self.columns + c: np.stack([grid[r, 0, c, 1], grid[r, 0, c, 0], grid[r, 1, c, 0], grid[r, 1, c, 1]])
            for r in range(self.rows)
            for c in range(self.columns)
        }

    @property
    def artwork_size(self) -> tuple[float, float]:
        """Width and height of the print with its outer little squares, in world units."""
        return self.columns * self.pitch + self.apart, self.rows * self.pitch + self.apart

    @property
    def artwork(self) -> Artwork:
        """What is printed."""
        return self._artwork_with(BORDER)

    def _artwork_with(self, border: int) -> Artwork:
        """What is printed, where the tags' black border has so many modules."""
        modules = dictionary_named(FAMILY).markerSize + 2 * border
        cells = modules + 1
        gap = self.tag * self.spacing
        within = np.concatenate([[0.0], gap + self.tag * np.arange(modules) / modules])
        dark = np.zeros((cells * self.rows + 1, cells * self.columns + 1), dtype=bool)
        dark[::cells, ::cells] = True
        for r in range(self.rows):
            for c in range(self.columns):
                y, x = cells * (self.rows - 1 - r) + 1, cells * c + 1
                code = marker_modules(FAMILY, r * self.columns + c, border)
                dark[y : y + modules, x : x + modules] = code[::-1, ::-1]
        x, y = (
            np.concatenate(
                [(np.arange(count)[:, None] * self.pitch + within).ravel(), count * self.pitch + np.array([0, gap])]
            )
            for count in (self.columns, self.rows)
        )
        corner = np.array([-gap, self.artwork_size[1] - gap, 0.0])
        return Artwork(x, y, dark, np.zeros((0, 3)), (corner, np.array([1.0, 0, 0]), np.array([0, -1.0, 0])))

    def _starts(self, count: int) -> Float[np.ndarray, " n"]:
        """Places of the first so many corners along a row, in sides of a tag."""
        number = np.arange(count)
        return number // 2 * (1 + self.spacing) + number % 2
