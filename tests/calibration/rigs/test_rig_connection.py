"""What connects the cameras of a rig: moments that are the only ones to, and views without which nothing does."""

import pytest

import diffproj as dp
from tests.calibration.rigs.rig_scenes import Scene, scene


def without(true: Scene, *moments: int) -> dict[str, dp.Views]:
    """The views without those of some moments."""
    gone = {f"moment {moment}" for moment in moments}
    kept = {
        name: [v for v, moment in enumerate(views.names) if moment not in gone] for name, views in true.views.items()
    }
    return {name: views[kept[name]] for name, views in true.views.items()}


@pytest.fixture(scope="module")
def chain() -> Scene:
    """Four cameras, of which neighbours alone share moments: 0, 3, ... the first two, 1, 4, ... the next, 2, 5, ..."""
    return scene(cameras=4, moments=21, chain=True, seed=3)


def alone(rig: dp.RigCalibration) -> list[str]:
    return [remark for remark in rig.remarks if "one moment alone" in remark]


def test_one_moment_alone_that_connects_groups_of_cameras_is_told(chain: Scene) -> None:
    """Each of these cameras shares many moments with others: a fault in that one is a fault of all places behind it."""
    views = without(chain, *range(4, 21, 3))
    assert alone(dp.calibrate_rig(views, chain.board)) == [
        "one moment alone connects cam2 and cam3 with the other cameras, moment 1: nothing checks their places"
    ]
    held = dp.calibrate_rig(views, chain.board, cameras=chain.cameras, fixed=("cam2.pose",))
    assert alone(held) == []  # where it stands is known
    assert alone(dp.calibrate_rig(without(chain, *range(7, 21, 3)), chain.board)) == []  # two moments


def test_each_camera_that_one_moment_alone_connects_is_told(chain: Scene) -> None:
    """By itself at the end, and both groups where two moments are the only ones."""
    end = dp.calibrate_rig(without(chain, *range(5, 21, 3)), chain.board, cameras=chain.cameras, fixed=("intrinsics",))
    assert alone(end) == ["one moment alone connects cam3 with the other cameras, moment 2: nothing checks its place"]
    views = without(chain, *range(4, 21, 3), *range(5, 21, 3))
    both = dp.calibrate_rig(views, chain.board, cameras=chain.cameras, fixed=("intrinsics",))
    assert [remark.split(" with ")[0].removeprefix("one moment alone connects ") for remark in alone(both)] == [
        "cam2 and cam3",
        "cam3",
    ]


@pytest.mark.parametrize("shift", [1, 2])
def test_a_camera_that_contradicts_all_others_is_no_lack_of_moments(shift: int) -> None:
    """Whose photographs are of other moments: to add some would not help, and the message said so."""
    true = scene(cameras=4, moments=14, missing=0.2, seed=3)
    views = true.views["cam1"]
    shifted = dp.Views(views.pixels[shift:], views.visible[shift:], views.names[:-shift], views.size)
    with pytest.raises(
        dp.CalibrationError, match=r"views contradict the other cameras at their moments \(.*cam1 at .*"
    ) as told:
        dp.calibrate_rig(true.views | {"cam1": shifted}, true.board)
    assert "do the moments fit together" in str(told.value)
    assert "cam1.omega_x" in str(told.value)
    assert "add moments" not in str(told.value)
