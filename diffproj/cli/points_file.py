"""Files with points to measure: a line `name,u,v` for each, as spreadsheets write them."""

import re
from pathlib import Path
from typing import NamedTuple

from diffproj.cli.spreadsheet import Spreadsheet

TITLES = {
    "u": ("u", "x", "column", "col", "upx", "xpx"),
    "v": ("v", "y", "row", "line", "vpx", "ypx"),
}
"""What the columns are called, in small letters and among other words: `v`, `image v`, `y_px`. Others may be names."""

COUNTERS = ("row", "line", "column", "col")
"""Of these words, those that a running number in front of u and v has as well."""


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
        ValueError: a line is none of these, titles name only one of u and v, or one of them twice, a name stands
            twice, or there is no point; the line is named.
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
    words = [_word(cell) for cell in cells]
    known = {title: column for column, titles in TITLES.items() for title in titles}
    columns = [known.get(word) for word in words]
    if len(cells) == 3 and words[0] in COUNTERS and {*columns[1:]} == {"u", "v"}:
        columns[0] = None
    if "u" not in columns and "v" not in columns:
        return Order()
    for column in sorted(TITLES, key=columns.count, reverse=True):
        if columns.count(column) != 1:
            same = [repr(cell) for cell, other in zip(cells, columns, strict=True) if other == column]
            why = f"{' and '.join(same[:2])} both mean {column}" if same else f"none means {column}"
            raise ValueError(
                f"--points-file: want the titles name, u and v, got {table.joined(cells)!r} in the first line of "
                f"{table.path}, where {why}"
            )
    turned = columns.index("v") < columns.index("u")
    return Order(({0, 1, 2} - {columns.index("u"), columns.index("v")}).pop() if len(cells) == 3 else 0, turned)


def _word(title: str) -> str:
    """The word of a title that says whether it is u or v; none where it is another."""
    words = re.split(r"[\W_]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", title).lower())
    return next((word for word in words if any(word in titles for titles in TITLES.values())), "")
