"""Photographs that tests of several commands take, and where these run."""

from pathlib import Path

import cv2
import pytest

import diffproj as dp
from diffproj import synthetic


@pytest.fixture(scope="session")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with five photographs of an 8 x 5 board and one that shows no board."""
    folder = tmp_path_factory.mktemp("photographs")
    setup = dp.paper_setup()
    board = dp.Chessboard(8, 5, 25.0, axes="paper")
    for i in (1, 2, 3, 4, 6):
        cv2.imwrite(str(folder / f"{i}.png"), synthetic.photograph(setup.fit[i], board).numpy())
    empty = synthetic.photograph(setup.fit[0].cropped(0.0, 0.0, 20, 20).cropped(0.0, 0.0, 640, 480), board)
    cv2.imwrite(str(folder / "5.png"), empty.numpy() * 0 + 90)
    (folder / "notes.txt").write_text("not a photograph")
    return folder


@pytest.fixture
def there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs a test in the folder that its module makes."""
    monkeypatch.chdir(folder)
