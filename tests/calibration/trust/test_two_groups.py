"""Photographs of two cameras in one calibration are told, and those of one are not accused."""

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic
from tests.calibration.trust.smooth_errors import seen_at_random, with_smooth_errors

BOARD = dp.Chessboard()
TOLD = "want another camera than the other views"
SIZE = (640, 480)
CAMERA = dp.Camera(
    torch.tensor([[530.0, 0, 320], [0, 532, 240], [0, 0, 1]], dtype=torch.float64),
    distortion=dp.BrownConrady(torch.tensor([-0.28, 0.1, 0.001, -0.0005, -0.02], dtype=torch.float64)),
    size=SIZE,
)


def pixels(name: str) -> Tensor:
    return dp.example_views(name).pixels.clone()


def zoomed(seen: Tensor, which: slice, by: float) -> Tensor:
    middle = torch.tensor([319.5, 239.5], dtype=seen.dtype)
    seen[..., which, :, :] = (seen[..., which, :, :] - middle) * by + middle
    return seen


def calibrated(seen: Tensor, **options: object) -> dp.Calibration:
    return dp.calibrate(dp.Views(seen, size=SIZE), BOARD, **options)  # type: ignore[arg-type]


MIXED = {
    "two cameras": (lambda: torch.cat([pixels("left"), pixels("right")]), range(13)),
    "a few of the other": (lambda: torch.cat([pixels("left")[:9], pixels("right")[:4]]), range(9, 13)),
    "two of another zoom": (lambda: zoomed(pixels("left"), slice(3, 5), 1.1), range(3, 5)),
    "a zoom that was touched": (lambda: zoomed(pixels("right"), slice(6, None), 1.05), range(6)),
}


@pytest.mark.parametrize("kind", MIXED)
def test_photographs_of_two_cameras_are_told(kind: str) -> None:
    mixed, smaller = MIXED[kind]
    found = calibrated(mixed())
    (remark,) = found.remarks
    names = [f"view {number + 1}" for number in smaller]
    named = names if len(names) <= 5 else [*names[:5], f"{len(names) - 5} more"]
    assert f"{', '.join(named[:-1])} and {named[-1]} {TOLD}" in remark
    assert "as through another lens" not in remark
    assert found.verdict.startswith("Weak: ")
    assert "two groups" in found.verdict


@pytest.mark.parametrize("name", ["left", "right"])
@pytest.mark.parametrize("model", ["none", "brown4", "brown5", "fisheye"])
def test_photographs_of_one_are_not_accused(name: str, model: str) -> None:
    assert TOLD not in calibrated(pixels(name), distortion=model).remarks[0]


@pytest.mark.parametrize("count", [6, 8, 10])
def test_nor_are_some_of_them(count: int) -> None:
    chosen = [torch.randperm(13, generator=torch.Generator().manual_seed(seed))[:count] for seed in range(12)]
    for name in ("left", "right"):
        found = calibrated(torch.stack([pixels(name)[some] for some in chosen]), throw=False)
        assert not any(TOLD in remark for remark in found.remarks)


def simulated(views: int, cameras: int) -> dp.Views:
    true = synthetic.random_cameras(CAMERA, BOARD, cameras * views, seed=views)
    posed = CAMERA.at(true.R.unflatten(0, (cameras, views)), true.t.unflatten(0, (cameras, views)))
    return synthetic.corner_views(posed, BOARD, noise_px=0.2)


def test_noise_is_no_second_camera() -> None:
    for views in (6, 9, 20):
        assert not any(TOLD in remark for remark in dp.calibrate(simulated(views, 30), BOARD).remarks)


def test_of_cameras_side_by_side_those_are_told_that_are_mixed() -> None:
    sets = [
        pixels("left"),
        zoomed(pixels("left"), slice(6, None), 1.05),
        pixels("right"),
        torch.cat([pixels("left")[:9], pixels("right")[:4]]),
    ]
    found = calibrated(torch.stack(sets))
    assert [TOLD in remark for remark in found.remarks] == [False, True, False, True]
    assert found.remarks[1] == calibrated(sets[1]).remarks[0]


def test_fewer_views_or_a_shape_that_is_free_are_not_judged() -> None:
    seen = zoomed(pixels("left")[:5], slice(0, 2), 1.05)
    assert TOLD not in calibrated(seen, throw=False).remarks[0]
    seen = zoomed(pixels("left"), slice(6, None), 1.05)
    assert TOLD not in calibrated(seen, shape="free", throw=False).remarks[0]


def test_few_that_were_cropped_or_zoomed_are_told_beside_noise() -> None:
    """Where noise is most of the sum of squares, two groups are told by saving nearly all that there is to save."""
    wide = dp.Camera(CAMERA.K * torch.tensor([[2.0], [2], [1]], dtype=CAMERA.dtype), None, None, CAMERA.distortion)
    true = synthetic.random_cameras(dp.Camera(wide.K, distortion=wide.distortion, size=(1280, 960)), BOARD, 13, seed=1)
    seen = synthetic.corner_views(true, BOARD, noise_px=0.15).pixels
    for changed in (seen[3:7] + torch.tensor([40.0, 0.0]), (seen[3:7] - 640) * 1.03 + 640):
        mixed = torch.cat([seen[:3], changed, seen[7:]])
        (remark,) = dp.calibrate(dp.Views(mixed, size=(1400, 1000)), BOARD).remarks
        assert f"view 4, view 5, view 6 and view 7 {TOLD}" in remark


@pytest.mark.parametrize("views", [6, 8])
def test_errors_that_go_together_within_a_view_are_no_second_camera(views: int) -> None:
    """Of 0.3 px: 19 and 9 of 60 sets were accused where half of what a camera for each view saves was enough, now none."""
    seen = with_smooth_errors(seen_at_random(CAMERA, BOARD, 60, views), BOARD.points, 0.3)
    assert sum(TOLD in remark for remark in dp.calibrate(seen, BOARD, throw=False).remarks) <= 2  # type: ignore[union-attr]
