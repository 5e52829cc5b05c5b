"""What a module's state holds of its camera, modules without values, and cameras built under autocast."""

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

import diffproj as dp

K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
R = dp.rotation_from_euler(*torch.tensor([0.3, 0.2, 0.1]))
T = torch.tensor([0.0, 0, 1000])
FOUR = torch.tensor([0.1, -0.02, 0.001, 0.0])


def projector(
    lens: dp.Lens | None, learn: tuple[str, ...], size: tuple[int, int] | None = (640, 480)
) -> dp.PlaneProjector:
    return dp.PlaneProjector(dp.Camera(K, R, T, lens, size), dp.Plane.z(0.0), learn)


@pytest.mark.parametrize("learn", [(), ("focal", "distortion")])
def test_another_lens_or_size_is_no_state_of_this_camera(learn: tuple[str, ...]) -> None:
    fisheye = projector(dp.KannalaBrandt(FOUR), learn)
    ordinary = projector(dp.BrownConrady(FOUR), learn)
    with pytest.raises(RuntimeError, match="kind: want the state of a camera with lens 'brown4', got lens 'fisheye'"):
        ordinary.load_state_dict(fisheye.state_dict())
    larger = projector(dp.BrownConrady(FOUR), learn, (1280, 960))
    with pytest.raises(RuntimeError, match=r"kind: want .* size \(640, 480\), got size \(1280, 960\)"):
        ordinary.load_state_dict(larger.state_dict())
    pixels = torch.rand(5, 2) * 400
    with pytest.raises(ValueError, match="kind: want the state of a camera with lens 'brown4', got lens 'fisheye'"):
        torch.func.functional_call(ordinary, fisheye.state_dict(), (pixels,))
    ordinary.load_state_dict(projector(dp.BrownConrady(2 * FOUR), learn, None).state_dict())  # of no known size
    want, _ = projector(dp.BrownConrady(2 * FOUR), learn)(pixels)
    torch.testing.assert_close(ordinary(pixels)[0], want)


@pytest.mark.parametrize("learn", [(), ("focal", "pose", "plane")])
def test_modules_are_built_without_values_and_filled_later(learn: tuple[str, ...]) -> None:
    full = projector(dp.BrownConrady(FOUR), learn)
    with torch.device("meta"):
        camera = dp.Camera(
            torch.empty(3, 3), torch.empty(3, 3), torch.empty(3), dp.BrownConrady(torch.empty(4)), (640, 480)
        )
        empty = dp.PlaneProjector(camera, dp.Plane.z(0.0).to("meta", torch.float32), learn)
        assert empty(torch.empty(5, 2))[0].shape == (5, 3)
    empty = empty.to_empty(device="cpu")
    empty.load_state_dict(full.state_dict())
    pixels = torch.rand(5, 2) * 400
    torch.testing.assert_close(empty(pixels)[0], full(pixels)[0])
    with FakeTensorMode():
        camera = dp.Camera(torch.eye(3), torch.eye(3), torch.zeros(3), dp.BrownConrady(torch.zeros(4)))
        assert dp.PlaneProjector(camera, dp.Plane.z(0.0), learn)(torch.empty(7, 2))[0].shape == (7, 3)


def test_banks_and_batches_are_built_without_values() -> None:
    def use(device: str) -> None:
        def empty(*shape: int) -> torch.Tensor:
            return torch.empty(*shape, dtype=torch.float32, device=device)

        lens = dp.BrownConrady(empty(5))
        camera = dp.Camera(empty(3, 3), empty(3, 3), empty(3), lens, (640, 480))
        two, plane, pixels = dp.stack([camera, camera]), dp.Plane.z(0.0), empty(2, 5, 2)
        chosen = torch.zeros(2, dtype=torch.long, device=device)
        for learn in ((), ("focal", "pose"), {"pose": [True, False]}):
            projector = dp.PlaneProjector(two, plane, learn)
            for numbers in (chosen, [0, 1]):
                assert projector(pixels, camera=numbers)[0].shape == (2, 5, 3)
        bank = dp.ProjectorBank([camera, camera.resized((320, 240))], plane)
        assert bank(pixels, camera=chosen)[0].shape == (2, 5, 3)
        assert bank.miss(pixels, camera=chosen).shape == (2, 5)
        with pytest.raises(ValueError, match="samples: want how many a pixel takes, got None"):
            dp.rectify(empty(1, 480, 640), camera, plane, (-10.0, -10.0, 10.0, 10.0), 1.0)

    use("meta")
    with FakeTensorMode():
        use("cpu")


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_cameras_are_built_under_autocast(dtype: torch.dtype) -> None:
    pixels = torch.rand(5, 2) * 400
    want = dp.back_project(pixels, dp.Camera(K, R, T, dp.BrownConrady(FOUR)), dp.Plane.z(0.0))[0]
    with torch.autocast("cpu", dtype=dtype):
        camera = dp.Camera(K, R, T, dp.BrownConrady(FOUR), (640, 480))
        got = dp.back_project(pixels, camera.at(R, T), dp.Plane.z(0.0))[0]
        dp.Camera.from_opencv(K.numpy(), FOUR.numpy())
        dp.Camera.from_kornia(dp.Camera(K, R, T, size=(640, 480)).to_kornia())
        learnt = projector(dp.BrownConrady(FOUR), ("focal", "pose"))(pixels)[0]
    torch.testing.assert_close(got, want)
    torch.testing.assert_close(learnt, want)


def test_a_map_is_that_of_the_k_it_was_built_with() -> None:
    camera = dp.Camera(K.clone(), R, T)
    to_plane, pixels = dp.PlaneMap(camera, dp.Plane.z(0.0)), torch.rand(5, 2) * 400
    before, _ = to_plane(pixels)
    camera.K[0, 0] *= 2
    camera.K[0, 2] += 50
    torch.testing.assert_close(to_plane(pixels)[0], before, rtol=0, atol=0)
    lens = dp.BrownConrady(FOUR.clone())
    to_plane = dp.PlaneMap(dp.Camera(K, R, T, lens), dp.Plane.z(0.0))
    kept = to_plane(pixels)[0], to_plane.miss(pixels), to_plane.resolution(pixels)[0]
    lens.coefficients.mul_(0.5)
    for before, after in zip(
        kept, (to_plane(pixels)[0], to_plane.miss(pixels), to_plane.resolution(pixels)[0]), strict=True
    ):
        torch.testing.assert_close(after, before, rtol=0, atol=0)
    assert (dp.back_project(pixels, dp.Camera(K, R, T, lens), dp.Plane.z(0.0))[0] - kept[0]).abs().max() > 1
