"""A rig's error bars: places, intrinsics and triangulated points scatter about the truth as their covariance says."""

import math

import pytest
import torch

import diffproj as dp
from tests.calibration.rigs.rig_scenes import Scene, off_truth, scene

D = torch.float64


@pytest.fixture(scope="module")
def three() -> Scene:
    return scene(3, 15, seed=3)


@pytest.fixture(scope="module")
def rig(three: Scene) -> dp.RigCalibration:
    return dp.calibrate_rig(three.views, three.board)


def corners(true: Scene, points: torch.Tensor, noise: float = 0.0, seed: int = 0) -> dict[str, torch.Tensor]:
    """Pixels of points in all cameras of a rig."""
    draw = torch.Generator().manual_seed(seed)
    pixels = {name: camera.project(points)[0] for name, camera in true.cameras.items()}
    return {name: at + noise * torch.randn(at.shape, generator=draw, dtype=D) for name, at in pixels.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cameras", "moments", "chain"), [(2, 20, False), (4, 20, False), (4, 24, True), (8, 20, False)]
)
def test_places_scatter_as_their_covariance_says(cameras: int, moments: int, chain: bool) -> None:
    trials = 40 if cameras < 8 else 12
    squares, units, focal, points = [], [], [], []
    for seed in range(trials):
        true = scene(cameras, moments, missing=0.0 if chain else 0.3, chain=chain, seed=seed)
        rig = dp.calibrate_rig(true.views, true.board)
        for name in rig.names[1:]:
            off, C = off_truth(rig, true, name), rig.place_covariance(name)
            squares.append(float(off @ torch.linalg.solve(C, off)) / 6)
            units.append(off / C.diagonal().sqrt())
        for name in rig.names:
            deviation = rig[name].covariance.deviations["f_x"]
            focal.append((rig.cameras[name].K[0, 0] - true.cameras[name].K[0, 0]) / deviation)
        X = torch.tensor([[100.0, 50, 1800], [-200, 100, 2200]], dtype=D)
        found = rig.triangulate(corners(true, X, 0.2, seed))
        off = found.points - X
        points.append((off.unsqueeze(1) @ torch.linalg.inv(found.covariance) @ off.unsqueeze(-1)).flatten() / 3)
    # Measured: .85 to 1.17 of chi-square, coverage .59 to .72 and .94 to .97, with 12 to 100 rigs.
    assert sum(squares) / len(squares) == pytest.approx(1, abs=0.3)
    for values in (torch.stack(units).flatten(), torch.stack(focal)):
        assert float((values.abs() < 1).double().mean()) == pytest.approx(0.683, abs=0.12)
        assert float((values.abs() < 1.96).double().mean()) == pytest.approx(0.95, abs=0.05)
    assert float(torch.cat(points).mean()) == pytest.approx(1, abs=0.3)


def unlike(seed: int) -> tuple[Scene, dict[str, dp.Views]]:
    """A pair whose second camera's corners scatter five times as much as the first's."""
    sharp, rough = scene(2, 20, noise=0.1, seed=seed), scene(2, 20, noise=0.5, seed=seed)
    return sharp, {"cam0": sharp.views["cam0"], "cam1": rough.views["cam1"]}


def test_cameras_of_unlike_noise_are_told_and_weighed() -> None:
    true, views = unlike(1)
    rig = dp.calibrate_rig(views, true.board)
    for name, noise in (("cam0", 0.1), ("cam1", 0.5)):
        assert float(rig[name].pixel_sigma) == pytest.approx(noise, rel=0.1)  # type: ignore[arg-type]
    assert any("weights={'cam0':" in remark for remark in rig.remarks)
    weighed = dp.calibrate_rig(views, true.board, weights={"cam0": 100.0, "cam1": 4.0})
    for name in rig.names:
        alone = dp.calibrate(views[name], true.board).covariance.deviations["f_x"]
        assert float(weighed[name].covariance.deviations["f_x"]) < 1.1 * float(alone)
    assert weighed.baseline("cam0", "cam1").deviation < rig.baseline("cam0", "cam1").deviation
    assert not any("weights=" in remark for remark in weighed.remarks)


@pytest.mark.slow
@pytest.mark.parametrize("weights", [None, {"cam0": 100.0, "cam1": 4.0}])
def test_unlike_noise_gives_honest_error_bars(weights: dict[str, float] | None) -> None:
    squares, focal = [], []
    for seed in range(40):
        true, views = unlike(seed)
        rig = dp.calibrate_rig(views, true.board, weights=weights)
        off, C = off_truth(rig, true, "cam1"), rig.place_covariance("cam1")
        squares.append(float(off @ torch.linalg.solve(C, off)) / 6)
        for name in rig.names:
            deviation = rig[name].covariance.deviations["f_x"]
            focal.append((rig.cameras[name].K[0, 0] - true.cameras[name].K[0, 0]) / deviation)
    assert sum(squares) / len(squares) == pytest.approx(1, abs=0.3)
    assert float(torch.stack(focal).square().mean()) == pytest.approx(1, abs=0.35)


def test_the_joint_covariance_is_the_dense_one(rig: dp.RigCalibration) -> None:
    joint = rig.covariance.full()
    s = len(rig.covariance.names)
    assert torch.allclose(joint[:s, :s], rig.covariance.shared, rtol=1e-9, atol=0)
    for number, name in enumerate(rig.names):
        own = rig[name].covariance
        columns = [i for i, key in enumerate(rig.covariance.names) if key.startswith(f"{name}.")][:9]
        assert torch.allclose(own.shared[:9, :9], joint[columns][:, columns], rtol=1e-9, atol=0)
        # The pose in a view is the camera's place after the target's: R_v = R_c R_m.
        camera, view = rig.cameras[name], 1
        moment = int(rig.where[name][view])
        A, B = torch.zeros(6, len(joint), dtype=D), torch.block_diag(camera.R, camera.R)
        arm = camera.R @ rig.t_target[moment]
        cross = torch.linalg.cross(torch.eye(3, dtype=D), arm.expand(3, 3)).T
        if number:
            place = [i for i, key in enumerate(rig.covariance.names) if key.startswith(f"{name}.")][9:]
            A[:, place] = torch.eye(6, dtype=D)
            A[3:, place[:3]] += cross
        A[:, s + 6 * moment : s + 6 * moment + 6] += B
        full = rig.covariance.full()
        expected = A @ full @ A.T
        assert torch.allclose(own.between(view, view), expected, rtol=1e-6, atol=1e-12)


def test_triangulated_points_are_found_and_held_to_account(three: Scene, rig: dp.RigCalibration) -> None:
    X = torch.tensor([[100.0, 50, 1800], [-200, 100, 2200], [300, -100, 1500]], dtype=D)
    exact = {name: camera.project(X)[0] for name, camera in rig.cameras.items()}
    found = rig.triangulate(exact)
    assert bool(found.valid.all())
    assert torch.allclose(found.points, X, atol=1e-6)
    # Against sampling: pixels alone move them by so much, with the rig held.
    draw = torch.Generator().manual_seed(0)
    many = {name: at.repeat(400, 1) + 0.3 * torch.randn(1200, 2, generator=draw, dtype=D) for name, at in exact.items()}
    scattered = rig.triangulate(many, pixel_sigma=0.3).points.reshape(400, 3, 3)
    frozen = dp.calibrate_rig(three.views, three.board, cameras=rig.cameras, fixed=("rig", "intrinsics"))
    held = frozen.triangulate(exact, pixel_sigma=0.3)
    assert torch.allclose(scattered.std(0), held.deviations, rtol=0.12)
    assert bool((found.deviations > frozen.triangulate(exact).deviations).all())
    length, deviation = found.length(0, 1)
    assert length == pytest.approx(float((X[0] - X[1]).norm()), abs=1e-6)
    C = torch.cat([torch.cat([found.between(i, j) for j in (0, 1)], dim=-1) for i in (0, 1)])
    slope = torch.cat([X[0] - X[1], X[1] - X[0]]) / length
    assert deviation == pytest.approx(math.sqrt(float(slope @ C @ slope)), rel=1e-9)


def test_points_that_too_few_cameras_see_are_not_valid(rig: dp.RigCalibration) -> None:
    X = torch.tensor([[100.0, 50, 1800], [-200, 100, 2200], [300, -100, 1500]], dtype=D)
    pixels = {name: camera.project(X)[0] for name, camera in rig.cameras.items()}
    pixels["cam1"][0] = torch.nan
    pixels["cam2"][0] = torch.nan
    pixels["cam2"][1] = torch.nan
    found = rig.triangulate(pixels)
    assert found.valid.tolist() == [False, True, True]
    assert torch.allclose(found.points[1:], X[1:], atol=1e-6)
    assert torch.equal(found.points[0], torch.zeros(3, dtype=D))
    two = rig.triangulate({name: pixels[name] for name in ("cam0", "cam1")})
    assert two.points[1].allclose(X[1], atol=1e-6)


def test_baselines_against_the_joint_covariance(rig: dp.RigCalibration) -> None:
    length, deviation = rig.baseline("cam1", "cam2")
    centers = [rig.cameras[name].center for name in ("cam1", "cam2")]
    assert length == pytest.approx(float((centers[0] - centers[1]).norm()))
    assert rig.baseline("cam2", "cam1") == pytest.approx((length, deviation))
    names = rig.covariance.names
    rows = [i for i, key in enumerate(names) if key.rpartition(".")[2][:5] in ("omega", "tau_x", "tau_y", "tau_z")]
    C = rig.covariance.shared[rows][:, rows]
    draw = torch.distributions.MultivariateNormal(torch.zeros(12, dtype=D), C)
    torch.manual_seed(1)
    steps = draw.sample((4000,))
    places = []
    for i, name in enumerate(("cam1", "cam2")):
        camera = rig.cameras[name]
        omega, tau = steps[:, 6 * i : 6 * i + 3], steps[:, 6 * i + 3 : 6 * i + 6]
        turn = torch.matrix_exp(torch.linalg.cross(omega.unsqueeze(1), torch.eye(3, dtype=D).unsqueeze(0)).mT)
        R = turn @ camera.R
        places.append(-(R.mT @ (camera.t + tau).unsqueeze(-1)).squeeze(-1))
    assert float((places[0] - places[1]).norm(dim=-1).std()) == pytest.approx(deviation, rel=0.05)


def test_each_camera_measures_with_its_part_of_the_joint_covariance(three: Scene, rig: dp.RigCalibration) -> None:
    one = rig["cam1"]
    pixels = one.views.pixels[0, :4]
    found = dp.measure(pixels, one, dp.Plane.z(0.0), view=0, pixel_sigma="detector")
    alone = dp.calibrate(three.views["cam1"], three.board)
    before = dp.measure(pixels, alone, dp.Plane.z(0.0), view=0, pixel_sigma="detector")
    assert torch.allclose(found.points, three.board.points[:4].to(D), atol=1.0)
    assert bool((found.deviations.nan_to_num() <= 1.1 * before.deviations.nan_to_num()).all())
    located = dp.locate(three.views["cam1"][:2], three.board, one)
    assert located.knows_intrinsics
    projector = dp.PlaneProjector(one.cameras[0], dp.Plane.z(0.0))
    assert torch.allclose(projector(pixels)[0], found.points)


@pytest.mark.slow
@pytest.mark.parametrize("blur", [1.2, 3.0])
def test_points_at_a_moment_that_was_blurred_for_one_camera(blur: float) -> None:
    """By the noise of all moments together they would be off by twice their deviations and more."""
    errors: dict[str, list[torch.Tensor]] = {"cam0": [], "cam1": []}
    for seed in range(10):
        true = scene(2, 12, missing=0.0, seed=seed)
        pixels, moment = true.views["cam1"].pixels.clone(), true.views["cam1"].names[0]
        pixels[0] += blur * torch.randn(pixels[0].shape, generator=torch.Generator().manual_seed(seed), dtype=D)
        blurred = dp.Views(pixels, true.views["cam1"].visible, true.views["cam1"].names, size=(1280, 960))
        rig = dp.calibrate_rig(true.views | {"cam1": blurred}, true.board)
        m = int(moment.removeprefix("moment "))
        for name in errors:
            if moment not in true.views[name].names:
                continue
            camera = true.cameras[name]
            there = camera.at(camera.R @ true.R[m], camera.R @ true.t[m] + camera.t)
            points = true.board.points[[0, len(true.board.points) - 1]].to(D)
            measured = dp.measure(there.project(points)[0], rig[name], dp.Plane.z(0.0), moment, pixel_sigma=1e-3)
            errors[name].append(((measured.points - points) / measured.deviations)[:, :2].flatten())
    for off in errors.values():
        assert len(off) > 3
        assert 0.5 < float(torch.cat(off).square().mean().sqrt()) < 1.4
