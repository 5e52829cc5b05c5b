"""`refine` on few landmarks: the lowest minimum, whichever pose the camera as given explains best."""

import pytest
import torch

import diffproj as dp
from tests.cli.test_cli_fov import yard

PRIORS = {"focal": (1300.0, 190.0), "c_x": (959.5, 38.4), "c_y": (539.5, 38.4), "k1": (0.0, 0.2), "k2": (0.0, 0.13)}


def start() -> dp.Camera:
    K = [[1300.0, 0, 959.5], [0, 1300.0, 539.5], [0, 0, 1]]
    return dp.Camera.from_opencv(K, [0.0, 0.0, 0.0, 0.0], size=(1920, 1080))


def cost(camera: dp.Camera, points: torch.Tensor, pixels: torch.Tensor) -> float:
    """What is minimised, from the projection and the priors alone; infinite where a landmark is beyond the lens."""
    projected, valid = camera.project(points)
    assert isinstance(camera.distortion, dp.BrownConrady)
    values = [camera.K[0, 0], *camera.K[:2, 2], *camera.distortion.coefficients[:2]]
    off = [(float(value) - mean) / sigma for value, (mean, sigma) in zip(values, PRIORS.values(), strict=True)]
    assert bool(valid.all())
    return float((projected - pixels).square().sum()) / 2 + sum(one**2 for one in off) / 2


@pytest.mark.parametrize(("seed", "count"), [(12, 4), (14, 4), (4, 6)])
def test_few_landmarks_nearly_on_a_line_end_no_higher_than_from_the_truth(seed: int, count: int) -> None:
    # From the pose alone that fits best with the camera as given: 1.52, a fold inside the landmarks, and 37.
    truth, points, pixels = yard(seed, count, -0.1)
    views, target = dp.Views([pixels], size=(1920, 1080)), dp.Landmarks(points)
    known = {"priors": PRIORS, "fixed": ("p1", "p2"), "tied_focal": True, "pixel_sigma": 1.0}
    found = dp.refine(views, target, start(), **known)
    at_truth = dp.refine(views, target, truth[None], **known)  # a pose that is given is the start
    reached, best = (cost(one.cameras[0], points, pixels) for one in (found, at_truth))
    assert reached <= best + 1e-6


def test_a_batch_gives_what_a_loop_gives() -> None:
    scenes = [yard(seed, 4, -0.1) for seed in (12, 13, 14)]
    points = scenes[0][1]
    pixels = torch.stack([scene[2] for scene in scenes]).unsqueeze(1)
    pixels[1:] = pixels[:1] + torch.tensor([[[[3.0, -2.0]]], [[[-5.0, 4.0]]]], dtype=torch.float64)
    known = {"priors": PRIORS, "fixed": ("p1", "p2"), "tied_focal": True, "pixel_sigma": 1.0, "throw": False}
    views = dp.Views(pixels, size=(1920, 1080))
    together = dp.refine(views, dp.Landmarks(points), start(), **known)
    for i in range(3):
        alone = dp.refine(dp.Views(pixels[i], size=(1920, 1080)), dp.Landmarks(points), start(), **known)
        torch.testing.assert_close(together.cameras.K[i], alone.cameras.K, rtol=1e-6, atol=1e-6)
