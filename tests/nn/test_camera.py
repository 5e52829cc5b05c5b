"""`LearnableCamera` and the residual functions: plain PyTorch reaches the solver's minimum."""

import copy
import io
import pickle
from collections.abc import Callable

import cv2
import pytest
import torch

import diffproj as dp
from diffproj import synthetic
from diffproj.lens import coefficients

D = torch.float64
BOARD = dp.Chessboard()


@pytest.fixture(scope="module")
def rough() -> tuple[dp.Camera, dp.Views, dp.Calibration]:
    """A camera some way off the minimum, the views, and the minimum."""
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D)
    lens = dp.BrownConrady(torch.tensor([-0.25, 0.05, 0.001, 0.0002], dtype=D))
    truth = synthetic.random_cameras(dp.Camera(K, distortion=lens, size=(640, 480)), BOARD, 5)
    views = synthetic.corner_views(truth, BOARD)
    best = dp.calibrate(views, BOARD, "brown4")
    off = best.camera.K + torch.tensor([[8.0, 0, 4], [0, -6, -5], [0, 0, 0]], dtype=D)
    camera = dp.Camera(off, best.cameras.R, best.cameras.t + 3.0, dp.BrownConrady(torch.zeros(4, dtype=D)), (640, 480))
    return camera, views, best


def cost(learnable: dp.LearnableCamera, views: dp.Views) -> torch.Tensor:
    error, valid = dp.image_residuals(learnable(), views, BOARD)
    return error.square().sum() / valid.sum()


def pinhole() -> tuple[dp.Camera, dp.Views, dp.Chessboard, dp.Calibration]:
    """The same without a lens and with a small board: well determined, and quick to step."""
    board = dp.Chessboard(columns=4, rows=4, square=50.0)
    K = torch.tensor([[533.0, 0, 322], [0, 534, 238], [0, 0, 1]], dtype=D)
    truth = synthetic.random_cameras(dp.Camera(K, size=(640, 480)), board, 6, distance=(2.0, 3.0), seed=1)
    views = synthetic.corner_views(truth, board)
    best = dp.calibrate(views, board, "none")
    off = best.camera.K + torch.tensor([[8.0, 0, 4], [0, -6, -5], [0, 0, 0]], dtype=D)
    return dp.Camera(off, best.cameras.R, best.cameras.t + 3.0), views, board, best


def by_lbfgs(learnable: dp.LearnableCamera, value: Callable[[], torch.Tensor], iterations: int) -> float:
    options = {"max_iter": iterations, "tolerance_grad": 1e-13, "tolerance_change": 1e-18, "history_size": 100}
    optimiser = torch.optim.LBFGS(learnable.parameters(), line_search_fn="strong_wolfe", **options)

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        now = value()
        now.backward()
        return now

    optimiser.step(closure)
    return float(value().detach())


def test_lbfgs_reaches_the_solvers_minimum() -> None:
    camera, views, board, best = pinhole()
    learnable = dp.LearnableCamera(_one_intrinsics(camera))
    mean = by_lbfgs(learnable, lambda: dp.image_residuals(learnable(), views, board)[0].square().sum() / (6 * 16), 1500)
    assert mean**0.5 == pytest.approx(float(best.rms), rel=1e-7)
    assert (learnable().K[0] - best.camera.K).abs().max() < 0.01


@pytest.mark.slow
def test_adam_reaches_the_solvers_minimum() -> None:
    camera, views, board, best = pinhole()
    learnable = dp.LearnableCamera(_one_intrinsics(camera))
    steps = 1500
    optimiser = torch.optim.Adam(learnable.parameters(), lr=1e-2, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=1e-2, total_steps=steps, cycle_momentum=False)
    for _ in range(steps):
        optimiser.zero_grad()
        error, valid = dp.image_residuals(learnable(), views, board)
        (error.square().sum() / valid.sum()).backward()
        optimiser.step()
        schedule.step()
    error, _ = dp.image_residuals(learnable(), views, board)
    assert (error.detach().square().sum() / (6 * 16)).sqrt().item() == pytest.approx(float(best.rms), rel=1e-3)


def test_a_lens_is_learned_along(rough: tuple[dp.Camera, dp.Views, dp.Calibration]) -> None:
    camera, views, best = rough
    learnable = dp.LearnableCamera(_one_intrinsics(camera))
    assert by_lbfgs(learnable, lambda: cost(learnable, views), 300) ** 0.5 == pytest.approx(float(best.rms), rel=1e-9)


def _one_intrinsics(camera: dp.Camera) -> dp.Camera:
    """The same camera with intrinsics and lens expanded over the views, so that they are learned as one."""
    return camera[0].at(camera.R, camera.t)


def test_the_plane_objective_by_lbfgs() -> None:
    _, views, board, best = pinhole()
    want = dp.refine(views, board, best.camera, objective="plane")
    learnable = dp.LearnableCamera(best.cameras)
    total = by_lbfgs(learnable, lambda: dp.plane_residuals(learnable(), views, board)[0].square().sum(), 1500)
    error, _ = dp.plane_residuals(want.cameras, views, board)
    assert total == pytest.approx(error.square().sum().item(), rel=1e-6)


def test_a_camera_at_the_origin_can_move(camera: dp.Camera) -> None:
    learnable = dp.LearnableCamera(dp.Camera(camera.K))
    learnable().t.sum().backward()
    assert (learnable.translation.grad == 1).all()


def same_cameras(cameras: dp.Camera) -> dict[str, dp.Camera]:
    """Poses of one camera, expanded or as copies, by all the ways that make the one or the other."""
    K, lens = cameras.K.contiguous(), cameras.distortion
    return {
        "as calibrated": cameras,
        "copied": dp.Camera(K.clone(), cameras.R, cameras.t, dp.BrownConrady(lens.coefficients.clone())),
        "float32": cameras.to(torch.float32),
        "picked": cameras[[0, 2, 3]],
        "a slice": cameras[1:],
        "a mask": cameras[torch.tensor([True, False, True, True, False])],
        "two axes": cameras[None].at(cameras.R.expand(2, 5, 3, 3), cameras.t.expand(2, 5, 3)),
    }


@pytest.mark.parametrize("how", ["as calibrated", "copied", "float32", "picked", "a slice", "a mask", "two axes"])
def test_poses_of_one_camera_learn_one_intrinsics(how: str, rough: tuple[dp.Camera, dp.Views, dp.Calibration]) -> None:
    cameras = same_cameras(rough[2].cameras)[how]
    batch = tuple(cameras.batch_shape)
    once = (1,) * len(batch)
    learnable = dp.LearnableCamera(cameras)
    projector = dp.PlaneProjector(cameras, dp.Plane.z(0.0), ("focal", "principal_point", "distortion"))
    for module in (learnable, projector):
        shapes = {name.split(".")[-1]: tuple(p.shape) for name, p in module.named_parameters()}
        assert shapes["log_focal"] == shapes["principal_point"] == (*once, 2)
        assert shapes["distortion"] == (*once, 4)
    assert torch.equal(learnable().K, cameras.K)
    for module in (
        dp.LearnableCamera(cameras, None, False),
        dp.PlaneProjector(cameras, dp.Plane.z(0.0), "focal", False),
    ):
        assert next(p for n, p in module.named_parameters() if "log_focal" in n).shape == (*batch, 2)


def test_different_cameras_learn_their_own(rough: tuple[dp.Camera, dp.Views, dp.Calibration]) -> None:
    cameras = rough[2].cameras
    K, coefficients = cameras.K.clone(), cameras.distortion.coefficients.clone()
    K[2, 0, 0] += 1e-9
    coefficients[1, 0] += 1e-12
    other_K = dp.Camera(K, cameras.R, cameras.t, cameras.distortion)
    other_lens = dp.Camera(cameras.K, cameras.R, cameras.t, dp.BrownConrady(coefficients))
    for different in (other_K, other_lens):
        learnable = dp.LearnableCamera(different)
        assert learnable.log_focal.shape == (5, 2)
        assert learnable.distortion.shape == (5, 4)
        projector = dp.PlaneProjector(different, dp.Plane.z(0.0), "distortion")
        assert [tuple(p.shape) for p in projector.parameters()] == [(5, 4)]
        for module in (dp.LearnableCamera, lambda *a: dp.PlaneProjector(a[0], dp.Plane.z(0.0), (), a[2])):
            with pytest.raises(ValueError, match="tied_intrinsics: want one K and one lens"):
                module(different, None, True)


def test_training_in_float32_keeps_one_camera(rough: tuple[dp.Camera, dp.Views, dp.Calibration]) -> None:
    camera, views, _ = rough
    learnable = dp.LearnableCamera(_one_intrinsics(camera).to(torch.float32))
    optimiser = torch.optim.Adam(learnable.parameters(), lr=1e-3)
    for _ in range(3):
        optimiser.zero_grad()
        cost(learnable, views.to(torch.float32)).backward()
        optimiser.step()
    now = learnable()
    assert (now.K[:1] == now.K).all()
    assert not torch.equal(now.K[0], camera.K[0].float())


def test_tied_stays_tied_through_copies_and_conversions(rough: tuple[dp.Camera, dp.Views, dp.Calibration]) -> None:
    learnable = dp.LearnableCamera(rough[2].cameras)
    with torch.no_grad():
        for parameter in learnable.parameters():
            parameter += 0.01 * torch.rand_like(parameter)
    single = copy.deepcopy(learnable).to(torch.float32)
    again = dp.LearnableCamera(single())  # from a camera that training gave
    back = copy.deepcopy(single).to(D)
    for module in (single, again, back, pickle.loads(pickle.dumps(learnable))):  # noqa: S301
        assert module.log_focal.shape == (1, 2)
        assert (module().K[:1] == module().K).all()
        assert (module().distortion.coefficients == module().distortion.coefficients[:1]).all()
    again.load_state_dict(learnable.state_dict())
    assert again().K.dtype == torch.float32


@pytest.mark.parametrize("part", ["learnable", "projector"])
def test_a_state_with_other_tying_is_refused_with_the_cause(
    part: str, rough: tuple[dp.Camera, dp.Views, dp.Calibration]
) -> None:
    def module(tied: bool | None) -> torch.nn.Module:
        if part == "learnable":
            return dp.LearnableCamera(rough[2].cameras, tied_intrinsics=tied)
        return torch.nn.ModuleDict({"p": dp.PlaneProjector(rough[2].cameras, dp.Plane.z(0.0), "pose", tied)})

    name = "K_0" if part == "learnable" else "p.geometry.camera.K_0"
    for mine, theirs in ((None, False), (False, None)):
        with pytest.raises(RuntimeError, match=f"{name}: want K of shape .* for the same batch.*tied_intrinsics"):
            module(mine).load_state_dict(module(theirs).state_dict())
    with pytest.raises(RuntimeError) as other:  # another number of cameras is another matter
        dp.LearnableCamera(rough[2].cameras[:3]).load_state_dict(dp.LearnableCamera(rough[2].cameras).state_dict())
    assert "tied" not in str(other.value)


def test_cameras_that_start_alike_may_still_be_different_ones(camera: dp.Camera) -> None:
    two, which = camera.expand(2), {"focal": torch.tensor([True, False])}
    for module in (dp.LearnableCamera, lambda *a: dp.PlaneProjector(a[0], dp.Plane.z(0.0), *a[1:])):
        with pytest.raises(ValueError, match="learn: want the same for all poses.*tied_intrinsics=False"):
            module(two, which)
        parameters = list(module(two, which, False).parameters())
        assert [tuple(p.shape) for p in parameters] == [(2, 2)]


def test_a_batch_of_no_cameras(camera: dp.Camera) -> None:
    assert dp.LearnableCamera(camera.expand(2)[:0])().K.shape == (0, 3, 3)


def test_starts_as_the_camera_it_was_made_from(rough: tuple[dp.Camera, dp.Views, dp.Calibration]) -> None:
    camera, _, best = rough
    for given in (camera, best.cameras, best.camera, dp.Camera(camera.K[0])):
        now = dp.LearnableCamera(given)()
        assert now.batch_shape == given.batch_shape
        assert torch.equal(now.K, given.K)
        torch.testing.assert_close(now.R, given.R, rtol=0, atol=1e-15)
        assert torch.equal(now.t, given.t)
        assert now.size == given.size
    shared = dp.LearnableCamera(best.cameras)
    assert {n: tuple(p.shape) for n, p in shared.named_parameters()} == {
        "log_focal": (1, 2),
        "principal_point": (1, 2),
        "distortion": (1, 4),
        "rotation": (5, 3),
        "translation": (5, 3),
    }
    assert dp.LearnableCamera(dp.Camera(camera.K[0], size=(640, 480)).to_kornia())().batch_shape == (1,)


def test_each_camera_of_a_batch_learns_what_is_its_own(rough: tuple[dp.Camera, dp.Views, dp.Calibration]) -> None:
    _, views, best = rough
    moving = torch.tensor([True, False, True, False, False])
    learnable = dp.LearnableCamera(best.cameras, {"focal": True, "pose": moving, "distortion": False})
    assert learnable.learn == ("focal", "pose")
    optimiser = torch.optim.Adam(learnable.parameters(), lr=1e-3, weight_decay=0.1)
    for _ in range(3):
        optimiser.zero_grad()
        cost(learnable, views).backward()
        optimiser.step()
    now = learnable()
    assert (now.t != best.cameras.t).any(-1).equal(moving)
    assert (now.R != best.cameras.R).flatten(1).any(-1).equal(moving)
    assert (now.K != best.cameras.K)[:, 0, 0].all()
    again = dp.LearnableCamera(best.cameras, {"focal": True, "pose": moving})
    again.load_state_dict(learnable.state_dict())
    assert torch.equal(again().t, now.t)
    with pytest.raises(ValueError, match="learn: want the same for all poses of one camera, got .* for log_focal"):
        dp.LearnableCamera(best.cameras, {"focal": moving})
    for wrong in ([True, False], [True] * 7, [False] * 7 + [True]):
        with pytest.raises(ValueError, match=r"learn: want booleans that broadcast to the batch shape \(5,\)"):
            dp.LearnableCamera(best.cameras, {"pose": torch.tensor(wrong)})


def test_an_image_that_was_turned_is_learned_too(lens_camera: dp.Camera) -> None:
    quarter = torch.tensor([[0.0, -1, 479], [1, 0, 0], [0, 0, 1]], dtype=D)
    turned = lens_camera.warped(quarter, (480, 640))
    straight, along = dp.LearnableCamera(lens_camera), dp.LearnableCamera(turned)
    assert torch.equal(along().K, turned.K)
    with torch.no_grad():
        for learnable in (straight, along):
            learnable.log_focal.copy_(torch.tensor([0.1, -0.2]))
            learnable.principal_point.copy_(torch.tensor([0.03, 0.01]))
    torch.testing.assert_close(along().K, straight().warped(quarter).K)


def test_half_precision_passes_geometry_by(lens_camera: dp.Camera, pixels: torch.Tensor) -> None:
    projector = dp.PlaneProjector(lens_camera.to(torch.float32), dp.Plane.z(0.0), "pose")
    network = torch.nn.ModuleDict({"linear": torch.nn.Linear(2, 2), "to_plane": projector})
    want = projector(pixels.float())[0]
    network.bfloat16()
    assert network["linear"].weight.dtype == torch.bfloat16
    assert torch.equal(projector(pixels.float())[0], want)
    assert projector(pixels.half())[0].dtype == torch.float32
    assert network.double()["to_plane"](pixels)[0].dtype == D


def test_poses_turn_by_cayleys_map(camera: dp.Camera) -> None:
    learnable = dp.LearnableCamera(camera)
    assert torch.equal(learnable().R, camera.R)
    with torch.no_grad():
        learnable.rotation.copy_(torch.tensor([0.3, -0.4, 1.2], dtype=D))
    turn = learnable().R @ camera.R.T
    angle = 2 * torch.tensor(1.3 / 2, dtype=D).atan()
    want, _ = cv2.Rodrigues((torch.tensor([0.3, -0.4, 1.2], dtype=D) / 1.3 * angle).numpy())
    torch.testing.assert_close(turn, torch.from_numpy(want))


@pytest.mark.parametrize("learn", [("focal",), ("pose", "distortion"), ()])
def test_only_what_is_learned_moves(learn: tuple[str, ...], rough: tuple[dp.Camera, dp.Views, dp.Calibration]) -> None:
    camera, views, _ = rough
    learnable = dp.LearnableCamera(camera, learn)
    names = {"focal": {"log_focal"}, "pose": {"rotation", "translation"}, "distortion": {"distortion"}}
    assert {n for n, _ in learnable.named_parameters()} == set().union(*(names[part] for part in learn))
    if not learn:
        return
    optimiser = torch.optim.SGD(learnable.parameters(), lr=1e-8)
    cost(learnable, views).backward()
    optimiser.step()
    now = learnable()
    assert torch.equal(now.K, camera.K) != ("focal" in learn)
    assert torch.equal(now.t, camera.t) != ("pose" in learn)


def test_gradients_are_finite_differences(rough: tuple[dp.Camera, dp.Views, dp.Calibration]) -> None:
    _, views, best = rough
    learnable = dp.LearnableCamera(best.cameras)
    names = [name for name, _ in learnable.named_parameters()]
    values = [p.detach().clone() + 0.01 * torch.randn_like(p) for p in learnable.parameters()]

    def value(*parameters: torch.Tensor) -> torch.Tensor:
        now = torch.func.functional_call(learnable, dict(zip(names, parameters, strict=True)), ())
        error, _ = dp.image_residuals(now, views[:5], BOARD)
        return (error * torch.linspace(-1, 1, 2 * 54, dtype=D).reshape(54, 2)).sum()

    assert torch.autograd.gradcheck(value, [v.requires_grad_() for v in values], fast_mode=True)


def test_saved_moved_and_copied(rough: tuple[dp.Camera, dp.Views, dp.Calibration]) -> None:
    camera, _, best = rough
    learnable = dp.LearnableCamera(camera, ("focal", "pose"))
    with torch.no_grad():
        learnable.log_focal += 0.1
        learnable.rotation += 0.2
    stream = io.BytesIO()
    torch.save(learnable.state_dict(), stream)
    stream.seek(0)
    other = dp.LearnableCamera(best.cameras[:5].at(camera.R, camera.t), ("focal", "pose"))
    fresh = dp.LearnableCamera(
        dp.Camera(camera.K, distortion=camera.distortion).at(camera.R.mT, camera.t), ("focal", "pose")
    )
    fresh.load_state_dict(torch.load(stream, weights_only=True))
    for again in (fresh, copy.deepcopy(learnable), pickle.loads(pickle.dumps(learnable))):  # noqa: S301
        assert torch.equal(again().K, learnable().K)
        assert torch.equal(again().R, learnable().R)
    assert other.to(torch.float32)().dtype == torch.float32
    assert "learn=('focal', 'pose')" in repr(learnable)


def test_residuals_honour_what_is_seen(rough: tuple[dp.Camera, dp.Views, dp.Calibration]) -> None:
    camera, views, _ = rough
    hidden = torch.rand(5, 54) < 0.4
    views = views.hiding(hidden)
    for residuals in (dp.image_residuals, dp.plane_residuals):
        error, valid = residuals(camera, views, BOARD)
        assert torch.equal(valid, ~hidden)
        assert (error[hidden] == 0).all()


@pytest.mark.plain
def test_bad_input_is_refused_by_name(camera: dp.Camera) -> None:
    with pytest.raises(ValueError, match="learn: want parts of focal, .*height, got 'distortion'"):
        dp.LearnableCamera(camera, ("distortion",))
    with pytest.raises(TypeError, match="camera: want dp.Camera"):
        dp.LearnableCamera("camera")
    views = dp.example_views("left")
    for residuals in (dp.image_residuals, dp.plane_residuals):
        with pytest.raises(ValueError, match="camera: want a pose for each of the 13 views"):
            residuals(camera, views, BOARD)


def test_a_lens_that_is_not_learned_keeps_its_plan(lens_camera: dp.Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    worked_out = []
    whole = coefficients.plan_of
    monkeypatch.setattr(coefficients, "plan_of", lambda *parts: worked_out.append(1) or whole(*parts))
    projector = dp.PlaneProjector(lens_camera, dp.Plane.z(0.0), "pose")
    worked_out.clear()  # of the camera that was given, which has one of its own
    pixels = torch.tensor([[100.0, 80], [500, 400]], dtype=D)
    with torch.inference_mode():
        projector(pixels)
    for _ in range(3):
        points, _ = projector(pixels)
        points.sum().backward()
    assert len(worked_out) == 1
    assert all(parameter.grad is not None for parameter in projector.parameters())
    projector.geometry.camera.coefficients_0.data[0] = -0.2  # which PyTorch does not count as writing
    changed, _ = projector(pixels)
    assert len(worked_out) == 2
    lens = dp.BrownConrady(projector.geometry.camera.coefficients_0)
    want, _ = dp.back_project(pixels, dp.Camera(lens_camera.K, lens_camera.R, lens_camera.t, lens), dp.Plane.z(0.0))
    torch.testing.assert_close(changed, want)
