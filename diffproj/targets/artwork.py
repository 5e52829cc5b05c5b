"""What is printed on a board: black cells of a lattice of lines, or black discs, on white."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class Artwork(NamedTuple):
    """The print of a board, measured from its top left corner: x to the right, y down, in world units.

    Attributes:
        x, y: the lattice's lines, increasing from 0.
        dark: `(rows, columns)`, which cells between the lines are black.
        discs: `(k, 3)`, black discs: x and y of the centre, and the radius.
        axes: the print in the world: its top left corner, and the unit vectors along its x and y, each `(3,)`.

    Example:
        >>> import diffproj as dp
        >>> art = dp.Chessboard(columns=4, rows=3, square=10.0).artwork
        >>> art.size, art.dark.shape, bool(art.dark[0, 0])
        ((50.0, 40.0), (4, 5), True)
    """

    x: Float[np.ndarray, " columns_and_1"]
    y: Float[np.ndarray, " rows_and_1"]
    dark: Bool[np.ndarray, "rows columns"]
    discs: Float[np.ndarray, "k 3"]
    axes: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]

    @property
    def size(self) -> tuple[float, float]:
        """Width and height in world units."""
        return float(self.x[-1]), float(self.y[-1])

    def darkness(
        self, corner: tuple[float, float], step: float, shape: tuple[int, int]
    ) -> Float[np.ndarray, "height width"]:
        """How much of each square texel is black, from 0 to 1.

        Args:
            corner: x and y of the texels' common top left corner, which may lie beyond the print.
            step: side of a texel in world units.
            shape: `(height, width)` in texels.
        """
        x, y = (start + step * np.arange(count + 1) for start, count in zip(corner, shape[::-1], strict=True))
        share = _overlap(y, self.y) @ self.dark @ _overlap(x, self.x).T / step**2
        u, v = x[:-1] + step / 2, y[:-1] + step / 2
        for centre_x, centre_y, radius in self.discs:
            columns = np.abs(u - centre_x) < radius + step
            rows = np.abs(v - centre_y) < radius + step
            distance = np.hypot(u[None, columns] - centre_x, v[rows, None] - centre_y)
            share[np.ix_(rows, columns)] += np.clip(0.5 + (radius - distance) / step, 0, 1)
        return share.clip(0, 1)


def on_paper(
    x: Float[np.ndarray, " columns_and_1"], y: Float[np.ndarray, " rows_and_1"], dark: Bool[np.ndarray, "rows columns"]
) -> Artwork:
    """A print without discs whose top left corner is the world's origin, with z into the board."""
    right, down, _ = np.eye(3)
    return Artwork(x, y, dark, np.zeros((0, 3)), (np.zeros(3), right, down))


def _overlap(texels: Float[np.ndarray, " n"], lines: Float[np.ndarray, " m"]) -> Float[np.ndarray, "n-1 m-1"]:
    """The lengths that texels and cells share along one axis."""
    low = np.maximum(texels[:-1, None], lines[None, :-1])
    high = np.minimum(texels[1:, None], lines[None, 1:])
    return (high - low).clip(min=0)
