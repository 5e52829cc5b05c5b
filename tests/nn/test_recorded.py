"""What is recorded while it runs with an example (`torch.jit.trace`, `make_fx`) holds for other pixels and cameras too."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

import diffproj as dp

D = torch.float64
K = torch.tensor([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]], dtype=D)
T = torch.tensor([0.1, 0.2, 8], dtype=D)
LENSES = {
    "pinhole": None,
    "brown": dp.BrownConrady(torch.tensor([-0.2, 0.05, 1e-3, -2e-3, 0], dtype=D)),
    "fisheye": dp.KannalaBrandt(torch.tensor([0.05, -0.01, 0, 0], dtype=D)),
}
SOME = torch.tensor([[100.0, 50], [400, 300], [310, 250]], dtype=D)

pytestmark = [
    pytest.mark.filterwarnings("ignore::torch.jit.TracerWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


def traced(function: Callable[[Tensor], Tensor], example: Tensor) -> Any:
    return torch.jit.trace(function, (example,), check_trace=False)


def followed(function: Callable[[Tensor], Tensor], example: Tensor) -> Callable[[Tensor], Tensor]:
    return make_fx(function)(example)


def of_pixels(lens: dp.Lens | None) -> dict[str, Callable[[Tensor], Tensor]]:
    camera, plane = dp.Camera(K, t=T, distortion=lens, size=(640, 480)), dp.Plane.z(0.0)
    to_plane, frozen = dp.PlaneMap(camera, plane), dp.PlaneProjector(camera, plane)
    held = dp.PlaneProjector(camera, plane, ("focal", "pose")).requires_grad_(False)
    return {
        "map": lambda pixels: to_plane(pixels)[0],
        "frozen projector": lambda pixels: frozen(pixels)[0],
        "held projector": lambda pixels: held(pixels)[0],
        "back_project": lambda pixels: dp.back_project(pixels, camera, plane)[0],
        "rays": lambda pixels: camera.rays(pixels)[1],
        "resolution": lambda pixels: to_plane.resolution(pixels)[0],
        "miss": lambda pixels: to_plane.miss(20 * pixels),
        "explain": lambda pixels: to_plane.explain(20 * pixels),
    }


@pytest.mark.parametrize("lens", LENSES)
def test_a_recording_is_for_other_pixels(lens: str) -> None:
    example, pixels = SOME.repeat(20, 1), SOME.flip(0).repeat(20, 1) * 1.2 - 30
    for name, function in of_pixels(LENSES[lens]).items():
        for record in (traced, followed) if name == "map" else (traced,):
            off = record(function, example)(pixels) - function(pixels)
            assert off.abs().max() < 1e-9, (name, record)


@pytest.mark.parametrize("record", [traced, followed])
def test_a_recording_is_for_other_cameras(record: Callable) -> None:
    by_lens = LENSES["brown"].coefficients
    functions = {
        "K": lambda factor: dp.back_project(SOME, dp.Camera(K * factor[:, None], t=T), dp.Plane.z(0.0))[0],
        "warp": lambda factor: dp.Camera(K, t=T).warped(torch.diag(factor)).K,
        "plane": lambda factor: dp.back_project(SOME, dp.Camera(K, t=T), dp.Plane(factor, factor[0]))[0],
        "lens": lambda factor: dp.back_project(
            SOME, dp.Camera(K, t=T, distortion=dp.BrownConrady(by_lens * factor[0])), dp.Plane.z(0.0)
        )[0],
    }
    example, other = torch.tensor([1.0, 1, 1], dtype=D), torch.tensor([1.2, 1.1, 1], dtype=D)
    for name, function in functions.items():
        off = record(function, example)(other) - function(other)
        assert off.abs().max() < 1e-9, name


def test_a_traced_projector_takes_other_numbers_of_pixels() -> None:
    projector = dp.PlaneProjector(dp.Camera(K, t=T, distortion=LENSES["brown"]), dp.Plane.z(0.0))
    recorded: Any = torch.jit.trace(projector, (SOME,), check_trace=False)
    for pixels in (SOME[:1], SOME.repeat(2000, 1)):
        points, valid = recorded(pixels)
        torch.testing.assert_close(points, projector(pixels)[0])
        assert bool(valid.all())


@pytest.mark.plain  # lengths are tensors in a recording
def test_a_recorded_top_view_is_of_other_places_too() -> None:
    """Which part of it shows something, and how many samples a pixel takes, would be those of the example."""
    image, extent, resolution = torch.rand(1, 48, 64, dtype=D), (-8.0, -8.0, 8.0, 8.0), 0.5
    small = dp.Camera(K / torch.tensor([[10.0], [10], [1]], dtype=D), size=(64, 48))

    def top(t: Tensor) -> Tensor:
        return dp.rectify(image, small.at(small.R, t), dp.Plane.z(0.0), extent, resolution)[0]

    def of_one(t: Tensor) -> Tensor:
        return dp.rectify(image, small.at(small.R, t), dp.Plane.z(0.0), extent, resolution, samples=1)[0]

    example, other = (torch.tensor([x, 0.0, 8], dtype=D) for x in (-4.0, 4.0))
    for record in (traced, followed):
        with pytest.raises(ValueError, match="samples: want how many a pixel takes"):
            record(top, example)
        assert (record(of_one, example)(other) - of_one(other)).abs().max() < 1e-5  # sides are float32 in a trace
