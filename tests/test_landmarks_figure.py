"""The picture of landmarks: names do not cover each other where there is room."""

import itertools
import time

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg

import diffproj as dp
from diffproj import figures, landmarks_figure


@pytest.mark.parametrize("size", [(1920, 1080), (1080, 1920), (640, 480)])
def test_names_beside_close_landmarks_do_not_cover_each_other(size: tuple[int, int]) -> None:
    """Each stood on the right, over its neighbour's."""
    width, height = size
    camera = dp.Camera([[1000.0, 0, width / 2], [0, 1000, height / 2], [0, 0, 1]], size=size)
    u = torch.tensor([0.2, 0.235, 0.5, 0.54, 0.8, 0.83, 0.5, 0.3], dtype=torch.float64) * width
    v = torch.tensor([0.3, 0.3, 0.5, 0.51, 0.6, 0.61, 0.9, 0.8], dtype=torch.float64) * height
    pixels = torch.stack([u, v], dim=-1)
    depth = torch.linspace(5, 9, 8, dtype=torch.float64)[:, None]
    _, directions, _ = camera.rays(pixels)
    landmarks = dp.Landmarks(depth * directions, names=[f"post no. {n}" for n in range(8)])
    located = dp.locate(dp.Views(pixels[None], size=size), landmarks, camera)
    figure = figures.landmarks(located)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    texts = figure.axes[0].texts
    assert [text.get_text() for text in texts] == [f"post no. {n}" for n in range(8)]
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in texts]
    for one, other in itertools.combinations(boxes, 2):
        assert not one.overlaps(other)


def test_many_names_are_placed_in_a_moment() -> None:
    """1000 took 13 s of one core, pair by pair."""
    places = np.random.default_rng(0).uniform(0, 600, (1000, 2))
    begin = time.process_time()
    sides = landmarks_figure._sides([str(n) for n in range(1000)], places)
    assert time.process_time() - begin < 2.5
    assert len(sides) == 1000
    assert set(sides) == set(landmarks_figure.SIDES)
