"""The parts for a training pipeline: values, gradients, saving and moving, autocast, `vmap`, two processes."""

import copy
import io
import pickle
from pathlib import Path

import pytest
import torch

import diffproj as dp

D = torch.float64
EVERY = ("focal", "principal_point", "distortion", "pose", "plane")


@pytest.fixture
def plane() -> dp.Plane:
    return dp.Plane(torch.tensor([0.1, -0.2, 2.0], dtype=D), torch.tensor(30.0, dtype=D))


@pytest.mark.parametrize("learn", [(), EVERY, ("plane",), "pose"])
def test_projects_as_back_project_does(
    learn: tuple[str, ...], lens_camera: dp.Camera, pixels: torch.Tensor, plane: dp.Plane
) -> None:
    projector = dp.PlaneProjector(lens_camera, plane, learn)
    points, valid = projector(pixels)
    want, seen = dp.back_project(pixels, lens_camera, plane)
    torch.testing.assert_close(points, want, rtol=1e-12, atol=1e-10)
    assert torch.equal(valid, seen)
    assert any(True for _ in projector.parameters()) == bool(learn)
    assert projector.camera.size == lens_camera.size


def test_gradients_are_finite_differences(lens_camera: dp.Camera, pixels: torch.Tensor, plane: dp.Plane) -> None:
    projector = dp.PlaneProjector(lens_camera, plane, EVERY)
    names = [name for name, _ in projector.named_parameters()]
    assert len(names) == 7
    values = [p.detach().clone() + 0.01 * torch.randn_like(p) for p in projector.parameters()]

    def total(pixels: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        points, _ = torch.func.functional_call(projector, dict(zip(names, parameters, strict=True)), (pixels,))
        return (points * torch.linspace(-1, 1, 60, dtype=D).reshape(20, 3)).sum()

    inputs = [v.requires_grad_() for v in (pixels[:20].clone(), *values)]
    assert torch.autograd.gradcheck(total, inputs, fast_mode=True)


def test_the_plane_turns_and_moves(plane: dp.Plane) -> None:
    learnable = dp.LearnablePlane(plane, scale=10.0)
    now = learnable()
    torch.testing.assert_close(now.normal, plane.normal)
    torch.testing.assert_close(now.offset, plane.offset)
    with torch.no_grad():
        learnable.tilt.copy_(torch.tensor([0.3, -0.2]))
        learnable.shift.fill_(0.5)
    moved = learnable()
    torch.testing.assert_close(moved.normal.norm(), plane.normal.norm())
    cosine = (moved.normal * plane.normal).sum() / plane.normal.square().sum()
    torch.testing.assert_close(cosine.acos().tan(), torch.tensor(0.13**0.5, dtype=D))
    torch.testing.assert_close((moved.offset - plane.offset) / plane.normal.norm(), torch.tensor(5.0, dtype=D))


@pytest.mark.parametrize("learn", [(), ("focal", "plane")])
def test_saved_moved_and_copied(
    learn: tuple[str, ...], lens_camera: dp.Camera, pixels: torch.Tensor, plane: dp.Plane, tmp_path: Path
) -> None:
    projector = dp.PlaneProjector(lens_camera, plane, learn)
    with torch.no_grad():
        for parameter in projector.parameters():
            parameter += 0.01
    want = projector(pixels)[0]
    torch.save(projector.state_dict(), tmp_path / "state.pt")
    other = dp.PlaneProjector(lens_camera.at(lens_camera.R, lens_camera.t + 50), dp.Plane.z(3.0), learn)
    other.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    torch.testing.assert_close(other.plane.offset, projector.plane.offset)
    for again in (copy.deepcopy(projector), pickle.loads(pickle.dumps(projector))):  # noqa: S301
        assert torch.equal(again(pixels)[0], want)
    single = copy.deepcopy(projector).to(torch.float32)
    points, _ = single(pixels.float())
    assert points.dtype == torch.float32
    torch.testing.assert_close(points.double(), want, rtol=0, atol=2e-3)
    stream = io.BytesIO()
    torch.save(projector, stream)
    stream.seek(0)
    assert torch.equal(torch.load(stream, weights_only=False)(pixels)[0], want)


@pytest.mark.parametrize("learn", [(), ("pose",)])
def test_samples_bring_planes_of_their_own(learn: tuple[str, ...], camera: dp.Camera, pixels: torch.Tensor) -> None:
    planes = dp.Plane.z(torch.tensor([0.0, 30, 60], dtype=D))
    points, valid = dp.PlaneProjector(camera, dp.Plane.z(0.0), learn)(pixels, plane=planes)
    want, seen = dp.back_project(pixels, camera, planes)
    torch.testing.assert_close(points, want)
    assert torch.equal(valid, seen)


def test_a_network_loads_its_frozen_projector(lens_camera: dp.Camera, pixels: torch.Tensor, plane: dp.Plane) -> None:
    network, other = (
        torch.nn.ModuleDict({"to_plane": dp.PlaneProjector(camera, plane)})
        for camera in (lens_camera, lens_camera.at(lens_camera.R, lens_camera.t + 50))
    )
    other.load_state_dict(network.state_dict())
    assert torch.equal(other["to_plane"](pixels)[0], network["to_plane"](pixels)[0])


@pytest.mark.parametrize("behind_lens", [False, True])
def test_a_frozen_projector_is_what_its_buffers_are(
    behind_lens: bool, camera: dp.Camera, lens_camera: dp.Camera, pixels: torch.Tensor, plane: dp.Plane
) -> None:
    near = lens_camera if behind_lens else camera
    far = near.at(near.R, near.t + 50)
    projectors = [dp.PlaneProjector(camera, plane) for camera in (near, far)]
    wants = [projector(pixels)[0] for projector in projectors]
    assert not torch.equal(*wants)
    swapped, _ = torch.func.functional_call(projectors[0], dict(projectors[1].named_buffers()), (pixels,))
    assert torch.equal(swapped, wants[1])
    assert torch.equal(projectors[0](pixels)[0], wants[0])
    state = torch.func.stack_module_state(projectors)
    base = copy.deepcopy(projectors[0])
    together = torch.func.vmap(lambda *state: torch.func.functional_call(base, state, (pixels,))[0])(*state)
    for points, want in zip(together, wants, strict=True):
        torch.testing.assert_close(points, want, rtol=1e-10, atol=1e-10)
    with torch.no_grad():  # as DistributedDataParallel does from the first process
        for mine, theirs in zip(projectors[0].buffers(), projectors[1].buffers(), strict=True):
            mine.copy_(theirs)
    assert torch.equal(projectors[0](pixels)[0], wants[1])


def test_planes_of_a_batch_learn_one_by_one(camera: dp.Camera, pixels: torch.Tensor) -> None:
    planes = dp.Plane.z(torch.tensor([0.0, 30, 60], dtype=D))
    projector = dp.PlaneProjector(camera, planes, {"plane": torch.tensor([False, True, False])})
    points, _ = projector(pixels)
    points.square().sum().backward()
    with torch.no_grad():
        for parameter in projector.parameters():
            parameter -= 1e-9 * parameter.grad
    moved = (projector(pixels)[0] != points).flatten(1).any(-1)
    assert moved.tolist() == [False, True, False]


def test_geometry_keeps_its_precision_under_autocast(lens_camera: dp.Camera, pixels: torch.Tensor) -> None:
    camera = lens_camera.to(torch.float32)
    for learn in ((), EVERY):
        projector = dp.PlaneProjector(camera, dp.Plane.z(0.0), learn)
        want = projector(pixels.float())[0]
        with torch.autocast("cpu", dtype=torch.bfloat16):
            points, _ = projector(pixels.float())
            half, _ = projector(pixels.to(torch.bfloat16))
        assert torch.equal(points, want)
        assert half.dtype == torch.float32


def test_vmap_over_cameras(camera: dp.Camera, pixels: torch.Tensor) -> None:
    projector = dp.PlaneProjector(camera, dp.Plane.z(0.0), ("pose",))
    name, value = next(iter(projector.named_parameters()))
    several = value + 0.01 * torch.randn(4, *value.shape, dtype=D)

    def project(parameter: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(projector, {name: parameter}, (pixels,))[0]

    together = torch.func.vmap(project)(several)
    for i in range(4):
        torch.testing.assert_close(together[i], project(several[i]), rtol=1e-10, atol=1e-10)


def test_loss_counts_what_is_valid() -> None:
    points, target = torch.randn(3, 8, 3, dtype=D), torch.randn(3, 8, 3, dtype=D)
    valid, weights = torch.rand(3, 8) > 0.3, torch.rand(3, 8, dtype=D)
    resolution = 0.5 + torch.rand(3, 8, dtype=D)
    squared = (points - target).square().sum(-1)
    got = dp.PlaneLoss()(points, target, valid, weights, resolution)
    torch.testing.assert_close(got, (valid * weights * squared / resolution**2).sum() / 24)
    robust = dp.PlaneLoss(dp.Huber(1.0))(points, target, valid)
    torch.testing.assert_close(robust, (valid * dp.Huber(1.0).value(squared)).sum() / 24)
    poisoned = torch.where(valid.unsqueeze(-1), points, torch.nan).requires_grad_()
    value = dp.PlaneLoss(dp.Cauchy(1.0))(poisoned, target, valid, resolution=torch.where(valid, resolution, 0.0))
    gradient = torch.autograd.grad(value, poisoned)[0]
    assert gradient.isfinite().all()
    assert (gradient[~valid] == 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("behind_lens", [False, True])
def test_invalid_pixels_change_no_gradient_of_the_others(
    behind_lens: bool, dtype: torch.dtype, camera: dp.Camera, lens_camera: dp.Camera, pixels: torch.Tensor
) -> None:
    projector = dp.PlaneProjector((lens_camera if behind_lens else camera).to(dtype), dp.Plane.z(0.0), "pose")
    pixels = pixels.to(dtype)
    target = torch.zeros(len(pixels), 3, dtype=dtype)
    broken = torch.rand(len(pixels)) < 0.3
    wrong = pixels.clone()
    wrong[broken] = torch.tensor([torch.inf, 1e9], dtype=dtype)

    def gradient(pixels: torch.Tensor) -> torch.Tensor:
        pixels = pixels.clone().requires_grad_()
        points, valid = projector(pixels)
        return torch.autograd.grad(dp.PlaneLoss(dp.Huber(10.0))(points, target, valid), pixels)[0]

    assert torch.equal(gradient(pixels)[~broken], gradient(wrong)[~broken])
    assert (gradient(pixels)[broken] != 0).all()
    assert (gradient(wrong)[broken] == 0).all()


def test_ground_resolution_is_a_finite_difference(lens_camera: dp.Camera, pixels: torch.Tensor) -> None:
    plane = dp.Plane.z(0.0)
    got, valid = dp.ground_resolution(pixels, lens_camera, plane)
    angle = torch.linspace(0, torch.pi, 361, dtype=D)
    around = 1e-4 * torch.stack([angle.cos(), angle.sin()], dim=-1)
    for i in range(0, 200, 40):
        ahead, behind = (dp.back_project(pixels[i] + s * around, lens_camera, plane)[0] for s in (1, -1))
        torch.testing.assert_close(got[i], (ahead - behind).norm(dim=-1).amax() / 2e-4, rtol=1e-4, atol=0)
    assert valid.all()


def test_prior_is_the_calibrations_own_cost() -> None:
    calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
    prior = dp.CalibrationPrior(calibration, view=2)
    start = calibration.cameras[2]
    assert float(prior(start)) == 0
    projector = dp.PlaneProjector(start, dp.Plane.z(0.0), EVERY[:4])
    C = calibration.covariance.view(2)
    off = torch.linalg.cholesky(C) @ torch.randn(len(C), dtype=D) * 0.1
    K = start.K + torch.tensor([[off[0], 0, off[2]], [0, off[1], off[3]], [0, 0, 0]], dtype=D)
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    R = axis_angle_to_rotation_matrix(off[None, 9:12])[0] @ start.R
    lens = dp.BrownConrady(start.distortion.coefficients + off[4:9])
    want = 0.5 * off @ torch.linalg.solve(C, off)
    got = prior(dp.Camera(K, R, start.t + off[12:], lens))
    torch.testing.assert_close(got, want, rtol=1e-5, atol=0)
    gradients = torch.autograd.grad(prior(projector.camera), list(projector.parameters()), allow_unused=True)
    assert all(g is not None and g.abs().max() < 1e-6 for g in gradients)
    assert float(dp.CalibrationPrior(calibration)(calibration.camera)) == 0


def test_joint_training_finds_the_camera() -> None:
    """Pixels with known points pull a wrong pose and focal length to where they belong."""

    setup = dp.paper_setup()
    truth = setup.fit[:6]
    pixels, _ = truth.project(setup.board.points)
    wrong_K = truth.K * torch.tensor([[1.05, 1, 1], [1, 1.05, 1], [1, 1, 1]], dtype=D)
    tilt = dp.rotation_from_euler(*(torch.tensor([2.0, -1.5, 1.0], dtype=D).deg2rad()))
    start = dp.Camera(wrong_K[0], size=(640, 480)).at(tilt @ truth.R, truth.t)
    projector = dp.PlaneProjector(start, dp.Plane.z(0.0), ("focal", "pose"))
    optimiser = torch.optim.LBFGS(projector.parameters(), max_iter=300, history_size=50, line_search_fn="strong_wolfe")
    criterion = dp.PlaneLoss()

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        points, valid = projector(pixels)
        loss = criterion(points, setup.board.points, valid)
        loss.backward()
        return loss

    before = float(closure().detach())
    optimiser.step(closure)
    assert float(closure().detach()) < 1e-3 * before
    assert (projector.camera.K[0, 0, 0] / truth.K[0, 0, 0] - 1).abs() < 0.005


def _gradients(device: str) -> tuple[torch.nn.Module, torch.Tensor]:
    """A projector, and pixels for two processes."""
    torch.manual_seed(0)
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=D)
    camera = dp.Camera(K, t=torch.tensor([0.0, 0, 1000], dtype=D))
    projector = dp.PlaneProjector(camera, dp.Plane.z(0.0), ("focal", "pose"))
    return projector.to(device), (torch.rand(2, 16, 2, dtype=D) * 400).to(device)


def _worker(rank: int, backend: str, world: int, address: str, result: str) -> None:
    torch.distributed.init_process_group(backend, init_method=f"file://{address}", rank=rank, world_size=world)
    projector, pixels = _gradients("cpu" if backend == "gloo" else f"cuda:{rank}")
    parallel = torch.nn.parallel.DistributedDataParallel(projector)
    points, valid = parallel(pixels[rank] if world == 2 else pixels)
    dp.PlaneLoss()(points, torch.zeros_like(points), valid).backward()
    if rank == 0:
        torch.save([p.grad.cpu() for p in projector.parameters()], result)
    torch.distributed.destroy_process_group()


@pytest.mark.plain
@pytest.mark.parametrize(
    "backend",
    ["gloo", pytest.param("nccl", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"))],
)
def test_processes_share_gradients(backend: str, tmp_path: Path) -> None:
    address, result = tmp_path / "rendezvous", tmp_path / "gradients.pt"
    world = 2 if backend == "gloo" else min(2, torch.cuda.device_count())
    torch.multiprocessing.spawn(_worker, args=(backend, world, str(address), str(result)), nprocs=world)
    projector, pixels = _gradients("cpu")
    points, valid = projector(pixels)
    dp.PlaneLoss()(points, torch.zeros_like(points), valid).backward()
    for shared, own in zip(torch.load(result, weights_only=True), projector.parameters(), strict=True):
        torch.testing.assert_close(shared, own.grad, rtol=1e-10, atol=1e-10)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("learn", [(), EVERY])
def test_on_a_gpu(learn: tuple[str, ...], lens_camera: dp.Camera, pixels: torch.Tensor) -> None:
    projector = dp.PlaneProjector(lens_camera, dp.Plane.z(0.0), learn)
    half = torch.tensor([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]], dtype=D)
    wants = projector(pixels)[0], projector(pixels, half)[0]
    projector.to("cuda")
    for want, points in zip(
        wants, (projector(pixels.cuda())[0], projector(pixels.cuda(), half.cuda())[0]), strict=True
    ):
        torch.testing.assert_close(points.cpu(), want, rtol=1e-10, atol=1e-8)
    single = projector.to(torch.float32)
    with torch.autocast("cuda", dtype=torch.float16):
        points, valid = single(pixels.float().cuda())
        loss = dp.PlaneLoss(dp.Huber(5.0))(points, torch.zeros_like(points), valid)
    assert points.dtype == torch.float32
    torch.testing.assert_close(points.cpu().double(), wants[0], rtol=0, atol=2e-3)
    if learn:
        loss.backward()
        assert all(p.grad.isfinite().all() for p in single.parameters())


@pytest.mark.plain
def test_bad_input_is_refused_by_name(camera: dp.Camera) -> None:
    with pytest.raises(ValueError, match="learn: want parts of focal, .*, plane, got 'zoom'"):
        dp.PlaneProjector(camera, dp.Plane.z(0.0), ("zoom",))
    with pytest.raises(TypeError, match="plane: want a dp.Plane"):
        dp.PlaneProjector(camera, 0.0)
    with pytest.raises(TypeError, match="loss: want one such as"):
        dp.PlaneLoss("huber")
    with pytest.raises(ValueError, match="plane: want one plane for all points"):
        dp.LearnablePlane(dp.Plane.per_point([0.0, 0, 1], torch.zeros(3)))
    views = dp.example_views("left")
    both = dp.calibrate(dp.Views(torch.stack([views.pixels] * 2), size=views.size), dp.Chessboard())
    with pytest.raises(ValueError, match="calibration: want one camera with its covariance"):
        dp.CalibrationPrior(both)
