"""Files of landmarks as spreadsheets and surveys write them: which column is the height, other encodings."""

import re
from pathlib import Path

import pytest

from diffproj.cli.landmarks_file import read_landmarks
from diffproj.cli.points_file import read_points

ROWS = "mast,2521.9,483.7,902062.6,274683.6,7.4\nwall,2968.6,734.5,901957.8,274645.2,7.5\n"


@pytest.mark.parametrize("title", ["alt", "Höhe", "z_orth"])
def test_a_height_under_another_title_is_told(tmp_path: Path, title: str) -> None:
    """Of four landmarks that differ by half a metre such a file leaves a fit that looks like a noisy one."""
    path = tmp_path / "survey.csv"
    path.write_text(f"name,u,v,x,y,{title}\n{ROWS}", encoding="utf-8")
    told = (
        f"survey.csv: no column is called z, .* lie on z = 0; '{title}' is passed over: if it is the height, call it z"
    )
    with pytest.warns(UserWarning, match=told):
        found = read_landmarks(path)
    assert found.landmarks.points[:, 2].tolist() == [0, 0]


def test_several_columns_that_may_be_the_height_are_told(tmp_path: Path) -> None:
    path = tmp_path / "survey.csv"
    path.write_text("nr,x,y,alt,geoid,u,v,by\n7,1,2,3,4,5,6,me\n9,3,4,5,6,7,8,me\n")
    with pytest.warns(
        UserWarning, match="'nr' and 'alt' and 'geoid' are passed over: if one is the height, call that z"
    ):
        read_landmarks(path)


@pytest.mark.parametrize(
    "text",
    [
        "name,u,v,x,y\na,1,2,3,4\nb,3,4,5,6\n",
        "nr,u,v,x,y,by\n1,1,2,3,4,me\n2,3,4,5,6,you\n",
        "code,u,v,x,y\n101,1,2,3,4\n102,3,4,5,6\n",
        "name,u,v,x,y,z,alt\na,1,2,3,4,5,6\nb,3,4,5,6,5,6\n",
        "name,u,v,x,y,alt\na,1,2,3,4,5\nb,3,4,5,6,\n",
        "a,1,2,3,4\nb,3,4,5,6\n",
    ],
    ids=["no other", "a running number", "one that begins elsewhere", "with z", "not of all", "no titles"],
)
def test_a_survey_on_the_ground_needs_no_heights(tmp_path: Path, text: str) -> None:
    path = tmp_path / "survey.csv"
    path.write_text(text)
    assert len(read_landmarks(path).landmarks.points) == 2


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_text_of_spreadsheets(tmp_path: Path, encoding: str, end: str) -> None:
    """Excel's "Unicode text" is UTF-16 with a mark in front, and tabs."""
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    path = tmp_path / "survey.txt"
    path.write_bytes((mark + "name\tu\tv\nTür\t828,5\t550\nTor\t1094\t549\n".replace("\n", end)).encode(encoding))
    assert read_points(path) == [("Tür", 828.5, 550), ("Tor", 1094, 549)]


def test_text_of_other_encodings_has_a_remedy(tmp_path: Path) -> None:
    path = tmp_path / "survey.csv"
    path.write_bytes("name,u,v\nTür,828.5,550\n".encode("cp1252"))
    told = f"want a text file in UTF-8, got something else in {re.escape(str(path))}; spreadsheets write one as 'CSV UTF-8'"
    with pytest.raises(ValueError, match=told):
        read_points(path)
