"""What is found from evidence in `torch.inference_mode`, which takes no derivatives, is what is found outside of it."""

from types import SimpleNamespace
from typing import NamedTuple

import pytest
import torch

import diffproj as dp

D = torch.float64
SIZE = (1280, 960)
Scene = tuple[dp.Camera, torch.Tensor, torch.Tensor]


def scene() -> Scene:
    """A camera, four landmarks on the ground, and their pixels, a little off."""
    camera = dp.Camera.mounted(6.0, 20.0, 1.5, 1.0, position=[2.0, -1.0], focal=900.0, size=SIZE)
    points = torch.tensor([[0.0, 12, 0], [6, 20, 0], [-3, 25, 0], [8, 30, 0]], dtype=D)
    return camera, points, camera.project(points)[0] + torch.tensor([[0.5, -0.3], [-0.3, 0.2], [0.1, 0.4], [-0.5, 0]])


GIVEN = scene()


class Place:
    """An observation of one's own."""

    def __init__(self) -> None:
        self.place = torch.tensor([2.0, -1.0, 6.0], dtype=D)

    def residuals(self, camera: dp.Camera) -> torch.Tensor:
        return ((camera.center - self.place) / 0.3).unsqueeze(-2)


def of_priors(scene: Scene) -> dp.Calibration:
    return dp.adjust(scene[0], priors={"mounting": 1.0})


def of_landmarks(scene: Scene) -> dp.Calibration:
    return dp.adjust(scene[0], dp.Seen(scene[1], scene[2]), free=["focal"], priors={"tilt": 1.0})


def of_all(scene: Scene) -> dp.Calibration:
    camera, points, pixels = scene
    up = pixels - torch.tensor([0.0, 60], dtype=D)
    seen = [
        dp.Seen(points, pixels, sigma=0.1),
        dp.Heights(pixels, up, 1.7, 0.5, pixel_sigma=1.0),
        dp.Lengths(pixels[:1], pixels[1:2], 10.0, 1.0, pixel_sigma=1.0),
        dp.Horizon(pixels - torch.tensor([0.0, 300], dtype=D), 50.0),
        dp.Coplanar(points[:, :2], pixels, 5.0),
        dp.VanishingPoints(["y"], pixels[:1], pixel_sigma=1e3),
        Place(),
    ]
    return dp.adjust(camera, seen, priors={"focal": (torch.tensor(900.0, dtype=D), 20.0)})


def of_a_view(scene: Scene) -> dp.Calibration:
    camera, points, pixels = scene
    views, landmarks = dp.Views(pixels[None], size=SIZE), dp.Landmarks(points, sigma=0.05)
    return dp.locate(views, landmarks, camera, pixel_sigma=1.0, priors={"height": 0.1, "tilt": 0.5})


@pytest.mark.filterwarnings("ignore")  # remarks on few landmarks
@pytest.mark.parametrize("find", [of_priors, of_landmarks, of_all, of_a_view])
def test_inference_mode_changes_nothing(find: object) -> None:
    """Deviations from priors were 0 there, and landmarks no evidence."""

    def figures(found: dp.Calibration) -> list[torch.Tensor]:
        measured = dp.measure([[640.0, 700.0]], found, dp.Plane.z(0.0), pixel_sigma=1.0)
        more = [found.mounting_covariance] if isinstance(found, dp.Adjustment) else []
        return [found.cameras.t, found.covariance.about_middle.view(0), measured.deviations, *more]

    outside = find(scene())  # type: ignore[operator]
    want = figures(outside)
    assert bool((want[2][0, :2] > 0.01).all())
    with torch.inference_mode():
        told_outside, given_outside, all_inside = figures(outside), figures(find(GIVEN)), figures(find(scene()))  # type: ignore[operator]
    for got in (told_outside, given_outside, all_inside):
        torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-12)


class Told(NamedTuple):
    """The same as a tuple."""

    place: torch.Tensor
    weight: torch.Tensor

    def residuals(self, camera: dp.Camera) -> torch.Tensor:
        return ((camera.center - self.place) * self.weight).unsqueeze(-2)


class Deep:
    """The same with its tensors where they are not looked for."""

    def __init__(self, place: torch.Tensor, weight: torch.Tensor, clone: bool = False) -> None:
        self.inner, self.clone = SimpleNamespace(place=place, weight=weight), clone

    def residuals(self, camera: dp.Camera) -> torch.Tensor:
        weight = self.inner.weight.clone() if self.clone else self.inner.weight
        return ((camera.center - self.inner.place) * weight).unsqueeze(-2)


def test_tensors_of_an_observation_of_ones_own_are_told_of_or_copied() -> None:
    """PyTorch spoke of saving them for backward."""

    def spread(observation: dp.Observation) -> torch.Tensor:
        known = {"tilt": 1.0, "roll": 1.0, "heading": 1.0}
        return dp.adjust(GIVEN[0], [observation], priors=known).mounting_covariance

    place, weight = torch.tensor([2.0, -1.0, 6.0], dtype=D), torch.full((3,), 2.0, dtype=D)
    want = spread(Deep(place, weight))
    with torch.inference_mode():
        place, weight = place + 0, weight + 0
        for each in (Told(place, weight), Deep(place, weight, clone=True)):
            torch.testing.assert_close(spread(each), want)
        with pytest.raises(
            ValueError, match=r"Deep.residuals: want .*make its tensors outside of inference_mode, or cl"
        ):
            spread(Deep(place, weight))
