"""Frames of videos, as the sensor recorded them and upright."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

import diffproj as dp
from diffproj.targets.images import grey, listed

MATRICES = {0: (1, 0, 0, 1), 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}


def film(path: Path, turn: int, frames: list[np.ndarray]) -> None:
    """A video that asks to be turned by so many degrees clockwise, as a telephone writes it."""
    height, width = frames[0].shape
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (width, height))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video")
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    content = bytearray(path.read_bytes())
    place = content.index(b"tkhd") + 4 + 40  # behind its version, flags, times, number, layer and volume
    a, b, c, d = MATRICES[turn]
    struct.pack_into(">9i", content, place, a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
    path.write_bytes(content)


@pytest.mark.parametrize("turn", MATRICES)
def test_frames_are_turned_where_they_are_to_be_upright(tmp_path: Path, turn: int) -> None:
    frame = np.zeros((48, 64), np.uint8)
    frame[:24, :32] = 255
    film(tmp_path / "film.mp4", turn, [frame] * 3)
    first = listed(tmp_path / "film.mp4")[0]
    assert abs(grey(first).astype(int) - frame).mean() < 5
    shown = cv2.VideoCapture(str(tmp_path / "film.mp4")).read()[1][..., 0]  # OpenCV turns it by itself
    assert grey(first, "upright").shape == shown.shape
    assert abs(grey(first, "upright").astype(int) - shown).mean() < 5


@pytest.mark.parametrize("answer", [-1.0, 0.0, 45.0, 360.0])
def test_frames_are_not_turned_where_nothing_tells_how(
    tmp_path: Path, answer: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV answers -1 where it reads a video by something else than FFmpeg."""
    frame = np.zeros((48, 64), np.uint8)
    frame[:24, :32] = 255
    film(tmp_path / "film.mp4", 0, [frame] * 3)

    class Capture:
        def __init__(self, name: str) -> None:
            self.whole = opened(name)

        def get(self, what: int) -> float:
            return answer if what == cv2.CAP_PROP_ORIENTATION_META else self.whole.get(what)

        def __getattr__(self, name: str) -> object:
            return getattr(self.whole, name)

    opened = cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    first = listed(tmp_path / "film.mp4")[0]
    np.testing.assert_array_equal(grey(first, "upright"), grey(first))


def test_the_size_of_views_is_that_of_upright_frames(tmp_path: Path) -> None:
    squares = np.kron(np.indices((5, 6)).sum(axis=0) % 2, np.ones((32, 32))).astype(np.uint8) * 255
    frame = cv2.copyMakeBorder(squares, 32, 32, 48, 48, cv2.BORDER_CONSTANT, value=255)
    film(tmp_path / "film.mp4", 90, [frame] * 3)
    board = dp.Chessboard(5, 4)
    assert dp.detect(tmp_path / "film.mp4", board).size == (288, 224)
    assert dp.detect(tmp_path / "film.mp4", board, orientation="upright").size == (224, 288)


def test_videos_of_the_web_and_of_camcorders_are_videos(tmp_path: Path) -> None:
    film(tmp_path / "film.mp4", 0, [np.full((48, 64), 90, np.uint8)] * 3)
    for suffix in (".webm", ".MTS", ".wmv", ".3gp"):
        other = (tmp_path / "film.mp4").rename(tmp_path / f"film{suffix}")
        assert listed(other, 1)[2].name == f"film{suffix} frame 2"
        other.rename(tmp_path / "film.mp4")


@pytest.mark.parametrize("every", [None, 3])
def test_a_video_that_was_cut_short_is_told(tmp_path: Path, every: int | None) -> None:
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video")
    for n in range(30):
        writer.write(np.full((48, 64, 3), 5 * n, np.uint8))
    writer.release()
    assert len(listed(path, every)) == (30 if every is None else 10)  # a warning would fail here
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.warns(UserWarning, match=r"reads \d+ of the 30 frames that the file tells of; it may be cut short"):
        frames = listed(path, every)
    assert 1 <= len(frames) < 16
