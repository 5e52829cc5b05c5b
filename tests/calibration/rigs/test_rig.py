"""Rigs: the minimum is OpenCV's for a pair, and that from the truth for many; moments may be missing or wrong."""

import copy
import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.calibration.problem.parametrisation import Parametrisation
from diffproj.calibration.rigs.parameters import RigParameters
from diffproj.calibration.rigs.problem import RigProblem
from diffproj.calibration.rigs.uncertainty import rig_covariance
from diffproj.calibration.rigs.views import rig_views
from tests.calibration.rigs.rig_scenes import Scene, off_truth, scene

D = torch.float64
BOARD = dp.Chessboard()


@pytest.fixture(scope="module")
def pair() -> dict[str, dp.Views]:
    return {"left": dp.example_views("left"), "right": dp.example_views("right")}


@pytest.fixture(scope="module")
def three() -> Scene:
    return scene(3, 15, seed=3)


@pytest.fixture(scope="module")
def rig(three: Scene) -> dp.RigCalibration:
    return dp.calibrate_rig(three.views, three.board)


def test_the_bundled_pair_is_calibrated_as_by_opencv(pair: dict[str, dp.Views]) -> None:
    rig = dp.calibrate_rig(pair, BOARD)
    # OpenCV holds the board's points in float32, which whole millimetres are exact in, and corners too.
    corners = [[view.numpy().astype(np.float32) for view in views.pixels] for views in pair.values()]
    rounded = {
        name: dp.Views(np.stack(seen).astype(np.float64), names=views.names, size=views.size)
        for (name, views), seen in zip(pair.items(), corners, strict=True)
    }
    points = [BOARD.points.numpy().astype(np.float32)] * 13
    intrinsics = []
    for seen in corners:
        _, K, dist, _, _ = cv2.calibrateCamera(points, seen, (640, 480), None, None)  # type: ignore[call-overload]
        intrinsics += [K, dist]
    rms, K_left, _, K_right, _, R, T, _, _ = cv2.stereoCalibrate(
        points, *corners, *intrinsics, (640, 480), flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=(3, 200, 1e-15)
    )  # type: ignore[call-overload]
    same = dp.calibrate_rig(rounded, BOARD)
    assert same.rms == pytest.approx(rms, rel=1e-9)
    right = same.cameras["right"]
    assert np.allclose(right.R.numpy(), R, atol=1e-5)
    assert np.allclose(right.t.numpy(), T.ravel(), atol=5e-3)
    for name, K in (("left", K_left), ("right", K_right)):
        assert np.allclose(same.cameras[name].K.numpy(), K, atol=2e-2)
    assert rig.rms == pytest.approx(same.rms, rel=1e-5)  # of corners that are not rounded
    length, deviation = rig.baseline("left", "right")
    assert length == pytest.approx(float(np.linalg.norm(T)), abs=2e-3)
    # The error bar holds that the views contradict each other more than independent corners would, and on top of that
    # what all corners of a view have in common.
    joint = rig._covariance
    apart = replace(rig, _covariance=lambda: rig_covariance(joint.found, joint.noise, None))  # type: ignore[union-attr]
    without = apart.baseline("left", "right").deviation
    assert without / float(rig.covariance.dispersion.sqrt()) == pytest.approx(0.2032 * rms, rel=0.1)
    assert deviation / without == pytest.approx(1.35, abs=0.03)


@pytest.mark.parametrize(("cameras", "moments", "chain"), [(2, 20, False), (4, 20, False), (4, 30, True)])
def test_it_ends_where_the_truth_leads(cameras: int, moments: int, chain: bool) -> None:
    true = scene(cameras, moments, chain=chain, missing=0.0 if chain else 0.3, seed=5)
    rig = dp.calibrate_rig(true.views, true.board)
    again = dp.calibrate_rig(true.views, true.board, cameras=true.cameras)
    assert rig.rms == pytest.approx(again.rms, rel=1e-10)
    for name in rig.names:
        assert torch.allclose(rig.cameras[name].t, again.cameras[name].t, atol=1e-4)


def test_derivatives_are_those_of_the_residuals(three: Scene) -> None:
    views = rig_views(three.views, three.board, None, None, "here")
    parameters = RigParameters(views.names, (Parametrisation("brown5"),) * 3)
    base = torch.stack([three.cameras[name].R for name in views.names])
    problem = RigProblem(views, parameters, base)
    shared = torch.zeros(1, parameters.size, dtype=D)
    for c, name in enumerate(views.names):
        shared[0, parameters.intrinsics(c)] = parameters.kinds[c].pack(three.cameras[name])
        if c:  # away from where the rotation counts from
            place = torch.tensor([0.02, -0.01, 0.03], dtype=D), three.cameras[name].t
            shared[0, parameters.pose(c)] = torch.cat(place)
    order = [int(label.removeprefix("moment ")) for label in views.moments]
    R, t = three.R[order], three.t[order]
    local = R.unsqueeze(0), (t + R @ views.middle).unsqueeze(0)
    weight = torch.linspace(0.5, 1.5, len(order), dtype=D)

    def cost(x: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        return problem.equations(x, problem.retract(local, step), None)[0][0] / 1e3

    _, equations = problem.equations(shared, local, None)
    still = torch.zeros(1, len(order), 6, dtype=D)
    for i in range(parameters.size):
        h = 1e-5 * max(1.0, abs(float(shared[0, i])))
        step = torch.zeros_like(shared)
        step[0, i] = h
        slope = (cost(shared + step, still) - cost(shared - step, still)) / (2 * h)
        assert float(equations.g[0, i]) / 1e3 == pytest.approx(float(slope), rel=1e-5, abs=1e-3)
    for i in range(6):
        step = torch.zeros_like(still)
        step[..., i] = 1e-5 * weight
        slope = (cost(shared, step) - cost(shared, -step)) / 2e-5
        expected = (equations.h[0, :, i] * weight).sum() / 1e3
        assert float(expected) == pytest.approx(float(slope), rel=1e-5, abs=1e-3)


def test_views_that_one_camera_alone_sees_count(three: Scene) -> None:
    alone = three.views
    names = list(alone["cam1"].names)
    extra = dp.Views(
        torch.cat([alone["cam1"].pixels, alone["cam1"].pixels[:2] + 3]),
        torch.cat([alone["cam1"].visible, alone["cam1"].visible[:2]]),
        [*names, "one more", "another"],
        size=(1280, 960),
    )
    rig = dp.calibrate_rig(three.views, three.board)
    more = dp.calibrate_rig(three.views | {"cam1": extra}, three.board)
    assert len(more.moments) == len(rig.moments) + 2
    fewer = rig["cam1"].covariance.deviations["f_x"], more["cam1"].covariance.deviations["f_x"]
    assert float(fewer[1]) < float(fewer[0])


def test_units_do_not_matter(three: Scene, rig: dp.RigCalibration) -> None:
    metres = dp.Chessboard(9, 6, 0.06)
    other = dp.calibrate_rig(three.views, metres)
    assert other.rms == pytest.approx(rig.rms, rel=1e-10)
    mm, m = rig.baseline("cam0", "cam2"), other.baseline("cam0", "cam2")
    assert m.length == pytest.approx(mm.length / 1000, rel=1e-7)
    assert m.deviation == pytest.approx(mm.deviation / 1000, rel=1e-5)


def test_a_turned_board_and_mixed_up_moments_are_left_out(three: Scene, rig: dp.RigCalibration) -> None:
    views = three.views["cam1"]
    pixels, visible, names = views.pixels.clone(), views.visible.clone(), list(views.names)
    pixels[2], visible[2] = pixels[2].flip(0), visible[2].flip(0)
    names[3], names[5] = names[5], names[3]
    wrong = dp.Views(pixels, visible, names, size=views.size)
    found = dp.calibrate_rig(three.views | {"cam1": wrong}, three.board)
    out = {name: found[name].rejected.any(-1).sum().item() for name in found.names}
    assert sum(out.values()) == 3
    assert any("contradicts" in remark for remark in found.remarks)
    assert found.rms == pytest.approx(rig.rms, rel=0.02)
    assert found.baseline("cam0", "cam2").length == pytest.approx(rig.baseline("cam0", "cam2").length, abs=2.0)


def test_exact_corners_are_calibrated_exactly() -> None:
    true = scene(3, 12, noise=0.0, seed=2)
    rig = dp.calibrate_rig(true.views, true.board)
    assert rig.rms < 1e-6
    for name in rig.names[1:]:
        assert off_truth(rig, true, name).abs().amax() < 1e-5


@pytest.mark.parametrize("seed", [0, 1])
def test_gross_outliers_are_rejected(seed: int) -> None:
    clean = scene(4, 30, seed=seed)
    dirty = scene(4, 30, seed=seed, outliers=0.01)
    found = dp.calibrate_rig(dirty.views, dirty.board, reject_outliers=True)
    rejected = sum(int(one.rejected.sum()) for one in found.calibrations.values())
    total = sum(int(views.visible.sum()) for views in dirty.views.values())
    assert 0.008 * total < rejected < 0.013 * total
    assert found.rms == pytest.approx(dp.calibrate_rig(clean.views, clean.board).rms, rel=0.02)


def test_lenses_and_sizes_may_differ(three: Scene, rig: dp.RigCalibration) -> None:
    small = three.views["cam2"]
    small = dp.Views(small.pixels / 2 - 0.25, small.visible, small.names, size=(640, 480))
    lenses = {"cam0": "brown5", "cam1": "brown8", "cam2": "brown4"}
    found = dp.calibrate_rig(three.views | {"cam2": small}, three.board, lenses)  # type: ignore[arg-type]
    assert [one.parameters.lens for one in found.calibrations.values()] == list(lenses.values())
    assert found.cameras["cam2"].size == (640, 480)
    assert found.baseline("cam0", "cam2").length == pytest.approx(rig.baseline("cam0", "cam2").length, abs=2.0)


def test_what_is_fixed_stays(three: Scene, rig: dp.RigCalibration) -> None:
    true = three.cameras
    frozen = dp.calibrate_rig(three.views, three.board, cameras=true, fixed=("intrinsics",))
    assert all(torch.equal(frozen.cameras[name].K, true[name].K) for name in true)
    assert frozen.place_covariance("cam1").diagonal().min() > 0
    still = dp.calibrate_rig(three.views, three.board, cameras=true, fixed=("rig",))
    assert all(torch.allclose(still.cameras[name].t, true[name].t, atol=1e-9) for name in true)
    assert still.baseline("cam0", "cam1").deviation == 0
    part = dp.calibrate_rig(three.views, three.board, cameras=true, fixed=("cam1.pose", "cam2.k3"))
    assert torch.allclose(part.cameras["cam1"].t, true["cam1"].t, atol=1e-9)
    held, given = (one["cam2"].distortion for one in (part.cameras, true))
    assert float(held.coefficients[4]) == float(given.coefficients[4])  # type: ignore[union-attr]
    nothing = dp.calibrate_rig(three.views, three.board, fixed=("k3",))
    assert float(nothing.cameras["cam0"].distortion.coefficients[4]) == 0  # type: ignore[union-attr]
    again = dp.calibrate_rig(three.views, three.board, cameras=rig, fixed=("rig", "intrinsics"))
    assert again.rms == pytest.approx(rig.rms, rel=1e-8)


def test_weights_and_losses(three: Scene, rig: dp.RigCalibration) -> None:
    heavy = dp.calibrate_rig(three.views, three.board, weights=4.0)
    assert heavy.baseline("cam0", "cam2") == pytest.approx(rig.baseline("cam0", "cam2"), rel=1e-6)
    hidden = {name: torch.ones(len(views), 54, dtype=D) for name, views in three.views.items()}
    hidden["cam1"][:, ::7] = 0
    without = three.views | {"cam1": three.views["cam1"].hiding(torch.arange(54) % 7 == 0)}
    one, other = dp.calibrate_rig(three.views, three.board, weights=hidden), dp.calibrate_rig(without, three.board)
    assert one.rms == pytest.approx(other.rms, rel=1e-9)
    robust = dp.calibrate_rig(three.views, three.board, loss=dp.Huber(0.5))
    length, deviation = robust.baseline("cam0", "cam2")
    plain = rig.baseline("cam0", "cam2")
    assert abs(length - plain.length) < plain.deviation
    assert deviation == pytest.approx(plain.deviation, rel=0.1)


def test_moments_by_name_and_number(pair: dict[str, dp.Views]) -> None:
    named = dp.calibrate_rig(pair, BOARD)
    assert named.moments[0] == "01.jpg"
    few = {"left": pair["left"][[0, 2, 5, 7, 9]], "right": pair["right"][[2, 5, 6, 7, 9]]}
    numbers = {"left": [0, 2, 5, 7, 9], "right": np.array([2, 5, 6, 7, 9])}
    rig = dp.calibrate_rig(few, BOARD, moments=numbers)
    assert rig.moments == ("0", "2", "5", "7", "9", "6")
    assert rig.where["right"].tolist() == [1, 2, 5, 3, 4]


def test_the_other_pose_of_a_view_is_known_where_one_camera_alone_saw_it() -> None:
    true = scene(2, 12, missing=0.4, seed=4)
    rig = dp.calibrate_rig(true.views, true.board)
    for name in rig.names:
        one, other = rig[name], rig[next(o for o in rig.names if o != name)]
        both = torch.isin(rig.where[name], rig.where["cam1" if name == "cam0" else "cam0"])
        assert bool(one.likelihood_ratio[both].isinf().all())
        alone = dp.calibrate(true.views[name], true.board)
        assert torch.allclose(one.likelihood_ratio[~both].log(), alone.likelihood_ratio[~both].log(), atol=1e-3)
        assert one.covariance.names[:9] == other.covariance.names[:9]


def test_it_shows_and_copies_itself(pair: dict[str, dp.Views]) -> None:
    rig = dp.calibrate_rig(pair, BOARD, "brown4")
    start = f"RigCalibration(2 cameras, 13 moments, baseline {rig.baseline('left', 'right').length:.1f}, RMS "
    assert repr(rig) == f"{start}{rig.rms:.4f} px, converged)"
    assert "<table>" in rig._repr_html_()
    text = rig.summary()
    assert "baseline 83." in text
    assert "right: RMS" in text
    for other in (copy.deepcopy(rig), pickle.loads(pickle.dumps(rig))):  # noqa: S301
        assert other.to_dict() == rig.to_dict()
    with pytest.raises(ValueError, match="left"):
        rig["middle"]
    assert (list(rig), len(rig), "middle" in rig) == (list(rig.names), len(rig.names), False)


# ----------------------------------------------------------------------------------------------------- refusals


def renamed(views: dp.Views, names: list[str]) -> dp.Views:
    return dp.Views(views.pixels, views.visible, names, views.size)


def test_cameras_that_nothing_connects_are_named(three: Scene) -> None:
    views = three.views["cam2"]
    apart = three.views | {"cam2": renamed(views, [f"other {name}" for name in views.names])}
    with pytest.raises(dp.CalibrationError, match=r"nothing connects 'cam2' with 'cam0', 'cam1'"):
        dp.calibrate_rig(apart, three.board)


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_one_camera_given_twice_is_told(three: Scene, noise: float) -> None:
    """They fit, and the baseline is 0 with a small deviation."""
    views = three.views["cam0"]
    draw = torch.Generator().manual_seed(1)
    again = dp.Views(
        views.pixels + noise * torch.randn(views.pixels.shape, generator=draw, dtype=views.dtype),
        views.visible,
        views.names,
        views.size,
    )
    found = dp.calibrate_rig({"left": views, "right": again, "other": three.views["cam1"]}, three.board)
    said = [remark for remark in found.remarks if "of one camera given for both" in remark]
    assert len(said) == 1
    assert said[0].startswith("left and right see each corner in one place")
    assert said[0] in found.summary()


def test_moments_that_do_not_fit_are_no_rig(three: Scene) -> None:
    views = three.views["cam2"]
    shifted = three.views | {"cam2": renamed(views, [*views.names[1:], "moment 99"])}
    with pytest.raises(dp.CalibrationError, match=r"moments"):
        dp.calibrate_rig(shifted, three.board)


def test_a_camera_whose_views_do_not_determine_it_is_named(three: Scene) -> None:
    with pytest.raises(dp.CalibrationError, match=r"'cam1' on its own.*fixed=\('cam1.intrinsics',\)"):
        dp.calibrate_rig(three.views | {"cam1": three.views["cam1"][:1]}, three.board)
    known = {"cam1": three.cameras["cam1"]}
    options = {"cameras": known, "fixed": ("cam1.intrinsics",)}
    found = dp.calibrate_rig(three.views | {"cam1": three.views["cam1"][:1]}, three.board, **options)
    assert any("one moment alone connects cam1" in remark for remark in found.remarks)


@pytest.mark.plain
def test_wrong_arguments_are_named(three: Scene, pair: dict[str, dp.Views]) -> None:
    views, board = three.views, three.board
    one, many = views["cam0"], dp.Views.stack([views["cam0"], views["cam0"]])
    cases = [
        (TypeError, r"views_by_camera\[0\]: want a mapping", lambda: dp.calibrate_rig([one, one], board)),  # type: ignore
        (ValueError, "at least two cameras, got 1", lambda: dp.calibrate_rig({"a": one}, board)),
        (TypeError, r"views_by_camera\['b'\]", lambda: dp.calibrate_rig({"a": one, "b": 3}, board)),  # type: ignore
        (ValueError, r"views_by_camera\['b'\]: want those of one", lambda: dp.calibrate_rig({"a": one, "b": many}, board)),
        (ValueError, "want 54 corners|want 12 corners", lambda: dp.calibrate_rig(pair, dp.Chessboard(4, 3))),
        (ValueError, "distortion", lambda: dp.calibrate_rig(views, board, "brown6")),  # type: ignore
        (ValueError, "distortion: want a lens for each", lambda: dp.calibrate_rig(views, board, {"cam0": "brown5"})),
        (ValueError, "distortion: .* got one for None", lambda: dp.calibrate_rig(views, board, {None: "brown5"})),
        (ValueError, "moments: want those of every", lambda: dp.calibrate_rig(pair, BOARD, moments={"left": range(13)})),
        (ValueError, "got none|want 13", lambda: dp.calibrate_rig(pair, BOARD, moments={"left": [1], "right": [1]})),
        (ValueError, "cameras: want names", lambda: dp.calibrate_rig(pair, BOARD, cameras={"x": three.cameras["cam0"]})),
        (ValueError, "fixed: want names", lambda: dp.calibrate_rig(pair, BOARD, fixed=("left.k9",))),
        (ValueError, "fixed: want cameras=", lambda: dp.calibrate_rig(pair, BOARD, fixed=("rig",))),
        (ValueError, "fixed: want cameras=", lambda: dp.calibrate_rig(pair, BOARD, fixed=("intrinsics",))),
        (TypeError, "want options of", lambda: dp.calibrate_rig(pair, BOARD, bow=True)),  # type: ignore
        (ValueError, "weights: want names", lambda: dp.calibrate_rig(pair, BOARD, weights={"x": 1.0})),
    ]  # fmt: skip
    for kind, message, call in cases:
        with pytest.raises(kind, match=message):
            call()


def test_landmarks_in_space_are_a_target() -> None:
    """A cage of points far from the world's origin, turned before two cameras."""
    draw = torch.Generator().manual_seed(1)
    cage = torch.rand(20, 3, generator=draw, dtype=D) * torch.tensor([4.0, 3, 2], dtype=D)
    cage = cage + torch.tensor([100.0, 200, 5], dtype=D)
    K = torch.tensor([[900.0, 0, 640], [0, 900, 480], [0, 0, 1]], dtype=D)
    place = dp.Camera(
        K, dp.rotation_from_euler(*torch.tensor([0.02, 0.25, 0.01], dtype=D)), torch.tensor([-1.5, 0.1, 0.2], dtype=D)
    )
    for noise, moments in ((0.0, 4), (0.3, 8)):
        R = dp.rotation_from_euler(*(torch.rand(3, moments, generator=draw, dtype=D) - 0.5) * 1.2)
        t = torch.randn(moments, 3, generator=draw, dtype=D) * 0.3 + torch.tensor([0.0, 0, 8], dtype=D)
        left = dp.Camera(K, R, t - R @ cage.mean(0))
        right = dp.Camera(K, place.R @ left.R, left.t @ place.R.mT + place.t)
        views = {}
        for name, camera in (("left", left), ("right", right)):
            pixels = camera.project(cage)[0]
            pixels = pixels + noise * torch.randn(pixels.shape, generator=draw, dtype=D)
            views[name] = dp.Views(pixels, size=(1280, 960))
        rig = dp.calibrate_rig(views, dp.Landmarks(cage), "none")
        off = rig.cameras["right"].t - place.t
        if noise == 0:
            assert off.abs().max() < 1e-9
            continue
        assert bool((off.abs() < 4 * rig.place_covariance("right").diagonal().sqrt()[3:]).all())
        assert rig.rms == pytest.approx(noise * 2**0.5, rel=0.15)
        errors = dp.cross_validate_rig(views, dp.Landmarks(cage), "none", folds=2)
        assert errors.held_out_px.amax() < 0.7
        lines = errors.summary().splitlines()
        assert [line.split()[0] for line in lines] == ["fold", "1", "2", "all"]
        assert lines[1].split()[1:3] == [f"{part[0]:.4f}" for part in (errors.in_sample_px, errors.held_out_px)]
        assert errors.held_out_world.amax() < 0.7 * 8 / 900
    with pytest.raises(ValueError, match="shape: want 'flat' for points that are not all on z = 0, got 'free'"):
        dp.calibrate_rig(views, dp.Landmarks(cage), "none", shape="free")


def test_what_is_said_of_a_camera_alone_names_its_own_photographs() -> None:
    """By the moments that they have names of, and not by their place among those that the camera has seen."""
    views = {side: dp.example_views(side) for side in ("left", "right")}
    kept = [0, 1, 3, 4, 5, 7, 8, 9, 10, 11, 12]
    pixels = views["left"].pixels[kept].to(torch.float64)
    pixels[[2, 7]] = torch.tensor([639.0, 479.0], dtype=torch.float64) - pixels[[2, 7]]  # turned, those of 3 and 9
    given = {
        "left": dp.Views(pixels, names=tuple(f"moment {k}" for k in kept), size=(640, 480)),
        "right": dp.Views(views["right"].pixels, names=tuple(f"moment {k}" for k in range(13)), size=(640, 480)),
    }
    remarks = dp.calibrate_rig(given, dp.Chessboard(), throw=False).remarks
    assert any(one.startswith("left, on its own: moment 3 and moment 9 are turned by 180 degrees") for one in remarks)
