"""Halves of the corners of a view: one tells the pose, the other is evaluated; also where boards are seen in part."""

import pytest
import torch

import diffproj as dp
from diffproj.calibration.held_out import halves

D = torch.float64
BOARD = dp.CharucoBoard(9, 7, square=60.0, marker=45.0, dictionary="5X5_100")
"""8 x 6 corners: every second corner is every second column."""
TWO_COLUMNS = torch.arange(48) % 8 < 2


def seen(part: torch.Tensor, view: int = 3, moments: int = 16, seed: int = 0) -> dp.Views:
    """Views of all of the board, and one of a part of it `(N,)`."""
    camera = dp.Camera(
        torch.tensor([[1024.0, 0, 640], [0, 1030, 475], [0, 0, 1]], dtype=D),
        distortion=dp.BrownConrady(torch.tensor([-0.2, 0.08, 5e-4, -4e-4, -0.01], dtype=D)),
        size=(1280, 960),
    )
    cameras = dp.synthetic.random_cameras(camera, BOARD, moments, distance=(2.0, 4.0), seed=seed)
    whole = dp.synthetic.corner_views(cameras, BOARD, noise_px=0.2, seed=seed)
    visible = whole.visible.clone()
    visible[view] &= part
    return dp.Views(whole.pixels, visible, [f"{i:02d}.png" for i in range(moments)], size=camera.size)


def test_every_second_corner_where_that_tells_a_pose() -> None:
    views = dp.example_views("left")
    odd = (torch.arange(54) % 2 == 1).expand(13, 54)
    one, other = halves(views, dp.Chessboard().points)
    for half, out in ((one, odd), (other, ~odd)):
        assert torch.equal(half.hidden, out)
        assert torch.equal(half.evaluated, out)


def test_no_half_of_two_columns_lies_on_a_line() -> None:
    views = seen(TWO_COLUMNS)
    one, other = halves(views, BOARD.points)
    assert torch.equal(one.evaluated, ~other.evaluated)
    for half in (one, other):
        assert torch.equal(half.hidden, half.evaluated)
        columns = (torch.arange(48) % 8)[views.visible[3] & ~half.hidden[3]]
        assert columns.unique().tolist() == [0, 1]
        assert len(columns) == 6


def test_no_pose_is_told_from_corners_on_a_line() -> None:
    """Ten corners, all but one in a row: in whichever order they are taken, one half is on the row."""
    part = torch.arange(48) // 8 == 0
    part[17] = True
    views = seen(part)
    one, other = halves(views, BOARD.points)
    told = [int((views.visible[3] & ~half.hidden[3]).sum()) for half in (one, other)]
    assert sorted(told) == [0, 5]
    assert torch.equal(one.evaluated, ~other.evaluated)


@pytest.mark.parametrize("moments", [pytest.param(16, marks=pytest.mark.slow), 5])
def test_a_lens_is_chosen_where_a_view_shows_two_columns(moments: int) -> None:
    """None was: no lens was determined without every second corner, the table said, and "brown5" was taken for that."""
    found = dp.calibrate(seen(TWO_COLUMNS, moments=moments), BOARD, "auto")
    assert found.comparison is not None
    assert "not determined" not in found.comparison.summary()
    assert found.comparison.held_out_px.isfinite().all()


def test_two_columns_can_be_held_out() -> None:
    """It failed: "a view that was held out has no pose: ... do they lie on a line?", and likewise of a rig."""
    views = seen(TWO_COLUMNS)
    assert (dp.cross_validate(views, BOARD, folds=4).held_out_px < 0.4).all()
    pixels = views.pixels + 0.2 * torch.randn(views.pixels.shape, generator=torch.Generator().manual_seed(1), dtype=D)
    pair = {"one": views, "two": dp.Views(pixels, views.visible, views.names, size=views.size)}
    assert (dp.cross_validate_rig(pair, BOARD, folds=4).held_out_px < 0.6).all()
