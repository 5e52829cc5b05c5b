"""The target's shape from all cameras of a rig: its minimum, covariance and frame, and what real photographs gain."""

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj.calibration.problem.shape import similarities
from diffproj.calibration.rigs import outcome
from diffproj.geometry.cayley import turned

D = torch.float64
BOARD = dp.Chessboard(4, 3, 30.0)
BUNDLED = {name: dp.example_views(name) for name in ("left", "right")}


def scene(noise: float = 0.1, missing: int = 1, seed: int = 0) -> tuple[dict[str, dp.Views], Tensor]:
    """Two cameras without a lens that see a badly printed board at eight moments, each of which misses some."""
    generator = torch.Generator().manual_seed(seed)
    K = torch.tensor([[[500.0, 0, 320], [0, 510, 240], [0, 0, 1]], [[380, 0, 310], [0, 370, 250], [0, 0, 1]]], dtype=D)
    poses = dp.synthetic.random_cameras(dp.Camera(K[0], size=(640, 480)), BOARD, 8, distance=(1.2, 1.8), seed=3)
    printed = BOARD.points.to(D) + 0.3 * torch.randn(12, 3, generator=generator, dtype=D)
    R = dp.rotation_from_euler(*torch.tensor([0.0, 0.1, 0.05], dtype=D))
    t = torch.tensor([-40.0, 3, 5], dtype=D)
    other = dp.Camera(K[1], R @ poses.R, (R @ poses.t.unsqueeze(-1)).squeeze(-1) + t)
    views = {}
    for name, camera, seen in (("a", poses, range(8 - missing)), ("b", other, range(missing, 8))):
        pixels = camera.project(printed)[0] + noise * torch.randn(8, 12, 2, generator=generator, dtype=D)
        views[name] = dp.Views(pixels[list(seen)], names=[str(i) for i in seen], size=(640, 480))
    return views, printed


def test_minimum_and_covariance_are_those_of_the_slow_obvious_way(monkeypatch: pytest.MonkeyPatch) -> None:
    # By chance these views have something in common, which the obvious way does not look for.
    monkeypatch.setattr(outcome, "common_errors", lambda *_: None)
    views, _ = scene()
    rig = dp.calibrate_rig(views, BOARD, "none", shape="free")
    nominal = BOARD.points.to(D)
    frame = similarities(nominal, torch.zeros(1, 12, dtype=torch.bool))[0]
    moments = {name: torch.tensor([int(view) for view in one.names]) for name, one in views.items()}

    def residuals(x: Tensor) -> Tensor:
        K, place, poses, moves = x[:8].unflatten(0, (2, 4)), x[8:14], x[14:62].unflatten(0, (8, 6)), x[62:]
        R_m = turned(rig.R_target, poses[:, :3])
        X = (nominal + moves.unflatten(0, (12, 3))) @ R_m.mT + (rig.t_target + poses[:, 3:]).unsqueeze(1)
        errors = []
        for c, name in enumerate(views):
            camera = rig.cameras[name]
            R, t = (turned(camera.R, place[:3]), camera.t + place[3:]) if c else (camera.R, camera.t)
            seen = X[moments[name]] @ R.mT + t
            errors.append((seen[..., :2] / seen[..., 2:] * K[c, :2] + K[c, 2:] - views[name].pixels).flatten())
        return torch.cat([*errors, 1e2 * frame.mT @ moves])

    x = torch.zeros(98, dtype=D)
    x[:8] = torch.cat([rig[name].shared[:4] for name in views]) + torch.tensor([2.0, -1, 1, 0, 1, 1, 0, -2], dtype=D)
    for _ in range(12):  # Gauss and Newton, from a start that is a little off
        J, r = torch.func.jacrev(residuals)(x), residuals(x)
        x = x - torch.linalg.lstsq(J, r.unsqueeze(-1)).solution.squeeze(-1)
    assert (x[:8] - torch.cat([rig[name].shared[:4] for name in views])).abs().max() < 1e-5
    assert (x[62:].unflatten(0, (12, 3)) - (rig.points - nominal)).abs().max() < 1e-7
    r = residuals(x)[:-7]
    assert rig.rms == pytest.approx(float(r.square().sum() / (len(r) / 2)) ** 0.5, rel=1e-9)
    # Each camera's noise has its own share of the freedom; sandwiched between the whole normal matrix.
    sigma = {name: float(rig[name].pixel_sigma) for name in views}
    halves = [2 * 12 * len(views[name]) for name in views]
    freedom = sum(float(rig[name].degrees_of_freedom) for name in views)
    assert freedom == pytest.approx(len(r) - (98 - 7))
    J = torch.func.jacrev(residuals)(x)
    inverse = torch.linalg.inv(J.mT @ J)
    noise = torch.cat([torch.full((n,), sigma[name] ** 2, dtype=D) for n, name in zip(halves, views, strict=True)])
    whole = inverse @ (J[:-7].mT * noise) @ J[:-7] @ inverse
    phi = rig.covariance.dispersion
    order = [*range(4), *range(4, 14), *range(62, 98)]
    assert torch.allclose(phi * whole[order][:, order], rig.covariance.shared, rtol=1e-4, atol=1e-9)
    assert torch.allclose(rig.points_deviation.flatten().square(), phi * whole.diagonal()[62:], rtol=1e-5)
    for name in views:
        own = rig[name]
        assert torch.equal(own.points, rig.points)
        assert torch.equal(own.covariance.points, rig.covariance.points)
        assert own.covariance.names[: len(own.parameters.names)] == own.parameters.names
        assert torch.allclose(own.covariance.view(0), own.covariance.view(0).mT)


@pytest.mark.slow
def test_sampling_reproduces_the_covariance() -> None:
    """Squared errors of focal lengths, of the other place and of the points, over their variances: .95, .85, .96."""
    squares: dict[str, list[Tensor]] = {"focal": [], "place": [], "points": []}
    t = torch.tensor([-40.0, 3, 5], dtype=D)
    for seed in range(30):
        views, printed = scene(seed=seed, missing=0)
        rig = dp.calibrate_rig(views, BOARD, "none", shape="free")
        # The printed board in the frame, and at the size, that the target's points have.
        a, b = (points - points.mean(0) for points in (BOARD.points.to(D), printed))
        U, S, Vh = torch.linalg.svd(a.mT @ b)
        size = float(S.sum() / a.square().sum())
        truth = b @ (U @ Vh).mT / size + BOARD.points.to(D).mean(0)
        squares["points"].append(((rig.points - truth) / rig.points_deviation).square().flatten())
        spread = rig.covariance.deviations
        off = torch.stack([rig[name].camera.K[0, 0] for name in ("a", "b")]) - torch.tensor([500.0, 380], dtype=D)
        squares["focal"].append((off / torch.stack([spread[f"{name}.f_x"] for name in ("a", "b")])).square())
        variance = rig.place_covariance("b").diagonal()[3:]
        squares["place"].append((rig.cameras["b"].t - t / size).square() / variance)
    for name, found in squares.items():
        assert 0.5 < torch.cat(found).mean() < 1.25, name


def test_one_camera_that_sees_all_is_as_alone() -> None:
    """The other has little weight: it tells nearly nothing of the points."""
    views, _ = scene(missing=0)
    known = {"b": dp.calibrate(views["b"], BOARD, "none").camera}
    options = {"cameras": known, "fixed": ("b.intrinsics",), "weights": {"b": 1e-7}}
    rig = dp.calibrate_rig(views, BOARD, "none", shape="free", **options)
    alone = dp.calibrate(views["a"], BOARD, "none", shape="free")
    assert (rig["a"].shared - alone.shared).abs().max() < 1e-3
    assert float(rig["a"].rms) == pytest.approx(float(alone.rms), rel=1e-6)


def test_exact_corners_give_the_printed_points_in_the_targets_frame() -> None:
    views, printed = scene(noise=0.0)
    rig = dp.calibrate_rig(views, BOARD, "none", shape="free")
    assert rig.rms < 1e-8
    moves = (rig.points - BOARD.points).flatten()
    frame = similarities(BOARD.points.to(D), torch.zeros(1, 12, dtype=torch.bool))[0]
    assert (frame.mT @ moves).abs().max() < 1e-9
    # Up to a similarity they are the printed ones.
    a, b = (points - points.mean(0) for points in (rig.points, printed))
    U, S, Vh = torch.linalg.svd(a.mT @ b)
    scale = S.sum() / a.square().sum()
    assert (scale * a @ U @ Vh - b).abs().max() < 1e-6


def test_points_stay_in_the_plane_if_asked_to() -> None:
    views, _ = scene()
    rig = dp.calibrate_rig(views, BOARD, "none", shape="free", fixed=("points_z",))
    assert bool((rig.points[:, 2] == 0).all())
    assert bool((rig.points_deviation[:, 2] == 0).all())
    assert bool((rig.points_deviation[:, :2] > 0).all())
    flat = dp.calibrate_rig(views, BOARD, "none")
    free = dp.calibrate_rig(views, BOARD, "none", shape="free")
    assert flat.rms > rig.rms > free.rms
    held = dp.calibrate_rig(views, BOARD, "none", shape="free", cameras=flat.cameras, fixed=("intrinsics", "rig"))
    assert torch.equal(held["a"].camera.K, flat["a"].camera.K)
    assert bool((held.place_covariance("b") == 0).all())
    assert bool((held.points_deviation[:, :2] > 0).all())


def test_outliers_are_rejected_with_free_points() -> None:
    views, _ = scene()
    clean = dp.calibrate_rig(views, BOARD, "none", shape="free")
    pixels = views["a"].pixels.clone()
    pixels[2, 5] += torch.tensor([30.0, -20.0], dtype=D)
    wrong = views | {"a": dp.Views(pixels, names=views["a"].names, size=(640, 480))}
    found = dp.calibrate_rig(wrong, BOARD, "none", shape="free", reject_outliers=True)
    assert found["a"].rejected.nonzero().tolist() == [[2, 5]]
    assert (found.points - clean.points).abs().max() < 0.1


def test_it_says_of_too_few_views_and_of_what_it_has_not() -> None:
    views, _ = scene()
    few = {name: one[:2] for name, one in views.items()}
    known = dp.calibrate_rig(views, BOARD, "none")
    with pytest.raises(dp.CalibrationError, match="4 views do not determine the shape of the target"):
        dp.calibrate_rig(few, BOARD, "none", shape="free", cameras=known, fixed=("intrinsics",))
    with pytest.raises(ValueError, match="fixed: want 'points_z' with shape='free' only"):
        dp.calibrate_rig(views, BOARD, "none", fixed=("points_z",))


def test_the_bundled_pair() -> None:
    """Its fit, its board and its baseline; and points of the board, triangulated, lie where they were printed."""
    free = dp.calibrate_rig(BUNDLED, dp.Chessboard(), shape="free")
    assert free.rms == pytest.approx(0.0917, abs=2e-3)  # flat: .1732
    off = (free.points - dp.Chessboard().points).square().mean(0).sqrt()
    assert torch.allclose(off, torch.tensor([0.079, 0.063, 0.086], dtype=D), atol=0.005)
    length, deviation = free.baseline("left", "right")
    assert length == pytest.approx(83.31, abs=0.05)
    assert 0.02 < deviation < 0.1
    assert "points off by 0.0" in free.summary()
    assert "x_0" not in free.summary()
    assert "shape='free'" not in free.message
    seen = {name: views.pixels[0] for name, views in BUNDLED.items()}
    placed = free.triangulate(seen).points
    there = free.points @ free.R_target[0].mT + free.t_target[0]
    flat = dp.calibrate_rig(BUNDLED, dp.Chessboard())
    flat_there = flat.points @ flat.R_target[0].mT + flat.t_target[0]
    assert (placed - there).norm(dim=-1).mean() < 0.8 * (flat.triangulate(seen).points - flat_there).norm(dim=-1).mean()


def test_held_out_moments_are_met_by_the_board_as_it_was_printed() -> None:
    """Exact corners leave nothing over, at moments that were held out too; as a flat board they leave pixels."""
    views, _ = scene(noise=0.0)
    errors = dp.cross_validate_rig(views, BOARD, "none", folds=2, shape="free")
    assert float(errors.held_out_px.amax()) < 1e-6
    flat = dp.cross_validate_rig(views, BOARD, "none", folds=2)
    assert float(flat.held_out_px.amin()) > 1


@pytest.mark.slow
def test_held_out_moments_of_the_bundled_pair() -> None:
    errors = dp.cross_validate_rig(BUNDLED, dp.Chessboard(), shape="free")
    assert errors.held_out_px.square().mean().sqrt() < 0.112  # .1087; flat: .1853
    assert errors.held_out_world.square().mean().sqrt() < 0.075  # flat: .1283


def test_a_file_keeps_the_shape(tmp_path) -> None:
    rig = dp.calibrate_rig(BUNDLED, dp.Chessboard(), shape="free")
    dp.save_camera(tmp_path / "rig.json", rig)
    again = dp.load(tmp_path / "rig.json")
    assert isinstance(again, dp.RigCalibration)
    assert again.shape == "free"
    assert torch.equal(again.points, rig.points)
    assert torch.equal(again.points_deviation, rig.points_deviation)
    assert again.summary() == rig.summary()


def test_what_a_camera_of_the_rig_is_used_for() -> None:
    """A new view is located on the board as printed; measuring takes the camera's own part of the covariance."""
    rig = dp.calibrate_rig({name: views[:10] for name, views in BUNDLED.items()}, dp.Chessboard(), shape="free")
    new = BUNDLED["left"][10:]
    printed = dp.locate(new, dp.Chessboard(), rig["left"])
    designed = dp.locate(new, dp.Chessboard(), rig["left"], same_target=False)
    assert printed.shape == "free"
    assert printed.rms < 0.75 * designed.rms
    measured = dp.measure(new.pixels[0], printed, dp.Plane.z(0.0), view=0, pixel_sigma="detector")
    assert bool((measured.deviations[:, :2] > 0.005).all())
    assert bool((measured.deviations[:, :2] < 0.5).all())
