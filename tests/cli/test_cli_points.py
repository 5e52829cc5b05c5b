"""Files of points, and sides of squares with their units: what is read, and what it means."""

from pathlib import Path

import pytest

from diffproj.cli.points_file import Pixel, read_points
from diffproj.cli.units import Length, agreed, square_side


@pytest.mark.parametrize(
    "text",
    [
        "a,1.5,2\nb,-3,4\n",
        "name,u,v\na,1.5,2\nb,-3,4",
        "# picked on Monday\nName, U in px, V in px\n\n  a , 1.5 , 2 \n# and\nb,-3,4\n",
        "a;1,5;2\nb;-3;4,0\n",
        "a\t1.5\t2\r\nb\t-3\t4\r\n",
        "\ufeffname;u;v\r\na;1,5;2\r\nb;-3;4\r\n",
        '"a","1.5","2"\n"b","-3","4"\n',
    ],
)
def test_points_files(text: str, tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_bytes(text.encode())
    assert read_points(file) == [Pixel("a", 1.5, 2.0), Pixel("b", -3.0, 4.0)]


def test_points_without_names_have_numbers(tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text("u,v\n1,2\n3,4\nend,5,6\n")
    assert read_points(file) == [Pixel("1", 1, 2), Pixel("2", 3, 4), Pixel("end", 5, 6)]


@pytest.mark.parametrize(
    "text",
    [
        "v,u\n2,1\n4,3\n",
        "row,col\n2,1\n4,3\n",
        "u,v,name\n1,2,1\n3,4,2\n",
        "u,name,v\n1,1,2\n3,2,4\n",
        "Point;Y [px];X [px]\n1;2,0;1,0\n2;4,0;3,0\n",
        "v,u\n1,2,1\n2,4,3\n",
        "name,v,u\n2,1\n4,3\n",
        "Punkt,Spalte,Zeile\n1,1,2\n2,3,4\n",
        "y_px,x_px\n2,1\n4,3\n",
        "v_px,u_px\n2,1\n4,3\n",
        "name,v_px,u_px\n1,2,1\n2,4,3\n",
        "pixel v,pixel u\n2,1\n4,3\n",
        "image v,image u\n2,1\n4,3\n",
        "Y(px),X(px)\n2,1\n4,3\n",
        "coordinate_y,coordinate_x\n2,1\n4,3\n",
        "corner_y,corner_x\n2,1\n4,3\n",
        "point y,point x\n2,1\n4,3\n",
        "pixelY,pixelX\n2,1\n4,3\n",
        "ypx,xpx\n2,1\n4,3\n",
        "line,x,y\n1,1,2\n2,3,4\n",
        "row,u,v\n1,1,2\n2,3,4\n",
        "Row number;v;u\n1;2;1\n2;4;3\n",
        "col,u,v\n1,1,2\n2,3,4\n",
    ],
)
def test_titles_tell_the_order(text: str, tmp_path: Path) -> None:
    """A table of v and u was read as one of u and v, and one of u, v, name with its names as pixels."""
    file = tmp_path / "points.csv"
    file.write_text(text)
    assert read_points(file) == [Pixel("1", 1, 2), Pixel("2", 3, 4)]


@pytest.mark.parametrize("titles", ["u,Zeile", "name,u,u", "name,x,height", "v,y"])
def test_titles_that_tell_half_are_refused(titles: str, tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text(f"{titles}\n1,2\n")
    with pytest.raises(ValueError, match=r"--points-file: want the titles name, u and v, got .* in the first line"):
        read_points(file)


@pytest.mark.parametrize(
    ("titles", "why"),
    [
        ("u,Zeile", "where none means v"),
        ("name,x,height", "where none means v"),
        ("name,height,y", "where none means u"),
        ("name,u,u", "where 'u' and 'u' both mean u"),
        ("v,y", "where 'v' and 'y' both mean v"),
        ("x,y,column", "where 'x' and 'column' both mean u"),
        ("x,u,y", "where 'x' and 'u' both mean u"),
        ("row,u,col", "where 'u' and 'col' both mean u"),
    ],
)
def test_what_is_wrong_with_titles_is_said(titles: str, why: str, tmp_path: Path) -> None:
    """Each of them was said to tell only one of u and v."""
    file = tmp_path / "points.csv"
    file.write_text(f"{titles}\n1,2\n")
    with pytest.raises(ValueError, match=rf"got '{titles}' in the first line of .*points\.csv, {why}$"):
        read_points(file)


@pytest.mark.parametrize(
    ("text", "square"),
    [
        ("25", Length(25.0)),
        ("25mm", Length(25.0, "mm")),
        ("2.5cm", Length(2.5, "cm")),
        (" 2.5 CM ", Length(2.5, "cm")),
        ("1in", Length(1.0, "in")),
        ("3e-2m", Length(0.03, "m")),
        ("40μm", Length(40.0, "µm")),  # the Greek letter and the sign of micro
        ("1e-12", Length(1e-12)),
        ("1e9", Length(1e9)),
    ],
)
def test_sides_of_squares(text: str, square: Length) -> None:
    assert square_side(text) == square


MM, CM, INCH, BARE = Length(25.0, "mm"), Length(2.5, "cm"), Length(1.0, "in"), Length(25.0)


@pytest.mark.parametrize(
    ("square", "calibrated", "unit", "warning"),
    [
        (MM, MM, "mm", None),
        (BARE, MM, "mm", None),
        (MM, BARE, "mm", None),
        (BARE, BARE, None, None),
        (Length(25.4, "mm"), Length(1.0, "in"), "mm", "the same side, but results are in mm"),
        (CM, MM, "cm", "--square: 2.5 cm here, and 25 mm in camera.json: the same side, but results are in cm"),
        (INCH, MM, "in", "--square: 1 in here, and 25 mm in camera.json: right only where it is another board"),
        (Length(30.0, "mm"), MM, "mm", "right only where it is another board"),
        (Length(1.0), MM, None, "right only where it is another board, measured in the unit that you have in mind"),
        (Length(30.0), BARE, None, "right only where it is another board"),
        (MM, Length(25.0, "furlong"), "mm", "right only where it is another board"),
    ],
)
def test_another_side_than_the_calibrations(
    square: Length, calibrated: Length, unit: str | None, warning: str | None
) -> None:
    found, said = agreed(square, calibrated, "camera.json")
    assert found == Length(square.value, unit)
    assert said is None if warning is None else warning in (said or "")
