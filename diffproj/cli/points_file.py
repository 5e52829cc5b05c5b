"""Files with points to measure: a line `name,u,v` for each, as spreadsheets write them."""

import csv
import io
from pathlib import Path
from typing import NamedTuple

from diffproj.cli.inputs import LARGEST_NUMBER


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
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"--points-file: want a text file in UTF-8, got something else in {path}") from None
    separator = next((mark for mark in ";\t" if mark in text), ",")
    points: list[Pixel] = []
    reader = csv.reader(io.StringIO(text), delimiter=separator, skipinitialspace=True)
    first = True
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if not any(cells) or cells[0].startswith("#"):
                continue
            point = _point(cells, separator, len(points) + 1)
            if point is None and not (first and _titles(cells)):
                raise ValueError(
                    f"--points-file: want lines of name,u,v, got {separator.join(cells)!r} in line {reader.line_num} "
                    f"of {path}"
                )
            first = False
            if point is None:
                continue
            if any(point.name == other.name for other in points):
                raise ValueError(
                    f"--points-file: want each name once, got {point.name!r} again in line {reader.line_num} of {path}"
                )
            points.append(point)
    except csv.Error as error:
        raise ValueError(f"--points-file: want lines of name,u,v, got something else in {path} ({error})") from None
    if not points:
        raise ValueError(f"--points-file: want lines of name,u,v, found none in {path}")
    return points


def _point(cells: list[str], separator: str, number: int) -> Pixel | None:
    """The point of a line; `None` where it is none."""
    if len(cells) not in (2, 3):
        return None
    name, (u, v) = cells[0] if len(cells) == 3 else "", (_number(cell, separator) for cell in cells[-2:])
    return None if u is None or v is None or not name.isprintable() else Pixel(name or str(number), u, v)


def _number(text: str, separator: str) -> float | None:
    try:
        value = float(text if separator == "," else text.replace(",", "."))
    except ValueError:
        return None
    return value if abs(value) <= LARGEST_NUMBER else None


def _titles(cells: list[str]) -> bool:
    """Whether a line holds titles such as name, u, v: neither of its last two cells is meant as a number."""
    return len(cells) in (2, 3) and all(
        cell[:1].isalpha() and cell.lower() not in ("nan", "inf") for cell in cells[-2:]
    )
