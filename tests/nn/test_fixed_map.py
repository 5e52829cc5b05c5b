"""`FixedMap`, and the `PlaneProjector` that has nothing to learn: one map, held as buffers that anything may swap."""

import copy
import io
import pickle
from collections.abc import Callable

import pytest
import torch

import diffproj as dp

D = torch.float64


@pytest.fixture
def plane() -> dp.Plane:
    return dp.Plane(torch.tensor([0.1, -0.2, 2.0], dtype=D), torch.tensor(30.0, dtype=D))


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


def test_one_map_is_built_in_construction_and_none_later(
    monkeypatch: pytest.MonkeyPatch, lens_camera: dp.Camera, pixels: torch.Tensor, plane: dp.Plane
) -> None:
    built = []
    build = dp.PlaneMap.__init__

    def counting(*arguments: object) -> None:
        built.append(arguments)
        build(*arguments)

    monkeypatch.setattr(dp.PlaneMap, "__init__", counting)
    projector = dp.PlaneProjector(lens_camera, plane)
    assert len(built) == 1
    for _ in range(3):
        projector(pixels)
    projector.map(), projector.camera, projector.plane
    assert len(built) == 1


def loaded(mine: dp.PlaneProjector, theirs: dp.PlaneProjector, **options: bool) -> dp.PlaneProjector:
    mine.load_state_dict(theirs.state_dict(), **options)
    return mine


def through_a_file(theirs: dp.PlaneProjector) -> dp.PlaneProjector:
    stream = io.BytesIO()
    torch.save(theirs, stream)
    stream.seek(0)
    return torch.load(stream, weights_only=False)


def written(mine: dp.PlaneProjector, theirs: dp.PlaneProjector) -> dp.PlaneProjector:
    """As DistributedDataParallel writes from the first process."""
    with torch.no_grad():
        for buffer, other in zip(mine.buffers(), theirs.buffers(), strict=True):
            buffer.copy_(other)
    return mine


def set_by_name(mine: dp.PlaneProjector, theirs: dp.PlaneProjector) -> dp.PlaneProjector:
    for name, buffer in theirs.named_buffers():
        owner, _, last = name.rpartition(".")
        setattr(mine.get_submodule(owner), last, buffer)
    return mine


def emptied(mine: dp.PlaneProjector, theirs: dp.PlaneProjector) -> dp.PlaneProjector:
    """As a large network is made: without values first."""
    return loaded(mine.to("meta").to_empty(device="cpu"), theirs)


def in_inference_mode(mine: dp.PlaneProjector, theirs: dp.PlaneProjector) -> dp.PlaneProjector:
    with torch.inference_mode():
        return loaded(mine, theirs)


SWAPS: dict[str, Callable[[dp.PlaneProjector, dp.PlaneProjector], dp.PlaneProjector]] = {
    "loaded": loaded,
    "assigned": lambda mine, theirs: loaded(mine, theirs, assign=True),
    "loaded in inference mode": in_inference_mode,
    "loaded from a copy": lambda mine, theirs: loaded(mine, copy.deepcopy(theirs)),
    "copied": lambda mine, theirs: copy.deepcopy(theirs),
    "pickled": lambda mine, theirs: pickle.loads(pickle.dumps(theirs)),  # noqa: S301
    "saved": lambda mine, theirs: through_a_file(theirs),
    "written": written,
    "set by name": set_by_name,
    "emptied": emptied,
}


@pytest.mark.parametrize("how", SWAPS)
@pytest.mark.parametrize("behind_lens", [False, True])
def test_every_way_to_swap_buffers_swaps_the_whole_map(
    how: str, behind_lens: bool, camera: dp.Camera, lens_camera: dp.Camera, pixels: torch.Tensor, plane: dp.Plane
) -> None:
    near = lens_camera if behind_lens else camera
    lens = dp.BrownConrady(near.distortion.coefficients * 0.5) if behind_lens else None
    far = dp.Camera(near.K + torch.eye(3, dtype=D) * torch.tensor([9.0, 8, 0]), near.R, near.t + 50, lens, near.size)
    warp = torch.tensor([[1.0, 0, 5], [0, 1, -3], [0, 0, 1]], dtype=D)
    mine, theirs = dp.PlaneProjector(near, dp.Plane.z(7.0)), dp.PlaneProjector(far, plane)
    for projector in (mine, theirs):  # whatever remembers something does so before the swap
        projector(pixels)
    swapped = SWAPS[how](mine, theirs)
    want, seen = dp.back_project(pixels, far, plane)
    points, valid = swapped(pixels)
    assert torch.equal(points, want)
    assert torch.equal(valid, seen)
    assert torch.equal(swapped(pixels, warp)[0], dp.back_project(pixels, far.warped(warp), plane)[0])
    assert torch.equal(swapped(pixels, plane=dp.Plane.z(1.0))[0], dp.back_project(pixels, far, dp.Plane.z(1.0))[0])
    assert torch.equal(swapped.camera.project(points)[0], far.project(points)[0])
    assert torch.equal(swapped.plane.normal, plane.normal)
    inputs = pixels.clone().requires_grad_()
    swapped(inputs)[0].sum().backward()
    assert inputs.grad.isfinite().all()


@pytest.mark.parametrize("state", ["state_dict", "named_buffers"])
def test_a_functional_call_takes_the_state_as_it_is_given(
    state: str, lens_camera: dp.Camera, pixels: torch.Tensor, plane: dp.Plane
) -> None:
    mine, theirs = (
        dp.PlaneProjector(lens_camera.at(lens_camera.R, lens_camera.t + shift), plane) for shift in (0.0, 50.0)
    )
    want, before = theirs(pixels)[0], mine(pixels)[0]
    for _ in range(2):
        swapped, _ = torch.func.functional_call(mine, dict(getattr(theirs, state)()), (pixels,))
        assert torch.equal(swapped, want)
        assert torch.equal(mine(pixels)[0], before)


@pytest.mark.parametrize("part", ["K", "t", "offset", "coefficients"])
def test_a_part_that_is_swapped_or_written_alone_is_the_maps(
    part: str, lens_camera: dp.Camera, pixels: torch.Tensor, plane: dp.Plane
) -> None:
    mine, factor = dp.PlaneProjector(lens_camera, plane), 0.9
    before, value = mine(pixels)[0], getattr(mine.geometry, part).clone().requires_grad_()

    def other(value: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        parts = {name: getattr(mine.geometry, name) for name in ("K", "t", "coefficients", "normal", "offset")}
        parts[part] = value * factor if part != "K" else value * torch.tensor([[factor], [1.0], [1.0]], dtype=D)
        lens = dp.BrownConrady(parts["coefficients"])
        camera = dp.Camera(parts["K"], lens_camera.R, parts["t"], lens, lens_camera.size)
        return dp.back_project(pixels, camera, dp.Plane(parts["normal"], parts["offset"]))[0], parts[part]

    want, changed = other(value)
    assert (want - before).abs().max() > 1e-2
    swapped, _ = torch.func.functional_call(mine, {f"geometry.{part}": changed}, (pixels,))
    torch.testing.assert_close(swapped, want, rtol=1e-12, atol=1e-10)
    ours, right = (torch.autograd.grad(points.sum(), value, retain_graph=True)[0] for points in (swapped, want))
    torch.testing.assert_close(ours, right, rtol=1e-9, atol=1e-9)
    assert torch.equal(mine(pixels)[0], before)  # as before the call
    with torch.no_grad():
        getattr(mine.geometry, part).copy_(changed)
    copied = copy.deepcopy(mine)
    for projector in (copied, mine, mine):
        torch.testing.assert_close(projector(pixels)[0], want, rtol=1e-12, atol=1e-10)


def test_written_as_a_whole_and_then_in_part(lens_camera: dp.Camera, pixels: torch.Tensor, plane: dp.Plane) -> None:
    mine, theirs = dp.PlaneProjector(lens_camera, plane), dp.PlaneProjector(lens_camera.shifted([0.0, 0, 9]), plane)
    written(mine, theirs)
    assert torch.equal(mine(pixels)[0], theirs(pixels)[0])
    with torch.no_grad():
        mine.geometry.t.mul_(2)
    far = lens_camera.at(lens_camera.R, mine.geometry.t)
    torch.testing.assert_close(mine(pixels)[0], dp.back_project(pixels, far, plane)[0], rtol=1e-12, atol=1e-10)


@pytest.mark.parametrize("behind_lens", [False, True])
def test_the_map_is_built_again_in_the_precision_that_it_moves_to(
    behind_lens: bool, camera: dp.Camera, lens_camera: dp.Camera, pixels: torch.Tensor, plane: dp.Plane
) -> None:
    single = (lens_camera if behind_lens else camera).to(torch.float32)
    want, _ = dp.back_project(pixels, single.to(D), plane.to(torch.float32).to(D))
    projector = dp.PlaneProjector(single, plane.to(torch.float32))
    rounded = projector(pixels.float())[0]
    state = copy.deepcopy(projector.state_dict())
    torch.testing.assert_close(projector.to(D)(pixels)[0], want, rtol=1e-13, atol=1e-11)
    assert (rounded - want).abs().max() > 1e-6  # so that a map rounded from the old one would show
    double = dp.PlaneProjector(camera=lens_camera if behind_lens else camera, plane=plane)
    double.load_state_dict(state)
    torch.testing.assert_close(double(pixels)[0], want, rtol=1e-13, atol=1e-11)
    network = torch.nn.Sequential(double)
    network.half()
    torch.testing.assert_close(double(pixels)[0], want, rtol=1e-13, atol=1e-11)


def test_built_and_moved_in_inference_mode_it_trains_afterwards(lens_camera: dp.Camera, pixels: torch.Tensor) -> None:
    learnable = dp.PlaneProjector(lens_camera.to(torch.float32), dp.Plane.z(0.0), ("focal", "pose", "plane"))
    with torch.inference_mode():
        built = dp.PlaneProjector(lens_camera.to(torch.float32), dp.Plane.z(0.0))
        moved, learnable = copy.deepcopy(built).to(D), learnable.to(D)
    for projector, inputs in ((built, pixels.float()), (moved, pixels), (learnable, pixels)):
        inputs = inputs.clone().requires_grad_()
        projector(inputs)[0].sum().backward()
        assert all(value.grad.isfinite().all() for value in (inputs, *projector.parameters()))


def test_the_callers_tensors_are_neither_kept_nor_learned(lens_camera: dp.Camera, pixels: torch.Tensor) -> None:
    t, offset = (value.clone().requires_grad_() for value in (lens_camera.t, torch.tensor(3.0, dtype=D)))
    projector = dp.PlaneProjector(lens_camera.at(lens_camera.R, t), dp.Plane.z(offset))
    before = projector(pixels)[0]
    assert not before.requires_grad
    with torch.no_grad():
        t += 10.0
        offset += 10.0
    assert torch.equal(projector(pixels)[0], before)


@pytest.mark.plain
def test_bad_input_is_refused_by_name(camera: dp.Camera) -> None:
    with pytest.raises(ValueError, match="plane: want one plane for all points"):
        dp.PlaneProjector(camera, dp.Plane.per_point([0.0, 0, 1], torch.zeros(3, dtype=D)))
    with pytest.raises(TypeError, match="plane: want torch.float64 as camera has, got torch.float32"):
        dp.PlaneProjector(camera, dp.Plane(torch.tensor([0.0, 0, 1]), torch.tensor(0.0)))
    with pytest.raises(ValueError, match="batch shapes do not broadcast"):
        dp.PlaneProjector(camera.expand(2), dp.Plane.z(torch.zeros(3, dtype=D)))
