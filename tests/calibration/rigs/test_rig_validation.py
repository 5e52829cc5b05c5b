"""`cross_validate_rig`: what is held out is what a loop by hand gives, and nothing is said of what nobody saw."""

import pytest
import torch

import diffproj as dp
from tests.calibration.rigs.rig_scenes import Scene, scene

D = torch.float64
BOARD = dp.Chessboard()


@pytest.fixture(scope="module")
def two() -> Scene:
    return scene(2, 12, missing=0.0, seed=1)


def by_hand(rig: dp.RigCalibration, true: Scene, moments: list[str]) -> float:
    """RMS error in pixels at some moments, with poses from every second corner of both cameras, by Gauss and Newton."""
    points, squares, count = true.board.points.to(D), 0.0, 0
    for moment in moments:
        shown = [(rig.cameras[name], views.pixels[views.names.index(moment)]) for name, views in true.views.items()]
        number = int(moment.removeprefix("moment "))
        for hidden in (torch.arange(54) % 2 == 1, torch.arange(54) % 2 == 0):

            def off(pose: torch.Tensor, which: torch.Tensor, shown=shown, number=number) -> torch.Tensor:  # type: ignore[no-untyped-def]
                turn = torch.linalg.matrix_exp(torch.stack([_cross(pose[:3])])[0])
                placed = points[which] @ (turn @ true.R[number]).mT + true.t[number] + pose[3:]
                return torch.cat([(camera.project(placed)[0] - uv[which]).flatten() for camera, uv in shown])

            pose = torch.zeros(6, dtype=D)
            for _ in range(8):
                J = torch.autograd.functional.jacobian(lambda x, hidden=hidden, off=off: off(x, ~hidden), pose)
                pose = pose - torch.linalg.lstsq(J, off(pose, ~hidden).unsqueeze(-1)).solution.squeeze(-1)
            left = off(pose, hidden)
            squares, count = squares + float(left.square().sum()), count + len(left) // 2
    return (squares / count) ** 0.5


def _cross(v: torch.Tensor) -> torch.Tensor:
    zero = torch.zeros_like(v[0])
    return torch.stack([zero, -v[2], v[1], v[2], zero, -v[0], -v[1], v[0], zero]).unflatten(0, (3, 3))


@pytest.mark.slow
def test_folds_are_what_a_loop_by_hand_gives(two: Scene) -> None:
    found = dp.cross_validate_rig(two.views, two.board, folds=3)
    order = list(dict.fromkeys(name for views in two.views.values() for name in views.names))
    for fold, fit in enumerate(found.fits):
        held = [moment for i, moment in enumerate(order) if i % 3 == fold]
        assert float(found.held_out_px[fold]) == pytest.approx(by_hand(fit, two, held), rel=1e-6)
        assert float(found.in_sample_px[fold]) == pytest.approx(fit.rms, rel=1e-9)


def test_of_a_fold_without_corners_enough_nothing_is_said(two: Scene) -> None:
    """Six corners of a view are three and three, which tell no pose. It was an error of 0 px, and so lowered the mean."""
    views = {}
    for name, own in two.views.items():
        visible = own.visible.clone()
        for row, moment in enumerate(own.names):
            if int(moment.removeprefix("moment ")) % 4 == 1:
                visible[row] &= torch.isin(torch.arange(54), torch.tensor([0, 3, 18, 30, 47, 33]))
        views[name] = dp.Views(own.pixels, visible, own.names, size=own.size)
    found = dp.cross_validate_rig(views, two.board, folds=4)
    assert found.held_out_px.isnan().tolist() == [False, True, False, False]
    assert found.held_out_world.isnan().tolist() == [False, True, False, False]
    assert found.in_sample_px.isfinite().all()
    assert "nan" in found.summary()
    total = float(found.held_out_px[[0, 2, 3]].square().mean().sqrt())
    assert f"held out RMS {total:.4f} px" in repr(found)  # NaN, as that of one fold, before
    assert "1 of 4 folds not evaluated" in repr(found)
    *_, all_folds, remark = found.summary().splitlines()
    assert all_folds.split()[2] == f"{total:.4f}"
    assert remark.startswith("1 of 4 folds not evaluated")


def test_with_a_robust_loss_poses_are_found_by_it() -> None:
    """A corner 30 px off counts for itself, 900 px^2 in each half: by least squares the pose went along, for 67 more."""
    pair = {name: dp.example_views(name) for name in ("left", "right")}
    pixels = pair["left"].pixels.to(D).clone()
    pixels[4, 20] += 30.0
    wrong = pair | {"left": dp.Views(pixels, pair["left"].visible, pair["left"].names, pair["left"].size)}
    off = dp.cross_validate_rig(wrong, BOARD, folds=3, loss=dp.Huber(0.3)).held_out_px[1]
    assert float(off.square()) * 2 * 4 * 54 == pytest.approx(1819, abs=5)  # the corners of 4 moments


def test_a_refit_that_did_not_converge_has_no_error() -> None:
    pair = {name: dp.example_views(name) for name in ("left", "right")}
    rig = dp.calibrate_rig(pair, BOARD)
    found = dp.cross_validate_rig(pair, BOARD, folds=2, cameras=rig, max_iterations=4, throw=False)
    assert not any(fit.converged for fit in found.fits)
    assert (
        torch.stack([found.held_out_px, found.in_sample_px, found.held_out_world, found.in_sample_world]).isinf().all()
    )
