"""Little evidence is explained by several poses: what `adjust` says is within its deviations, or doubted."""

from typing import Any

import pytest
import torch

import diffproj as dp
from diffproj.calibration.evidence.best import _with_other
from diffproj.calibration.evidence.descent import Found, Task

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


def test_four_landmarks_and_a_camera_that_is_known_roughly_have_several_poses() -> None:
    """Upside down and 3 m high, or upright and 10 m high, as in truth; by the mirror image alone nothing was said."""
    marks = [[9.998, 21.97, 0.0], [5.309, 16.904, 0.0], [10.052, 12.105, 0.0], [25.622, 30.879, 0.0]]
    seen = [[938.211, 1042.663], [1467.728, 1113.925], [1322.427, 877.233], [194.589, 868.015]]
    known = {"focal": 154.0, "principal_point": 32.0, "k1": 0.2, "k2": 0.13}
    wrong = dp.Camera.mounted(2.7, 30.0, -162.0, 1.0, position=[13.7, 6.1], focal=1143.0, size=(1600, 1200))
    lens = torch.zeros(4, dtype=D)
    start = dp.Camera(wrong.K, wrong.R, wrong.t, dp.BrownConrady(lens), size=(1600, 1200))
    found = dp.adjust(start, dp.Seen(marks, seen), priors=known)
    assert found.rivals is not None
    assert float(found.rivals.ratio) < 5
    assert {round(float(height)) for height in (found.mounting.height, found.rivals.height)} == {3, 10}
    assert "another pose explains the evidence nearly as well" in found.doubts


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


@pytest.mark.parametrize("unseen", [0, 3])
def test_landmarks_that_are_not_seen_do_not_count(unseen: int) -> None:
    """Measured: as with the three alone; where they counted, 2 of 60 were far off without a word."""
    points, seen = ground([[624.0, 554.0], [770.0, 847.0], [508.0, 440.0]])
    more = points[:unseen] + torch.tensor([3.0, 4.0, 1.0], dtype=D)
    nowhere = torch.full((COUNT, unseen, 2), torch.nan, dtype=D)
    pixels = torch.cat([seen + noise(3, COUNT, 3, 2), nowhere], dim=1)
    start = camera(9.0, 40.0, 17.0, 50.0, [5.0, -5.0])
    found = dp.adjust(start, dp.Seen(torch.cat([points, more]), pixels), throw=False)
    assert found.rivals is not None
    assert int(found.converged.sum()) == 45
    assert int((found.rivals.ratio < 100).sum()) == 45
    assert not (far_off(found) & (found.rivals.ratio >= 100)).any()


@pytest.mark.slow
def test_each_camera_of_a_batch_is_looked_at_as_if_alone() -> None:
    """Some see three landmarks, some two, and some eight on a plane, which has a mirrored pose, off it others."""
    places = [[624.0, 554.0], [770.0, 847.0], [508.0, 440.0], [600.0, 500.0], [650.0, 640.0], [560.0, 600.0]]
    points, _ = ground(places)
    middle = points.mean(0)
    points = torch.cat([middle + 0.02 * (points - middle), middle + 3 * torch.eye(3, dtype=D)])
    pixels = (TRUE.project(points)[0] + 0.3 * noise(6, 4, 9, 2)).reshape(2, 2, 9, 2)
    hidden = [[[3, 4, 5, 6, 7, 8], [6, 7, 8]], [[2, 3, 4, 5, 6, 7, 8], []]]
    for i in (0, 1):
        for j in (0, 1):
            pixels[i, j, hidden[i][j]] = torch.nan
    start = camera(7.0, 24.0, 5.0, 36.0, [1.0, -1.0])
    known = {"priors": {"height": (6.0, 0.5), "tilt": torch.tensor([3.0, 4.0], dtype=D)}, "throw": False}
    batch = dp.adjust(start, dp.Seen(points, pixels), **known)  # type: ignore[arg-type]
    assert batch.rivals is not None
    for i in (0, 1):
        for j in (0, 1):
            kept = pixels[i, j].isfinite().all(-1)
            seen = dp.Seen(points[kept], pixels[i, j, kept])
            one = dp.adjust(start, seen, priors={"height": (6.0, 0.5), "tilt": 3.0 + j}, throw=False)
            ratio = torch.inf if one.rivals is None else float(one.rivals.ratio)
            assert float(batch.rivals.ratio[i, j]) == pytest.approx(ratio, rel=1e-4), (i, j)
            assert float(batch.mounting.height[i, j]) == pytest.approx(float(one.mounting.height), rel=1e-6), (i, j)


@pytest.mark.slow
def test_few_of_many_are_looked_at_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of evidence of each kind, as the whole batch tells it."""
    more = [[u, v] for u in (250.0, 500.0, 750.0, 1000.0) for v in (450.0, 600.0, 800.0)]
    points, feet = ground(more)
    tops = TRUE.project(points + torch.tensor([0.0, 0, 1.7], dtype=D))[0]
    pixels = feet + noise(7, 5, 12, 2)
    pixels[:4, 3:] = torch.nan
    pixels[4, :3] = torch.nan
    pieces = [
        dp.Seen(points, pixels),
        dp.Heights(
            feet[:2].expand(5, 2, 2),
            tops[:2] + noise(8, 5, 2, 2),
            1.7,
            torch.full((5, 2), 0.07, dtype=D),
            pixel_sigma=1.0,
        ),
    ]
    looked: list[tuple[int, ...]] = []

    def spied(task: Task, found: Found, **options: Any) -> Found:
        looked.append(task.batch)
        return _with_other(task, found, **options)

    monkeypatch.setattr("diffproj.calibration.evidence.best._with_other", spied)
    found = dp.adjust(TRUE, pieces, throw=False)
    assert looked == [(4,)]
    monkeypatch.setattr("diffproj.calibration.evidence.some_cameras.OF_ITEMS", {})
    whole = dp.adjust(TRUE, pieces, throw=False)
    assert found.rivals is not None
    assert whole.rivals is not None
    assert torch.allclose(found.rivals.ratio, whole.rivals.ratio)
    assert torch.allclose(found.cameras.t, whole.cameras.t)
