"""Files with points to measure: a line `name,u,v` for each, as spreadsheets write them."""

from pathlib import Path
from typing import NamedTuple

from diffproj.cli.spreadsheet import Spreadsheet


class Pixel(NamedTuple):
    """A pixel to measure: its name, which is its number where it has none, and its place."""

    name: str
    u: float
    v: float


def read_points(path: Path) -> list[Pixel]:
    """Read the points of a CSV file.

    Each line has a name, u and v, or u and v alone, with commas, semicolons or tabs between them. A first line of
    titles, empty lines and lines that begin with `#` are passed over. Where semicolons or tabs separate, numbers may
    have a decimal comma.

    Raises:
        ValueError: a line is none of these, a name stands twice, or there is no point; the line is named.
        OSError: the file cannot be read.
    """
    table = Spreadsheet("--points-file", path, "lines of name,u,v")
    points: list[Pixel] = []
    first = True
    for line, cells in table.lines():
        point = _point(cells, table, len(points) + 1)
        if point is None and not (first and _titles(cells)):
            raise ValueError(
                f"--points-file: want lines of name,u,v, got {table.joined(cells)!r} in line {line} of {path}"
            )
        first = False
        if point is None:
            continue
        if any(point.name == other.name for other in points):
            raise ValueError(f"--points-file: want each name once, got {point.name!r} again in line {line} of {path}")
        points.append(point)
    if not points:
        raise ValueError(f"--points-file: want lines of name,u,v, found none in {path}")
    return points


def _point(cells: list[str], table: Spreadsheet, number: int) -> Pixel | None:
    """The point of a line; `None` where it is none."""
    if len(cells) not in (2, 3):
        return None
    name, (u, v) = cells[0] if len(cells) == 3 else "", (table.number(cell) for cell in cells[-2:])
    return None if u is None or v is None or not name.isprintable() else Pixel(name or str(number), u, v)


def _titles(cells: list[str]) -> bool:
    """Whether a line holds titles such as name, u, v: neither of its last two cells is meant as a number."""
    return len(cells) in (2, 3) and all(
        cell[:1].isalpha() and cell.lower() not in ("nan", "inf") for cell in cells[-2:]
    )
