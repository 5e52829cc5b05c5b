"""Kalibr's target files, as its documentation has them."""

from pathlib import Path

import pytest

import diffproj as dp
from diffproj.files.kalibr_target import read_target

APRIL = """target_type: 'aprilgrid' #gridtype
tagCols: 6               #number of apriltags
tagRows: 5               #number of apriltags
tagSize: 0.088           #size of apriltag, edge to edge [m]
tagSpacing: 0.3          #ratio of space between tags to tagSize
"""
CHESS = "target_type: checkerboard\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n"
CIRCLES = "target_type: 'circlegrid'\ntargetCols: 4\ntargetRows: 11\nspacingMeters: 0.02\nasymmetricGrid: True\n"


def written(folder: Path, text: str) -> Path:
    (folder / "target.yaml").write_text(text)
    return folder / "target.yaml"


def test_the_three_kinds(tmp_path):
    assert read_target(written(tmp_path, APRIL)) == dp.AprilGrid(6, 5, 0.088, 0.3)
    assert read_target(written(tmp_path, CHESS)) == dp.Chessboard(6, 7, 0.06)
    circles = dp.CircleGrid(4, 11, 0.02, 0.015, asymmetric="rows")
    assert read_target(written(tmp_path, CIRCLES), diameter=0.015) == circles


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CIRCLES, "want the diameter of its circles too"),
        (CHESS.replace("colSpacingMeters: 0.06", "colSpacingMeters: 0.05"), "want squares, .* got 0.05 and 0.06"),
        (APRIL.replace("aprilgrid", "assymetric"), "want a target file of Kalibr .*, got 'assymetric'"),
        (APRIL.replace("tagCols: 6", "tagCols: six"), "tagCols: want"),
        (APRIL.replace("tagSize: 0.088", "tagSize: -1"), "tag: want a positive"),
        ("cam0: {}", "want a target file of Kalibr"),
    ],
)
def test_other_files_are_refused_with_their_name(tmp_path, text, message):
    with pytest.raises(ValueError, match=rf"target\.yaml: .*{message}"):
        read_target(written(tmp_path, text))
