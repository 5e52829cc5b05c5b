"""Cameras, planes and views in files that are read without running anything, and other ways that objects travel."""

import gc
import io
import pickle

import pytest
import torch

import diffproj as dp

D = torch.float64


def through_a_file(thing: object) -> object:
    stream = io.BytesIO()
    torch.save(thing, stream)
    stream.seek(0)
    return torch.load(stream, weights_only=True)


def test_files_are_read_with_weights_only(camera: dp.Camera, lens_camera: dp.Camera, pixels: torch.Tensor) -> None:
    fisheye = dp.Camera(camera.K, distortion=dp.KannalaBrandt(torch.tensor([0.01, -0.002, 0, 0], dtype=D)))
    for each in (camera, lens_camera, lens_camera.expand(3), fisheye):
        again = through_a_file({"camera": each})["camera"]
        assert again.size == each.size
        assert torch.equal(again.directions(pixels)[0], each.directions(pixels)[0])
    plane = through_a_file(dp.Plane.z(3.0))
    assert plane.adopts
    assert plane.offset == 3
    views = dp.example_views("left")
    again = through_a_file(views)
    assert torch.equal(again.pixels, views.pixels)
    assert again.names == views.names
    to_plane = dp.PlaneMap(lens_camera, plane)
    assert torch.equal(through_a_file(to_plane)(pixels)[0], to_plane(pixels)[0])
    assert torch.equal(through_a_file(lens_camera.distortion).coefficients, lens_camera.distortion.coefficients)
    points = torch.ones(1, 3, dtype=D)
    pickled = pickle.loads(pickle.dumps(lens_camera))  # noqa: S301
    assert torch.equal(pickled.project(points)[0], lens_camera.project(points)[0])
    for learn in ((), ("focal", "distortion", "pose", "plane")):
        projector = dp.PlaneProjector(lens_camera, dp.Plane.z(0.0), learn)
        state = through_a_file(projector.state_dict())
        projector.load_state_dict(state)


def test_a_plane_of_numbers_moves_and_takes_on_a_dtype(camera: dp.Camera, pixels: torch.Tensor) -> None:
    single = camera.to(torch.float32)
    for move in (("cpu",), (torch.device("cpu"),)):
        points, _ = dp.back_project(pixels.float(), single, dp.Plane.z(0.0).to(*move))
        assert points.dtype == torch.float32
    for firm in ((torch.float64,), ("cpu", torch.float64), (pixels,)):
        assert not dp.Plane.z(0.0).to(*firm).adopts
    assert dp.Plane.z(0.0).to(dtype=torch.float32).dtype == torch.float32


def test_a_chain_of_cameras_stays_short(lens_camera: dp.Camera, pixels: torch.Tensor) -> None:
    """Moved and detached at each step, as in a filter or a loop of training, behind a lens."""
    camera, want = lens_camera, lens_camera.directions(pixels)[0]
    gc.collect()
    before = sum(issubclass(type(each), torch.Tensor) for each in gc.get_objects())
    for _ in range(1200):
        camera = camera.at(lens_camera.R, lens_camera.t).detach()
    gc.collect()
    assert sum(issubclass(type(each), torch.Tensor) for each in gc.get_objects()) - before < 50
    assert torch.equal(camera.directions(pixels)[0], want)
    batch = lens_camera.expand(3)
    for _ in range(100):
        batch = batch[[0, 1, 2]]
    assert torch.equal(batch.directions(pixels)[0][2], want)


def test_a_lens_that_was_indexed_keeps_its_plan_when_the_batch_is_written_to(lens: dp.BrownConrady) -> None:
    two = dp.BrownConrady(lens.coefficients.expand(2, -1).clone())
    one, view = two[[0]], two[1:]
    with torch.no_grad():
        two.coefficients.mul_(2)
    for part, factor in ((one, 1), (view, 2)):
        fresh = dp.BrownConrady(lens.coefficients * factor)
        torch.testing.assert_close(part.domain, fresh.domain.expand(1))


@pytest.mark.parametrize("behind_lens", [False, True])
def test_a_frozen_projector_is_fast_and_never_stale(
    behind_lens: bool,
    camera: dp.Camera,
    lens_camera: dp.Camera,
    pixels: torch.Tensor,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    camera = lens_camera if behind_lens else camera
    learn = ("focal", "pose", "plane", *(("distortion",) if behind_lens else ()))
    fixed = dp.PlaneProjector(camera, dp.Plane.z(0.0))
    frozen = dp.PlaneProjector(camera, dp.Plane.z(0.0), learn).requires_grad_(False)
    torch.testing.assert_close(frozen(pixels)[0], fixed(pixels)[0], rtol=1e-12, atol=1e-10)
    built, build = [], dp.PlaneMap._build

    def counting(*arguments: object, **options: object) -> None:
        built.append(arguments)
        build(*arguments, **options)

    monkeypatch.setattr(dp.PlaneMap, "_build", counting)
    for _ in range(3):  # 1.1 times a fixed projector's time was measured; built anew each time it would be 3 and 8
        frozen(pixels)
    assert not built
    inputs = pixels.clone().requires_grad_()
    frozen(inputs)[0].sum().backward()  # gradients still pass through
    assert inputs.grad.isfinite().all()

    def agrees() -> None:
        fresh = dp.PlaneProjector(frozen.camera.detach(), frozen.plane.detach())
        torch.testing.assert_close(frozen(pixels)[0], fresh(pixels)[0], rtol=1e-10, atol=1e-9)

    for parameter in frozen.parameters():  # as a moving average of a teacher is written
        parameter.data.add_(0.01)
        agrees()
    with torch.no_grad():
        next(frozen.parameters()).mul_(0.5)
    agrees()
    state = {name: value + 0.01 for name, value in frozen.named_parameters()}
    swapped = torch.func.functional_call(frozen, state, (pixels,))[0]
    assert (swapped - frozen(pixels)[0]).abs().max() > 1e-3
    frozen.load_state_dict(frozen.state_dict() | state)
    agrees()
    torch.testing.assert_close(frozen(pixels)[0], swapped, rtol=1e-10, atol=1e-9)
    frozen.requires_grad_(True)
    assert frozen(pixels)[0].requires_grad


def test_no_cameras_at_all(lens_camera: dp.Camera) -> None:
    none, pixels, plane = lens_camera.expand(2)[:0], torch.rand(0, 5, 2, dtype=D), dp.Plane.z(0.0)
    extent = (-10.0, -10.0, 10.0, 10.0)
    assert dp.back_project(pixels, none, plane)[0].shape == (0, 5, 3)
    assert dp.explain(pixels, none, plane).shape == (0, 5)
    assert dp.PlaneMap(none, plane).miss(pixels).shape == (0, 5)
    assert dp.ground_resolution(pixels, none, plane)[0].shape == (0, 5)
    assert none.project(torch.rand(0, 5, 3, dtype=D))[0].shape == (0, 5, 2)
    assert none.mounting().height.shape == (0,)
    assert none.upright().shifted([0.0, 0, 0]).cropped(0, 0, 20, 20).K.shape == (0, 3, 3)
    for samples in (None, 1):
        assert dp.rectify(torch.rand(0, 3, 480, 640), none, plane, extent, 1.0, samples=samples)[0].shape == (
            0,
            3,
            20,
            20,
        )
        assert dp.render(torch.rand(0, 3, 9, 9), none, plane, extent, samples=samples)[0].shape == (0, 3, 480, 640)
    pinholes = dp.Camera(none.K, none.R, none.t, size=none.size)
    assert dp.Camera.from_kornia(pinholes.to_kornia()).K.shape == (0, 3, 3)
    assert dp.Camera.from_matrix(torch.rand(0, 3, 4)).K.shape == (0, 3, 3)
    assert dp.Camera.from_extrinsics(none.world_to_cam(), none.K).K.shape == (0, 3, 3)
    assert dp.PlaneMap(pinholes, plane).homography().shape == (0, 3, 3)
    for learn in ((), ("focal", "pose", "distortion", "plane"), ("pitch", "height")):
        projector = dp.PlaneProjector(none, plane, learn)
        points, valid = projector(pixels.clone().requires_grad_())
        loss = dp.PlaneLoss()(points, points.detach(), valid)
        loss.backward()
        assert loss == 0
