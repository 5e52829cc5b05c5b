"""Rigs refined side by side: each ends as alone, whatever its mates are, in fewer solves."""

from typing import Any

import pytest
import torch

import diffproj as dp
from diffproj.calibration.least_squares import solver
from diffproj.calibration.rigs import together as rig_together
from diffproj.calibration.rigs.problem import RigProblem
from tests.calibration.rigs.rig_scenes import Scene, scene

D = torch.float64


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    """Rigs of two cameras with unlike numbers of moments, of which each camera misses some."""
    return [scene(2, moments, seed=seed) for moments, seed in ((8, 1), (9, 7), (11, 3), (14, 4), (12, 9))]


@pytest.fixture(scope="module")
def alone(scenes: list[Scene]) -> list[dp.RigCalibration]:
    return [dp.calibrate_rig(one.views, one.board) for one in scenes]


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many rigs each solve was of."""
    counts: list[int] = []
    solve = rig_together.solve

    def counted(problem: Any, shared: torch.Tensor, *given: Any, **options: Any) -> Any:
        counts.append(len(shared))
        return solve(problem, shared, *given, **options)

    monkeypatch.setattr(rig_together, "solve", counted)
    return counts


def same(one: object, other: dp.RigCalibration) -> None:
    """The same, but for the order in which sums are taken."""
    assert isinstance(one, dp.RigCalibration), one
    assert (one.status, one.iterations, one.names) == (other.status, other.iterations, other.names)
    assert one.moments == other.moments
    assert one.rms == pytest.approx(other.rms, rel=1e-11)
    for name in other.names:
        mine, its = one.cameras[name], other.cameras[name]
        for part in ("K", "R", "t"):
            assert torch.allclose(getattr(mine, part), getattr(its, part), rtol=1e-9, atol=1e-9)
        assert torch.allclose(mine.distortion.coefficients, its.distortion.coefficients, rtol=1e-7, atol=1e-9)  # type: ignore[union-attr]
        assert torch.equal(one[name].used, other[name].used)
        assert torch.equal(one[name].rejected, other[name].rejected)
    assert torch.allclose(one.points, other.points, atol=1e-7)
    assert torch.allclose(one.t_target, other.t_target, rtol=1e-9, atol=1e-7)
    assert torch.allclose(one.covariance.shared, other.covariance.shared, rtol=1e-5, atol=1e-14)
    assert one.message == other.message


@pytest.mark.slow
def test_each_ends_as_alone_in_any_order(
    scenes: list[Scene], alone: list[dp.RigCalibration], solved: list[int]
) -> None:
    board = scenes[0].board
    for one, true in zip(dp.calibrate_rig([s.views for s in scenes], board), alone, strict=True):
        same(one, true)
    assert max(solved) >= 4
    assert len(solved) < len(scenes)
    order = [3, 0, 4, 2, 1, 0]
    found = dp.calibrate_rig([scenes[i].views for i in order], board)
    for i, one in zip(order, found, strict=True):
        same(one, alone[i])
    same(found[1], found[5])  # type: ignore[arg-type]


def test_one_that_fails_leaves_the_others_as_they_are(scenes: list[Scene], alone: list[dp.RigCalibration]) -> None:
    first = scenes[2].views
    mixed = dict(first)
    mixed["cam1"] = dp.Views(
        first["cam1"].pixels.flip(0), first["cam1"].visible.flip(0), first["cam1"].names, (1280, 960)
    )
    found = dp.calibrate_rig([scenes[0].views, mixed, scenes[1].views], scenes[0].board)
    assert isinstance(found[1], dp.CalibrationError)
    same(found[0], alone[0])
    same(found[2], alone[1])


def test_rigs_of_another_structure_are_solved_by_themselves(
    scenes: list[Scene], alone: list[dp.RigCalibration], solved: list[int]
) -> None:
    three = scene(3, 10, seed=2)
    named = {f"other {name}": views for name, views in scenes[1].views.items()}
    found = dp.calibrate_rig([scenes[0].views, three.views, named, scenes[2].views], three.board)
    assert sorted(solved) == [1, 3]  # names of cameras make no difference
    same(found[0], alone[0])
    same(found[1], dp.calibrate_rig(three.views, three.board))
    same(found[3], alone[2])
    assert found[2].cameras["other cam1"].t == pytest.approx(alone[1].cameras["cam1"].t, rel=1e-9)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("options", "outliers"),
    [
        ({"reject_outliers": True}, 0.02),
        pytest.param({"loss": dp.Huber(0.5)}, 0.02, marks=pytest.mark.slow),
        pytest.param({"shape": "bow"}, 0.0, marks=pytest.mark.slow),
        pytest.param({"shape": "free", "priors": {"points": 0.1}}, 0.0, marks=pytest.mark.slow),
        pytest.param({"fixed": ("k3", "cam1.principal_point")}, 0.0, marks=pytest.mark.slow),
        (
            {
                "priors": {
                    "focal": (1000.0, 5.0),
                    "cam1.baseline": (800.0, 5.0),
                    "cam1.rotation": ([0.0, 20.0, 0.0], 30.0),
                    "cam1.center": ([800.0, 0.0, 0.0], 300.0),
                }
            },
            0.0,
        ),
        pytest.param(
            {"weights": {"cam0": 16.0, "cam1": 30.0}, "priors": {"cam1.baseline": (800.0, 5.0)}},
            0.0,
            marks=pytest.mark.slow,
        ),
    ],
    ids=["outliers", "loss", "bow", "free", "fixed", "priors", "weights"],
)
def test_options_hold_for_each(options: dict[str, Any], outliers: float, solved: list[int]) -> None:
    rigs = [scene(2, moments, seed=seed, outliers=outliers) for moments, seed in ((11, 3), (14, 4), (12, 9))]
    found = dp.calibrate_rig([one.views for one in rigs], rigs[0].board, **options)
    assert max(solved) == 3
    for one, true in zip(found, rigs, strict=True):
        same(one, dp.calibrate_rig(true.views, true.board, **options))


@pytest.mark.slow
def test_cameras_of_unlike_lenses_and_a_camera_that_is_missing(solved: list[int]) -> None:
    rigs = [scene(3, moments, missing=0.2, seed=seed) for moments, seed in ((10, 2), (12, 5), (11, 8))]
    views = [dict(one.views) for one in rigs]
    lenses = {"cam0": "brown5", "cam1": "brown4", "cam2": "fisheye"}
    for one, seen in zip(dp.calibrate_rig(views, rigs[0].board, distortion=lenses), views, strict=True):
        same(one, dp.calibrate_rig(seen, rigs[0].board, distortion=lenses))
    assert max(solved) == 3
    del views[1]["cam1"]
    solved.clear()
    found = dp.calibrate_rig(views, rigs[0].board)
    assert sorted(set(solved)) == [1, 2]
    for one, seen in zip(found, views, strict=True):
        same(one, dp.calibrate_rig(seen, rigs[0].board))


@pytest.mark.parametrize(
    "priors",
    [None, pytest.param({"cam1.baseline": (800.0, 50.0)}, marks=pytest.mark.slow)],
    ids=["", "priors"],
)
def test_the_solver_goes_on_with_those_that_still_move(
    priors: Any, scenes: list[Scene], alone: list[dp.RigCalibration], monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: list[int] = []
    part = RigProblem.part

    def noted(problem: RigProblem, which: torch.Tensor) -> RigProblem:
        counts.append(len(which))
        return part(problem, which)

    monkeypatch.setattr(RigProblem, "part", noted)
    monkeypatch.setattr(solver, "pays_to_part", lambda control: True)  # at every step, however many there are
    found = dp.calibrate_rig([one.views for one in scenes], scenes[0].board, priors=priors)
    assert len(set(counts)) > 2
    monkeypatch.undo()
    for one, true, flat in zip(found, scenes, alone, strict=True):
        same(one, flat if priors is None else dp.calibrate_rig(true.views, true.board, priors=priors))
