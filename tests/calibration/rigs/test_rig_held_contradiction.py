"""What is held of a rig's cameras and is wrong: the corners contradict it, and it is told what they say instead."""

import re

import pytest
import torch

import diffproj as dp
from tests.calibration.rigs.rig_scenes import D, Scene, rotation, scene


@pytest.fixture(scope="module")
def three() -> Scene:
    return scene(3, 14, missing=0.2, seed=3)


def with_K(camera: dp.Camera, scale: float = 1.0, shift: float = 0.0) -> dp.Camera:
    K = camera.K.clone()
    K[[0, 1], [0, 1]] *= scale
    K[0, 2] += shift
    return dp.Camera(K, camera.R, camera.t, camera.distortion, camera.size)


def told(three: Scene, camera: dp.Camera, *fixed: str) -> list[str]:
    """What is said of held numbers with another second camera."""
    rig = dp.calibrate_rig(three.views, three.board, cameras=three.cameras | {"cam1": camera}, fixed=fixed)
    return [remark for remark in rig.remarks if "which is held" in remark]


@pytest.mark.parametrize(
    ("scale", "shift", "fixed", "names"),
    [
        (1.02, 0.0, ("cam1.focal",), ("cam1.f_x", "cam1.f_y")),
        (1.0, 15.0, ("intrinsics",), ("cam1.c_x",)),
    ],
)
def test_wrong_intrinsics_that_are_held(
    three: Scene, scale: float, shift: float, fixed: tuple[str, ...], names: tuple[str, ...]
) -> None:
    """The focal lengths by 2 %, the principal point by 15 px: residuals hardly grow, and the places are bent."""
    (remark,) = told(three, with_K(three.cameras["cam1"], scale, shift), *fixed)
    name, found, deviation = re.search(r"contradict (\S+), which .* they tell (\S+) ± (\S+):", remark).groups()  # type: ignore[union-attr]
    assert name in names
    K = three.cameras["cam1"].K
    true = {"cam1.f_x": K[0, 0], "cam1.f_y": K[1, 1], "cam1.c_x": K[0, 2]}[name]
    assert abs(float(found) - float(true)) < 3 * float(deviation)


def test_a_wrong_place_that_is_held(three: Scene) -> None:
    camera = three.cameras["cam1"]
    (remark,) = told(three, camera.at(camera.R, camera.t + torch.tensor([3.0, 0, 0], dtype=D)), "cam1.pose")
    assert remark.startswith("the views contradict the place of cam1, which is held: they tell -3.")
    assert " world units along x off it" in remark
    turned = camera.at(rotation(torch.tensor([0, 0.002, 0], dtype=D)) @ camera.R, camera.t)
    (remark,) = told(three, turned, "rig", "principal_point")  # which would take it up
    assert re.search(r"of cam1, .* they tell -0\.11\d ± 0\.\d+ degrees about y off it", remark)


@pytest.mark.parametrize("fixed", ["intrinsics", "rig", "cam1.focal", "cam1.pose", "principal_point"])
def test_what_is_rightly_held_is_not_contradicted(three: Scene, fixed: str) -> None:
    assert not told(three, three.cameras["cam1"], fixed)


def test_cameras_of_other_photographs_may_be_held() -> None:
    """Of the bundled pair, where corners err together."""
    pair = {name: dp.example_views(name) for name in ("left", "right")}
    first = dp.calibrate_rig({name: views[::2] for name, views in pair.items()}, dp.Chessboard())
    for fixed in (("rig",), ("intrinsics",), ("rig", "intrinsics")):
        second = {name: views[1::2] for name, views in pair.items()}
        rig = dp.calibrate_rig(second, dp.Chessboard(), cameras=first, fixed=fixed)
        assert not [remark for remark in rig.remarks if "which is held" in remark]
