"""What is held of a rig's cameras errs as the calibrations say that it is from, and all that is found follows."""

import pickle
from collections.abc import Mapping
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import diffproj as dp
from tests.calibration.rigs.rig_scenes import D, Scene, off_truth, scene


@pytest.fixture(scope="module")
def pair() -> Scene:
    return scene(2, 6, missing=0.0, seed=3)


def focal_alone(seen: Scene) -> dict[str, dp.Calibration]:
    """Calibrations of which one number is uncertain, the tied focal length."""
    fixed = ("principal_point", "distortion")
    return {
        name: dp.refine(views, seen.board, seen.cameras[name], fixed=fixed, tied_focal=True)
        for name, views in seen.views.items()
    }


def with_focal(camera: dp.Camera, by: Tensor) -> dp.Camera:
    K = camera.K.clone()
    K[[0, 1], [0, 1]] += by
    return dp.Camera(K, camera.R, camera.t, camera.distortion, camera.size)


def held(seen: Scene, cameras: Mapping[str, dp.Camera | dp.Calibration]) -> dp.RigCalibration:
    return dp.calibrate_rig(seen.views, seen.board, cameras=cameras, fixed=("intrinsics",))


def test_places_follow_what_is_held(pair: Scene) -> None:
    """Their covariance is larger by what central differences of the whole calibration tell."""
    known = focal_alone(pair)
    exact = {name: one.camera for name, one in known.items()}
    rig, sure = held(pair, known), held(pair, exact)
    assert torch.equal(rig.cameras["cam1"].t, sure.cameras["cam1"].t)
    more, length = torch.zeros(6, 6, dtype=D), sure.baseline("cam0", "cam1").deviation ** 2
    for name, one in known.items():
        C = one.covariance.shared[:2, :2]
        step = C.diagonal().sqrt()
        assert torch.allclose(C, step * step.unsqueeze(-1), rtol=1e-9)  # the tied focal lengths go together
        ends = [held(pair, exact | {name: with_focal(exact[name], sign * step)}) for sign in (1, -1)]
        slope = (off_truth(ends[0], pair, "cam1") - off_truth(ends[1], pair, "cam1")) / 2
        more += slope.unsqueeze(-1) * slope
        length += ((ends[0].baseline("cam0", "cam1").length - ends[1].baseline("cam0", "cam1").length) / 2) ** 2
    found = rig.place_covariance("cam1") - sure.place_covariance("cam1")
    unit = more.diagonal().sqrt()
    assert torch.allclose(found / unit / unit.unsqueeze(-1), more / unit / unit.unsqueeze(-1), atol=0.02)
    assert rig.baseline("cam0", "cam1").deviation ** 2 == pytest.approx(length, rel=0.01)
    assert rig["cam0"].knows_intrinsics
    again = pickle.loads(pickle.dumps(held(pair, known)))  # noqa: S301 - before its covariance was asked for
    assert again.baseline("cam0", "cam1") == rig.baseline("cam0", "cam1")
    assert not sure["cam0"].knows_intrinsics


def test_a_rig_that_is_held_errs_as_it_did_whichever_camera_is_first() -> None:
    three = scene(3, 8, missing=0.1, seed=5)
    rig = dp.calibrate_rig(three.views, three.board)
    turned = {name: three.views[name] for name in ("cam2", "cam0", "cam1")}
    again = dp.calibrate_rig(turned, three.board, cameras=rig, fixed=("rig", "intrinsics"))
    X = torch.tensor([[100.0, 50, 1800], [-200, 100, 2200]], dtype=D)
    pixels = {name: camera.project(X)[0] for name, camera in rig.cameras.items()}
    points = {name: one.triangulate(pixels, 0.2) for name, one in (("rig", rig), ("again", again))}
    for one, other in (("cam0", "cam1"), ("cam1", "cam2"), ("cam2", "cam0")):
        assert again.baseline(one, other) == pytest.approx(rig.baseline(one, other), rel=1e-6)
    assert points["again"].length(0, 1) == pytest.approx(points["rig"].length(0, 1), rel=1e-6)
    exact = dp.calibrate_rig(turned, three.board, cameras=rig.cameras, fixed=("rig", "intrinsics"))
    assert exact.baseline("cam0", "cam1").deviation == 0


def test_a_calibration_stands_nowhere(pair: Scene) -> None:
    known = focal_alone(pair)
    with pytest.raises(ValueError, match=r"fixed: want cameras={'cam0': ...} at its pose, .* stands nowhere"):
        dp.calibrate_rig(pair.views, pair.board, cameras=known, fixed=("rig",))
    with pytest.raises(ValueError, match=r"want \(mean, deviation\) for 'cam1.baseline', .* stand nowhere"):
        dp.calibrate_rig(pair.views, pair.board, cameras=known, priors={"cam1.baseline": 5.0})


@pytest.mark.slow
def test_intervals_hold_with_intrinsics_from_other_photographs(pair: Scene) -> None:
    """Of few views, so that the intrinsics err much: without their errors 55 % of the baselines, 5 % of the points."""
    draw = torch.Generator().manual_seed(0)
    clean = {name: seen_exactly(pair, name) for name in pair.cameras}
    X = torch.tensor([[-200.0, -100, 1700], [250, 120, 2100]], dtype=D)
    off: dict[str, list[Tensor]] = {"baseline": [], "points": []}
    contradicted = 0
    true = float(pair.cameras["cam1"].center.norm())
    for _ in range(60):

        def noisy(name: str, which: slice) -> dp.Views:
            pixels, visible = (part[which] for part in clean[name])
            pixels = pixels + 0.2 * torch.randn(pixels.shape, generator=draw, dtype=D)
            return dp.Views(pixels, visible, [f"moment {i}" for i in range(len(pixels))], size=(1280, 960))

        known = {name: dp.calibrate(noisy(name, slice(6, None)), pair.board) for name in clean}
        views = {name: noisy(name, slice(0, 6)) for name in clean}
        rig = dp.calibrate_rig(views, pair.board, cameras=known, fixed=("intrinsics",))
        length, deviation = rig.baseline("cam0", "cam1")
        off["baseline"].append(torch.tensor([(length - true) / deviation]))
        pixels = {name: camera.project(X)[0] for name, camera in pair.cameras.items()}
        pixels = {name: at + 0.2 * torch.randn(2, 2, generator=draw, dtype=D) for name, at in pixels.items()}
        found = rig.triangulate(pixels, 0.2)
        off["points"].append(((found.points - X) / found.deviations).flatten())
        contradicted += any("which is held" in remark for remark in rig.remarks)
    for what, least in (("baseline", 0.93), ("points", 0.92)):
        assert float((torch.cat(off[what]).abs() < 1.96).double().mean()) >= least, what
    assert contradicted <= 1


def seen_exactly(seen: Scene, name: str) -> tuple[Tensor, Tensor]:
    """Corners without noise, first at the moments and then in five photographs of the camera's own."""
    own, camera = scene(2, 5, missing=0.0, seed=9), seen.cameras[name]
    first = camera.at(camera.R @ seen.R, (camera.R @ seen.t.unsqueeze(-1)).squeeze(-1) + camera.t)
    parts = [one.project(seen.board.points) for one in (first, camera.at(own.R, own.t))]
    pixels, visible = (torch.cat(both) for both in zip(*parts, strict=True))
    return pixels, visible & camera.in_image(pixels)


def test_what_a_calibration_does_not_determine_cannot_be_held(pair: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """What follows it would be told as if it were exact."""
    known = focal_alone(pair)
    told = known["cam1"].covariance_of_kept_poses
    without = torch.tensor([name != "f_x" for name in told.names])
    shared = torch.where(without & without.unsqueeze(-1), told.shared, 0.0)
    shared = shared + torch.diag(torch.where(without, 0.0, torch.inf).to(D))
    lacking = replace(told, shared=shared, undetermined=~without)
    monkeypatch.setattr(dp.Calibration, "covariance_of_kept_poses", property(lambda self: lacking))
    with pytest.raises(
        ValueError, match=r"fixed: want what the calibration in cameras= determines, got cam0.f_x, cam1"
    ):
        held(pair, known)
    held(pair, {name: one.camera for name, one in known.items()})
