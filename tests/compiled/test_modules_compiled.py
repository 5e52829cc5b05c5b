"""The training parts in compiled and exported graphs."""

import pytest
import torch

import diffproj as dp

D = torch.float64
EVERY = ("focal", "principal_point", "pose", "plane")


@pytest.fixture
def projector(camera: dp.Camera) -> dp.PlaneProjector:
    return dp.PlaneProjector(camera, dp.Plane(torch.tensor([0.0, 0, 1], dtype=D), torch.tensor(3.0, dtype=D)), EVERY)


def test_one_graph_serves_every_batch_size(projector: dp.PlaneProjector, pixels: torch.Tensor) -> None:
    graphs = []

    def counting(graph: torch.fx.GraphModule, inputs: list[torch.Tensor]):
        graphs.append(graph)
        return graph

    torch._dynamo.reset()
    compiled = torch.compile(projector, backend=counting, fullgraph=True)
    for count in (200, 150, 100, 70, 33):
        points, valid = compiled(pixels[:count])
        want, seen = projector(pixels[:count])
        torch.testing.assert_close(points, want, rtol=1e-12, atol=1e-10)
        assert torch.equal(valid, seen)
    assert len(graphs) <= 2  # the first size, and then any


@pytest.mark.slow
def test_a_compiled_step_has_the_same_gradients(projector: dp.PlaneProjector, pixels: torch.Tensor) -> None:
    target = torch.zeros(len(pixels), 3, dtype=D)

    def loss(pixels: torch.Tensor) -> torch.Tensor:
        points, valid = projector(pixels)
        return dp.PlaneLoss(dp.Huber(20.0))(points, target, valid)

    torch._dynamo.reset()
    parameters = list(projector.parameters())
    want = torch.autograd.grad(loss(pixels), parameters)
    got = torch.autograd.grad(torch.compile(loss, fullgraph=True)(pixels), parameters)
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("behind_lens", [False, True])
def test_a_compiled_fixed_map_follows_its_buffers(
    behind_lens: bool, camera: dp.Camera, lens_camera: dp.Camera, pixels: torch.Tensor
) -> None:
    near = lens_camera if behind_lens else camera
    lens = dp.BrownConrady(near.distortion.coefficients * 0.5) if behind_lens else None
    far = dp.Camera(near.K, near.R, near.t + 50, lens, near.size)
    projectors = [dp.PlaneProjector(each, dp.Plane.z(0.0)) for each in (near, far)]
    torch._dynamo.reset()
    compiled = torch.compile(projectors[0], backend="aot_eager", fullgraph=True)
    for state, each in ((projectors[0], near), (projectors[1], far)):
        compiled.load_state_dict({f"_orig_mod.{name}": value for name, value in state.state_dict().items()})
        points, valid = compiled(pixels)
        want, seen = dp.back_project(pixels, each, dp.Plane.z(0.0))
        torch.testing.assert_close(points, want, rtol=1e-12, atol=1e-10)
        assert torch.equal(valid, seen)


@pytest.mark.slow
@pytest.mark.parametrize("behind_lens", [False, True])
@pytest.mark.parametrize("learn", [(), EVERY])
def test_exports(
    behind_lens: bool, camera: dp.Camera, lens_camera: dp.Camera, pixels: torch.Tensor, learn: tuple[str, ...]
) -> None:
    projector = dp.PlaneProjector(lens_camera if behind_lens else camera, dp.Plane.z(0.0), learn)
    count = torch.export.Dim("count", min=2, max=10**6)
    program = torch.export.export(projector, (pixels,), dynamic_shapes=({0: count},))
    points, valid = program.module()(pixels[:50])
    want, seen = projector(pixels[:50])
    torch.testing.assert_close(points, want, rtol=1e-12, atol=1e-10)
    assert torch.equal(valid, seen)
