"""What iterates to a minimum reads values: under the transforms of `torch.func` it says so, and what to do instead."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

import diffproj as dp

D = torch.float64
BOARD, VIEWS = dp.Chessboard(), dp.example_views("left")[:5]
ALSO = dp.example_views("right")[:5]
MOMENTS = {"left": range(5), "right": range(5)}
LANDMARKS = torch.tensor([[6.0, 10, 0], [8, 14, 0], [5, 12, 0], [3, 9, 0]], dtype=D)
ROUGH = dp.Camera(torch.tensor([[530.0, 0, 320], [0, 530, 240], [0, 0, 1]], dtype=D), size=(640, 480))


def views(pixels: torch.Tensor) -> dp.Views:
    return dp.Views(pixels, VIEWS.visible, size=(640, 480))


@pytest.fixture(scope="module")
def rig() -> dp.RigCalibration:
    return dp.calibrate_rig({"left": VIEWS, "right": ALSO}, BOARD, "none", moments=MOMENTS)


CALLS: dict[str, Callable[[torch.Tensor, dp.RigCalibration], Any]] = {
    "calibrate": lambda pixels, _: dp.calibrate(views(pixels), BOARD, "none").camera.K,
    "refine": lambda pixels, _: dp.refine(views(pixels), BOARD, ROUGH, differentiable=True).camera.K,
    "locate": lambda pixels, _: dp.locate(views(pixels), BOARD, ROUGH).cameras.t,
    "calibrate_rig": lambda pixels, _: dp.calibrate_rig(
        {"left": views(pixels), "right": ALSO}, BOARD, "none", moments=MOMENTS
    )["right"],
    "adjust": lambda pixels, _: (
        dp.adjust(
            dp.Camera.mounted(6.0, 20.0, fov_deg=70.0, size=(640, 480)), dp.Seen(LANDMARKS, pixels[0, :4], 1.0)
        ).camera.t
    ),
    "triangulate": lambda pixels, rig: rig.triangulate({"left": pixels[0], "right": ALSO.pixels[0]}).points,
}
TRANSFORMS: dict[str, Callable[[Callable[[torch.Tensor], torch.Tensor]], Any]] = {
    "grad": lambda call: torch.func.grad(lambda pixels: call(pixels).sum())(VIEWS.pixels),
    "jvp": lambda call: torch.func.jvp(call, (VIEWS.pixels,), (VIEWS.pixels,)),
    "vmap": lambda call: torch.vmap(call)(VIEWS.pixels.expand(2, *VIEWS.pixels.shape)),
}


@pytest.mark.plain
@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("name", CALLS)
def test_a_transform_is_refused(name: str, transform: str, rig: dp.RigCalibration) -> None:
    with pytest.raises(ValueError, match="want a call outside of torch.func's transforms"):
        TRANSFORMS[transform](lambda pixels: CALLS[name](pixels, rig))
