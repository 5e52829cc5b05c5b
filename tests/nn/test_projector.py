"""The parts for a training pipeline: values, gradients, saving and moving, autocast, `vmap`, two processes."""

import copy
import io
import pickle
from pathlib import Path

import pytest
import torch

import diffproj as dp
from tests.nn.processes import one_of

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
    with one_of(world, rank, address, backend):
        projector, pixels = _gradients("cpu" if backend == "gloo" else f"cuda:{rank}")
        parallel = torch.nn.parallel.DistributedDataParallel(projector)
        points, valid = parallel(pixels[rank] if world == 2 else pixels)
        dp.PlaneLoss()(points, torch.zeros_like(points), valid).backward()
        if rank == 0:
            torch.save([p.grad.cpu() for p in projector.parameters()], result)


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
    with pytest.raises(
        ValueError, match=r"calibration: want one camera with its covariance.* got \(2,\) of them; index"
    ):
        dp.CalibrationPrior(both)
    dp.CalibrationPrior(both[0])
