"""`diffproj experiment` as a stranger meets it: what it prints and writes, its exit codes and its one-line errors."""

from pathlib import Path

import cv2
import pytest

import diffproj as dp
from tests.cli.commands import runner

run = runner("experiment")


def test_experiment_prints_the_table_and_writes_three_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "new" / "folder"
    code, out, err = run(capsys, "--output", str(folder))
    assert (code, err) == (0, "")
    assert "Table 1" in out
    assert "left14.jpg" in out
    assert sorted(path.name for path in folder.iterdir()) == [
        "camera.json",
        "fig7.png",
        "table1.csv",
        "table1_measured_board.csv",
    ]
    assert cv2.imread(str(folder / "fig7.png")) is not None
    assert dp.load_calibration(folder / "camera.json").rms < 0.19
    assert (folder / "table1.csv").read_text().startswith("view,corners,mean_E_x")


def test_options_reach_the_experiment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = (
        "--data",
        "right",
        "--distortion",
        "none",
        "--split",
        "1-10/12,13",
        "--strict",
        "--output",
        str(tmp_path),
    )
    code, out, _ = run(capsys, *options)
    assert code == 0
    assert "right14.jpg" in out
    assert "27" in out
    assert "lens k1" not in out
    rows = (tmp_path / "table1.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows[1:]] == ["right13.jpg", "right14.jpg", "all"]


def test_own_photographs(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run(
        capsys,
        "--images",
        str(photographs),
        "--board",
        "8x5",
        "--split",
        "4",
        "--distortion",
        "none",
        "--output",
        str(tmp_path),
    )
    assert code == 0
    assert "6.png" in out
    assert "5.png" in err
    files = [str(photographs / f"{i}.png") for i in (1, 2, 3, 4, 6)]
    code, again, err = run(
        capsys, "--images", *files, "--board", "8x5", "--split", "4", "--distortion", "none", "--output", str(tmp_path)
    )
    assert (code, again, err.strip()) == (0, out, "")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--data", "middle"], 2, "invalid choice: 'middle'"),
        (["--board", "9by6"], 2, "want inner corners as COLUMNSxROWS, such as 9x6, got '9by6'"),
        (["--board", "8x5"], 1, "--board: want 9x6 for --data, got 8x5"),
        (["--split", "20"], 1, "split: want views from 1 to 13"),
        (["--board", "9x2"], 2, "want at least 3x3 inner corners"),
        (
            ["--square", "-1"],
            2,
            "--square: want the side of a square as a positive number, with its unit or without, such as 25mm, got '-1'",
        ),
        (["--images", "nowhere.jpg"], 1, "nowhere.jpg"),
    ],
)
def test_errors_are_one_line_with_a_remedy(
    arguments: list[str], code: int, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "output"
    found, out, err = run(capsys, *arguments, "--output", str(folder))
    assert found == code
    assert message in err
    assert out == ""
    assert code == 2 or len(err.strip().splitlines()) == 1
    assert not folder.exists()


def test_folders_without_photographs_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "--images", str(tmp_path))
    assert code == 1
    assert str(tmp_path) in err
