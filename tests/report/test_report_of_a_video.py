"""The measuring page in the report of a video, whose frames may lie another way than they are shown."""

import base64
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

import diffproj as dp
from diffproj.report.write import report
from diffproj.targets.images import Orientation, Photograph
from diffproj.targets.videos import Frame


@pytest.mark.parametrize("orientation", ["sensor", "upright"])
@pytest.mark.parametrize("turn", [90, 180, 270])
def test_the_page_measures_in_the_frame_as_its_pixels_were_counted(turn: int, orientation: Orientation) -> None:
    board = dp.Chessboard()
    views = dp.example_views("left")[:4]
    assert views.size is not None
    width, height = views.size
    shown = np.zeros((height, width), np.uint8)
    shown[: height // 2, : width // 2], shown[height // 2 :, : width // 2] = 250, 120
    recorded = np.rot90(shown, turn // 90) if orientation == "upright" else shown
    png = cv2.imencode(".png", recorded)[1].tobytes()
    frames = [Photograph(name, name, Frame(Path("film.mp4"), 0, png, turn, None)) for name in views.names]
    page = report(dp.calibrate(views, board, "none"), frames, orientation=orientation)
    found = re.search(r'id="m-image"[^>]*src="data:image/jpeg;base64,([^"]*)"', page)
    assert found is not None
    image = np.asarray(cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_GRAYSCALE))
    assert image.shape == (height, width)
    assert abs(image.astype(int) - shown).mean() < 1
