"""A camera that is built with height and width as its size is warned of, and no other."""

import warnings

import numpy as np
import pytest
import torch

import diffproj as dp


def K(c_x: float, c_y: float) -> torch.Tensor:
    return torch.tensor([[900.0, 0, c_x], [0, 900, c_y], [0, 0, 1]], dtype=torch.float64)


@pytest.mark.parametrize(("size", "c"), [((960, 1280), (648, 487)), ((1080, 1920), (959.5, 539.5))])
def test_height_and_width_are_warned_of(size: tuple[int, int], c: tuple[float, float]) -> None:
    said = r"size: want \(width, height\), got \(\d+, \d+\), which looks like height and width: c is"
    with pytest.warns(UserWarning, match=said):
        camera = dp.Camera(K(*c), size=size)
    assert camera.size == size
    with pytest.warns(UserWarning, match=said):
        dp.Camera.from_opencv(K(*c).numpy(), np.zeros(5), size=size)
    with pytest.warns(UserWarning, match=said):
        dp.Camera(torch.stack([K(*c)] * 3), size=size)


def test_parts_of_images_and_turned_ones_are_not() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        camera = dp.Camera(K(648, 487), size=(1280, 960))
        dp.Camera(K(472, 648), size=(960, 1280))  # turned, with its K
        dp.Camera(torch.eye(3), size=(480, 640))
        dp.Camera(torch.zeros(0, 3, 3), size=(480, 640))
        for tall in (camera.cropped(5, 0, 960, 1280), camera.cropped(0, 0, 400, 900)):
            tall.at(torch.eye(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64))
            dp.Camera(tall.K[None], size=(400, 900))


def test_parts_that_users_cut_themselves_are_seldom_warned_of() -> None:
    """1500 parts of all places, shapes and sizes: 4 were warned of, as measured."""
    generator = np.random.default_rng(1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(1500):
            whole = np.array([(640, 480), (1920, 1080), (4000, 3000), (480, 640)][generator.integers(4)])
            part = (generator.uniform(0.1, 1, 2) * whole).astype(int) + 1
            c = whole / 2 * (1 + 0.04 * generator.standard_normal(2)) - generator.uniform(0, 1, 2) * (whole - part)
            dp.Camera(K(*c), size=(int(part[0]), int(part[1])))
    assert len(caught) <= 4
