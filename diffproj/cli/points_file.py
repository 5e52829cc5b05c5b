"""Files with points to measure: a line `name,u,v` for each, as spreadsheets write them."""

import re
from pathlib import Path
from typing import NamedTuple

from diffproj.cli.spreadsheet import Spreadsheet

TITLES = {
    "u": ("u", "x", "column", "col", "pixel_u", "image_x"),
    "v": ("v", "y", "row", "line", "pixel_v", "image_y"),
    "name": ("name", "id", "point"),
}
"""What the columns may be called, by their first word in small letters; a file's titles may be others as well."""


class Order(NamedTuple):
    """Which cell of a line is what, of two and of three cells.

    Attributes:
        name: the place of the name among three; the numbers are the other two.
        turned: whether v stands before u.
    """

    name: int = 0
    turned: bool = False


class Pixel(NamedTuple):
    """A pixel to measure: its name, which is its number where it has none, and its place."""

    name: str
    u: float
    v: float


def read_points(path: Path) -> list[Pixel]:
    """Read the points of a CSV file.

    Each line has a name, u and v, or u and v alone, with commas, semicolons or tabs between them. Titles in a first
    line may give another order, by `TITLES`; of others the order is this one. Empty lines and lines that begin with `#`
    are passed over. Where semicolons or tabs separate, numbers may have a decimal comma.

    Raises:
        ValueError: a line is none of these, titles say of one column alone that it is u or v, a name stands twice, or
            there is no point; the line is named.
        OSError: the file cannot be read.
    """
    table = Spreadsheet("--points-file", path, "lines of name,u,v")
    points: list[Pixel] = []
    first, order = True, Order()
    for line, cells in table.lines():
        if first and _titles(cells):
            order = _order(cells, table)
            first = False
            continue
        first = False
        point = _point(cells, table, len(points) + 1, order)
        if point is None:
            raise ValueError(
                f"--points-file: want lines of name,u,v, got {table.joined(cells)!r} in line {line} of {path}"
            )
        if any(point.name == other.name for other in points):
            raise ValueError(f"--points-file: want each name once, got {point.name!r} again in line {line} of {path}")
        points.append(point)
    if not points:
        raise ValueError(f"--points-file: want lines of name,u,v, found none in {path}")
    return points


def _point(cells: list[str], table: Spreadsheet, number: int, order: Order) -> Pixel | None:
    """The point of a line; `None` where it is none."""
    if len(cells) not in (2, 3):
        return None
    cells = list(cells)
    name = cells.pop(order.name) if len(cells) == 3 else ""
    u, v = (table.number(cell) for cell in (reversed(cells) if order.turned else cells))
    return None if u is None or v is None or not name.isprintable() else Pixel(name or str(number), u, v)


def _titles(cells: list[str]) -> bool:
    """Whether a line holds titles such as name, u, v: neither of its last two cells is meant as a number."""
    return len(cells) in (2, 3) and all(
        cell[:1].isalpha() and cell.lower() not in ("nan", "inf") for cell in cells[-2:]
    )


def _order(cells: list[str], table: Spreadsheet) -> Order:
    """The order that titles give; name, u, v where they say nothing of u and v.

    Raises:
        ValueError: they name u or v alone, or one of them twice.
    """
    words = [re.match(r"\w*", cell.lower())[0] for cell in cells]  # type: ignore[index]  # it always matches
    known = {title: column for column, titles in TITLES.items() for title in titles}
    columns = [known.get(word) for word in words]
    if "u" not in columns and "v" not in columns:
        return Order()
    if columns.count("u") != 1 or columns.count("v") != 1:
        raise ValueError(
            f"--points-file: want the titles name, u and v, got {table.joined(cells)!r} in the first line of "
            f"{table.path}, which tells only one of u and v"
        )
    turned = columns.index("v") < columns.index("u")
    return Order(({0, 1, 2} - {columns.index("u"), columns.index("v")}).pop() if len(cells) == 3 else 0, turned)
