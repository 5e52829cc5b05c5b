"""Little evidence is explained by several poses: what `adjust` says is within its deviations, or doubted."""

import pytest
import torch

import diffproj as dp

D = torch.float64
COUNT = 60
SIZE = (1280, 960)


def camera(height: float, tilt: float, roll: float, heading: float, position: list[float]) -> dp.Camera:
    return dp.Camera.mounted(height, tilt, roll, heading, position=position, focal=1200.0, size=SIZE)


TRUE = camera(6.0, 20.0, 2.0, 30.0, [0.0, 0.0])


def noise(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=D)


def ground(pixels: list[list[float]]) -> tuple[torch.Tensor, torch.Tensor]:
    seen = torch.tensor(pixels, dtype=D)
    points, valid = dp.back_project(seen, TRUE, dp.Plane.z(0.0))
    assert bool(valid.all())
    return points, seen


def people(pixels: list[list[float]]) -> dp.Heights:
    """Of 1.7 m, more or less by 7 cm, clicked to a pixel."""
    points, feet = ground(pixels)
    tall = points.expand(COUNT, *points.shape).clone()
    tall[..., 2] = 1.7 + 0.07 * noise(0, COUNT, len(points))
    tops = TRUE.project(tall.flatten(0, 1))[0].unflatten(0, (COUNT, len(points)))
    feet = feet + noise(1, *tops.shape)
    return dp.Heights(feet, tops + noise(2, *tops.shape), 1.7, 0.07, pixel_sigma=1.0)


PEOPLE = [[200.0, 500.0], [1100.0, 420.0], [640.0, 850.0], [300.0, 800.0]]


def far_off(found: dp.Calibration) -> torch.Tensor:
    """Which cameras are more than six deviations from the truth in height, tilt or roll, and which are doubted."""
    truth, value, spread = TRUE.mounting(), found.mounting, found.mounting_deviations  # type: ignore[attr-defined]
    off = torch.stack(
        [(getattr(value, x) - getattr(truth, x)).abs() / getattr(spread, x) for x in ("height", "tilt", "roll")]
    )
    return (off > 6).any(0) & found.converged


@pytest.mark.parametrize("count", [3, 4])
def test_heights_from_a_start_far_off(count: int) -> None:
    """Measured: one and none far off, and doubted; without a look for other minima all 60 and 4, without a word."""
    start = camera(9.0, 40.0, 17.0, 30.0, [0.0, 0.0])
    found = dp.adjust(start, people(PEOPLE[:count]), fixed=("heading", "position"), throw=False)
    assert int(found.converged.sum()) > 0.9 * COUNT
    assert found.rivals is not None
    wrong = far_off(found)
    assert bool((found.rivals.ratio < 100)[wrong].all())
    told = [i for i in range(COUNT) if found[i].doubts]
    assert set(wrong.nonzero().flatten().tolist()) <= set(told)


def test_many_heights_have_one_minimum() -> None:
    more = [[u, v] for u in (250.0, 500.0, 750.0, 1000.0) for v in (450.0, 600.0, 800.0)]
    found = dp.adjust(TRUE, people(more), fixed=("heading", "position"))
    assert not far_off(found).any()
    assert found.rivals is None  # too many residuals are left over for another to explain them as well


def test_three_landmarks_have_several_poses() -> None:
    """Measured: none of 60 far off without a word; where the mirror image alone was looked for 7."""
    points, seen = ground([[624.0, 554.0], [770.0, 847.0], [508.0, 440.0]])
    start = camera(9.0, 40.0, 17.0, 50.0, [5.0, -5.0])
    found = dp.adjust(start, dp.Seen(points, seen + noise(3, COUNT, 3, 2)), throw=False)
    assert int(found.converged.sum()) > 0.7 * COUNT  # 45; of others nothing tells the pose
    assert found.rivals is not None
    assert not (far_off(found) & (found.rivals.ratio >= 100)).any()


@pytest.mark.parametrize("count", [3, 4, 5])
@pytest.mark.parametrize("height", [0.0, 2000.0])
def test_another_pose_lies_elsewhere_by_the_distance_of_what_was_seen(count: int, height: float) -> None:
    """The world's origin may be the camera, or far below it: what differs by rounding alone is the same pose."""
    at = torch.tensor([0.0, 0.0, height], dtype=D)
    level = camera(5.0, 5.0, 0.0, 0.0, [0.0, 0.0])
    mast = level.at(level.R, -(level.R @ at))
    points = torch.tensor([[-3.0, 20, 1], [3, 20, 2], [0, 20, -2], [4, 20, -1], [-4, 20, 3]], dtype=D)[:count] + at
    start = mast.at(level.R, -(level.R @ (at + torch.tensor([0.1, 0.1, 0.0], dtype=D))))
    found = dp.adjust(start, dp.Seen(points, mast.project(points)[0] + noise(4, count, 2)), fixed=("height",))
    assert found.rivals is not None
    assert bool(found.rivals.ratio.isinf())
    assert not found.doubts
