"""Files with landmarks: where each one is in the world, and which pixel shows it, as spreadsheets write them."""

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj._core.warn import warn_caller
from diffproj.cli.spreadsheet import Spreadsheet
from diffproj.geometry.geodesy import metres_from_degrees
from diffproj.targets.landmarks import Landmarks

TITLES = {
    "name": ("name", "id", "point", "landmark"),
    "u": ("u", "pixel_u", "image_x"),
    "v": ("v", "pixel_v", "image_y"),
    "x": ("x", "e", "east", "easting"),
    "y": ("y", "n", "north", "northing"),
    "latitude": ("lat", "latitude"),
    "longitude": ("lon", "long", "lng", "longitude"),
    "z": ("z", "h", "height", "elevation"),
    "sigma": ("sigma",),
    "sigma_x": ("sigma_x",),
    "sigma_y": ("sigma_y",),
    "sigma_z": ("sigma_z",),
    "pixel_sigma": ("pixel_sigma",),
}
"""The columns, each with its titles, in small letters."""

WITHOUT_TITLES = ("name", "u", "v", "x", "y", "z")
"""The columns of a file that begins with numbers; z may be left out."""

METRES, DEGREES = ("x", "y"), ("latitude", "longitude")
"""Where a landmark is on the map: either of the two pairs; the latter where there is no other."""

DEVIATIONS = ("sigma", "sigma_x", "sigma_y", "sigma_z", "pixel_sigma")
WANT = "columns name, u, v, x, y, z"


class Surveyed(NamedTuple):
    """What a file of landmarks says.

    Attributes:
        landmarks: with their names, and their own deviations where the file has some.
        pixels: that show them `(N, 2)`; NaN where none does.
        pixel_sigma: standard deviations of these `(N,)`, NaN where the file says none; `None` without such a column.
        crs: the map whose metres x and y are, where the file has latitudes and longitudes.
    """

    landmarks: Landmarks
    pixels: Tensor
    pixel_sigma: Tensor | None
    crs: str | None = None


def read_landmarks(path: Path, crs: str | None = None) -> Surveyed:
    """Read the landmarks of a CSV file.

    Its first line has the titles of the columns, in any order: u, v, x, y, or lat and lon, in degrees, in place of x
    and y; and as far as they are known name, z (0 if left out), sigma or sigma_x, sigma_y and sigma_z (deviations in
    world units, 0 where empty) and pixel_sigma. Other columns are passed over, with a warning where z is left out and
    one of them may be it. A file without titles has name,u,v,x,y,z or name,u,v,x,y. Landmarks without u and v are in
    the survey and not in the photograph.

    Args:
        path: of the file.
        crs: the map that degrees become metres of, such as "EPSG:32630"; the UTM zone of their middle if left out.

    Raises:
        ValueError: a column is missing or there twice, a cell is no number, or a name stands twice, line and column
            are named; degrees are none, the map has none of them, or pyproj is not installed, which they need.
        OSError: the file cannot be read.

    Warns:
        UserWarning: there is no z, and a column of numbers that is passed over.
    """
    table = Spreadsheet("--landmarks", path, f"lines with {WANT}")
    columns: list[str | None] | None = None
    titles: list[str] = []
    aside: list[list[float | None]] = []
    rows: list[dict[str, float | None]] = []
    names: list[str] = []
    for line, cells in table.lines():
        if columns is None:
            titled = all(table.number(cell) is None for cell in cells[1:3])
            columns = _columns(cells, path) if titled else _untitled(cells, path)
            if titled:
                titles = cells
                continue
        row = _row(columns, cells, table, line)
        name = dict(zip(columns, cells, strict=False)).get("name") or str(len(rows) + 1)
        if not name.isprintable():
            raise ValueError(f"--landmarks: want a name in column 'name', got {name!r} in line {line} of {path}")
        if name in names:
            raise ValueError(f"--landmarks: want each name once, got {name!r} again in line {line} of {path}")
        rows.append(row)
        names.append(name)
        aside.append([None if column else table.number(cell) for column, cell in zip(columns, cells, strict=False)])
    if not rows:
        raise ValueError(f"--landmarks: want lines with {WANT}, found none in {path}")
    if "z" not in rows[0]:
        _warn_of_heights(titles, aside, path)
    if crs is not None and DEGREES[0] not in rows[0]:
        raise ValueError(f"--crs: want columns lat and lon, which it makes metres of, got x and y in {path}")
    return _surveyed(rows, names, path, crs)


def _warn_of_heights(titles: list[str], aside: list[list[float | None]], path: Path) -> None:
    """Warn of columns of numbers that are passed over in a file without z: one of them may be it.

    Args:
        titles: of all columns.
        aside: the numbers in the columns that are passed over, line by line.
        path: of the file.
    """
    places = range(min(map(len, aside)))
    columns = {titles[place]: [numbers[place] for numbers in aside] for place in places if place < len(titles)}
    degrees = [title for column in DEGREES for title in TITLES[column]]
    found = [
        repr(title)
        for title, numbers in columns.items()
        if None not in numbers and not _counts(numbers) and title.lower() not in degrees
    ]
    if found:
        them = "it is the height, call it z" if len(found) == 1 else "one is the height, call that z"
        warn_caller(
            f"{path}: no column is called z, so that all landmarks are taken to lie on z = 0; {' and '.join(found)} "
            f"{'is' if len(found) == 1 else 'are'} passed over: if {them}"
        )


def _counts(numbers: list[float | None]) -> bool:
    """Whether they are whole numbers one after the other, as landmarks are numbered."""
    first = numbers[0]
    return first is not None and first == round(first) and numbers == [first + i for i in range(len(numbers))]


def _columns(cells: list[str], path: Path) -> list[str | None]:
    """What each column is by its title; `None` for one that is passed over."""
    known = {title: column for column, titles in TITLES.items() for title in titles}
    columns = [known.get(cell.lower()) for cell in cells]
    for column in TITLES:
        if columns.count(column) > 1:
            raise ValueError(f"--landmarks: want one column {column!r}, got {columns.count(column)} in {path}")
    if set(METRES) <= set(columns):
        columns = [None if column in DEGREES else column for column in columns]
    place = DEGREES if set(DEGREES) & set(columns) else METRES
    missing = [column for column in ("u", "v", *place) if column not in columns]
    if missing:
        raise ValueError(
            f"--landmarks: want {WANT} by their titles in the first line, or lat and lon in place of x and y, got no "
            f"{missing[0]!r} in {path}: it has {', '.join(map(repr, cells))}"
        )
    columns = [None if column in METRES and place == DEGREES else column for column in columns]
    if "sigma" in columns and any(f"sigma_{axis}" in columns for axis in "xyz"):
        raise ValueError(f"--landmarks: want either a column 'sigma' or sigma_x, sigma_y, sigma_z, got both in {path}")
    return columns


def _untitled(cells: list[str], path: Path) -> list[str | None]:
    if len(cells) not in (len(WITHOUT_TITLES) - 1, len(WITHOUT_TITLES)):
        raise ValueError(
            f"--landmarks: want {WANT} with their titles in the first line, or these alone without titles, got "
            f"{len(cells)} columns without titles in {path}"
        )
    return list(WITHOUT_TITLES[: len(cells)])


def _row(columns: list[str | None], cells: list[str], table: Spreadsheet, line: int) -> dict[str, float | None]:
    """The numbers of a line; `None` where a cell is empty that may be."""
    if len(cells) > len(columns) and any(cells[len(columns) :]):
        raise ValueError(f"--landmarks: want {len(columns)} cells, got {len(cells)} in line {line} of {table.path}")
    found: dict[str, float | None] = {}
    for column, cell in zip(columns, [*cells, *[""] * (len(columns) - len(cells))], strict=False):
        if column in (None, "name"):
            continue
        value = table.number(cell) if cell else None
        least = column in DEVIATIONS and value is not None and (value < 0 or (column == "pixel_sigma" and value == 0))
        if least or (value is None and (cell or column in (*METRES, *DEGREES, "z"))):
            want = "a number" if column not in DEVIATIONS else "a standard deviation"
            got = repr(cell) if cell else "nothing"
            raise ValueError(f"--landmarks: want {want} in column {column!r}, got {got} in line {line} of {table.path}")
        found[column] = value
    if (found["u"] is None) != (found["v"] is None):
        lost = "u" if found["u"] is None else "v"
        raise ValueError(
            f"--landmarks: want u and v, or neither for a landmark that the photograph does not show, got nothing in "
            f"column {lost!r} in line {line} of {table.path}"
        )
    return found


def _surveyed(rows: list[dict[str, float | None]], names: list[str], path: Path, crs: str | None) -> Surveyed:
    def numbers(columns: tuple[str, ...], empty: float) -> Tensor:
        cells = [[empty if (value := row.get(column)) is None else value for column in columns] for row in rows]
        return torch.tensor(cells, dtype=torch.float64, device="cpu")

    spread = None
    if any(column in rows[0] for column in DEVIATIONS[:4]):
        spread = numbers(("sigma",) * 3 if "sigma" in rows[0] else ("sigma_x", "sigma_y", "sigma_z"), 0.0)
    try:
        if DEGREES[0] in rows[0]:
            points, crs = metres_from_degrees(numbers((*DEGREES, "z"), 0.0), crs)
        else:
            points = numbers((*METRES, "z"), 0.0)
        landmarks = Landmarks(points, names, spread)
    except (ValueError, ModuleNotFoundError) as error:
        option = "--crs" if str(error).startswith("crs") else "--landmarks"
        raise ValueError(f"{option}: {path}: {error}") from None
    pixel_sigma = numbers(("pixel_sigma",), torch.nan)[:, 0] if "pixel_sigma" in rows[0] else None
    return Surveyed(landmarks, numbers(("u", "v"), torch.nan), pixel_sigma, crs)
