"""Scenes far from the world's origin: where float32 rounds them visibly, somebody says so."""

import warnings

import pytest
import torch

import diffproj as dp

D, S = torch.float64, torch.float32
GROUND = dp.Plane.z(0.0)
PIXELS = torch.tensor([[100.0, 400], [320, 300], [600, 450]], dtype=D)


def camera_at(x: float, height: float = 10.0) -> dp.Camera:
    """A camera above the ground, far from the world's origin, looking down at a slant."""
    K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=D)
    R = dp.rotation_from_euler(*torch.tensor([2.6, 0.2, 0.3], dtype=D))
    center = torch.tensor([x, 0.5 * x, height], dtype=D)
    return dp.Camera(K, R, -(R @ center), size=(640, 480))


def warned(text: str):
    return pytest.warns(UserWarning, match=rf"float32: .* rounding moves places on the plane by {text} of the camera's")


@pytest.mark.parametrize(("x", "share"), [(1e4, "0.0001"), (1e5, "0.001"), (1e6, "0.01"), (5e6, "0.01")])
def test_what_is_warned_of_is_how_far_points_are_off(x: float, share: str) -> None:
    exact = camera_at(x)
    wanted, _ = dp.back_project(PIXELS, exact, GROUND)
    with warned(share):
        points, valid = dp.back_project(PIXELS.float(), exact.to(S), GROUND)
    assert valid.all()
    off = float((points - wanted).norm(dim=-1).mean())
    assert 0.1 * float(share) < off / 10.0 < 10 * float(share)


def test_uses_of_a_plane_warn() -> None:
    far = camera_at(1e6).to(S)
    image = torch.rand(1, 48, 64)
    extent = (1e6, 5e5, 1e6 + 8, 5e5 + 8)
    uses = [
        lambda: dp.PlaneMap(far, GROUND),
        lambda: dp.PlaneProjector(far, GROUND),
        lambda: dp.explain(PIXELS.float(), far, GROUND),
        lambda: dp.ground_resolution(PIXELS.float(), far, GROUND),
        lambda: dp.rectify(image, far.resized((64, 48)), GROUND, extent, 0.5),
        lambda: dp.measure(PIXELS.float(), far, GROUND, pixel_sigma=0.5),
        lambda: dp.back_project(PIXELS.float()[None], dp.Camera.stack([camera_at(0.0).to(S), far])[:, None], GROUND),
    ]
    for use in uses:
        with warned("0.01"):
            use()
    with warned("0.01"):  # not the distance from the origin counts, but that in units of the distance from the plane
        dp.back_project(PIXELS.float(), camera_at(1e3, 0.01).to(S), GROUND)


def test_the_height_is_that_above_the_plane() -> None:
    """Plane and camera are far from the origin on the same side, and near each other."""
    camera, plane = camera_at(0.0, 1e6 + 10).to(S), dp.Plane.z(1e6)
    with warned("0.01"):
        dp.PlaneMap(camera, plane)
    with warned("0.01"):
        dp.measure(PIXELS.float(), camera, plane, pixel_sigma=0.5)


def test_scenes_near_the_origin_and_float64_do_not_warn() -> None:
    for camera in (camera_at(0.0), camera_at(3e3), camera_at(0.0, 1e7), camera_at(1e9, 1e8), camera_at(0.0, 1e-7)):
        dp.back_project(PIXELS.float(), camera.to(S), GROUND)
        dp.back_project(PIXELS, camera, GROUND)
    dp.back_project(PIXELS, camera_at(1e7), GROUND)
    on_plane = dp.Camera(camera_at(0.0).K, camera_at(0.0).R, torch.zeros(3, dtype=D)).to(S)
    assert not dp.back_project(PIXELS.float(), on_plane, GROUND)[1].any()


def test_transforms_do_not_look() -> None:
    far = camera_at(1e6).to(S)
    torch.func.vmap(lambda t: dp.back_project(PIXELS.float(), far.at(far.R, t), GROUND)[0])(far.t[None])


@pytest.mark.plain
def test_the_warning_points_at_the_caller_and_comes_once() -> None:
    far = camera_at(1e6).to(S)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("default")
        for _ in range(5):
            dp.back_project(PIXELS.float(), far, GROUND)
    assert [warning.filename for warning in seen] == [__file__]


def test_pixels_of_points_far_from_the_origin() -> None:
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]])
    far = dp.Camera(K, t=torch.tensor([-5e6, -5e6, 500]))
    with pytest.warns(UserWarning, match="float32: .* rounding moves pixels by 0.1 px or more; use float64"):
        far.project(torch.tensor([[5e6 + 1, 5e6, 0.0]]))
    far.to(torch.float64).project(torch.tensor([[5e6 + 1, 5e6, 0.0]], dtype=torch.float64))
    near = dp.Camera(K, t=torch.tensor([-5.0, -5, 500]))
    for points in (torch.rand(100, 3), torch.zeros(0, 3), torch.full((4, 3), float("nan"))):
        near.project(points)
    near.project(torch.tensor([[5.0, 5, -499.99], [0, 0, 1], [0, 0, 2]]))  # one of them close to the camera


@pytest.mark.parametrize("learn", [(), "focal", ("pose", "plane")])
def test_a_projector_warns_once(learn: tuple[str, ...] | str) -> None:
    K = torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]])
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        projector = dp.PlaneProjector(dp.Camera(K, t=torch.tensor([-5e6, -5e6, 500])), dp.Plane.z(0.0), learn=learn)
        for _ in range(3):
            projector(torch.tensor([[300.0, 200]]))
    assert len(seen) == 1


@pytest.mark.parametrize(("offset", "below"), [(1e5, 1.0), (-1e5, 1.0)])
def test_a_camera_close_to_a_plane_far_off_is_warned_of(offset: float, below: float) -> None:
    """What counts is how far the camera is from the plane, on whichever side of the origin both are."""
    flipped = torch.diag(torch.tensor([1.0, -1, -1]))  # looks down
    height = offset + below
    camera = dp.Camera(
        torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), flipped, torch.tensor([0.0, 0, height])
    )
    with pytest.warns(UserWarning, match="so far from the world's origin"):
        dp.back_project(torch.tensor([[320.0, 240.0]]), camera, dp.Plane.z(offset))
