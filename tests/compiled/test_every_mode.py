"""Every public map in every mode of PyTorch: what eager gives, with gradients where there are any."""

from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

import diffproj as dp

K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
R = dp.rotation_from_euler(*torch.tensor([0.3, 0.2, 0.1]))
LENS = dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002]))
CAMERA = dp.Camera(K, R, torch.tensor([0.0, 0, 1000]), LENS, (640, 480))
SMALL = CAMERA.resized((64, 48))
PLANE = dp.Plane.z(0.0)
TO_PLANE = dp.PlaneMap(CAMERA, PLANE)
FROZEN = dp.PlaneProjector(CAMERA, PLANE)
LEARNED = dp.PlaneProjector(CAMERA, PLANE, ("focal", "distortion", "pose", "plane"))
BANK = dp.PlaneProjector(dp.stack([CAMERA, CAMERA.shifted([5.0, 0, 0])]), PLANE)
FISHEYE = dp.Camera(K, R, CAMERA.t, dp.KannalaBrandt(torch.tensor([0.05, -0.01, 0.002, 0.0])), (640, 480))
LENSES = dp.ProjectorBank([CAMERA, FISHEYE], PLANE)
PINHOLE = dp.Camera(K, R, CAMERA.t, size=(640, 480))
BOARD = dp.Landmarks(torch.rand(6, 3, generator=torch.Generator().manual_seed(3)) * torch.tensor([100.0, 100, 0]))
VIEWS = dp.Views(torch.rand(2, 6, 2, generator=torch.Generator().manual_seed(2)) * torch.tensor([640.0, 480]))
RIG = dp.LearnableRig({"left": CAMERA, "right": FISHEYE.shifted([5.0, 0, 0])})
EXTENT = (-100.0, -100.0, 100.0, 100.0)
EXTENTS = torch.tensor([[-100.0, -100, 100, 100], [-50, 0, 150, 90]])

Map = Callable[[Tensor], tuple[Tensor, ...]]


def lost(pixels: Tensor) -> tuple[Tensor, ...]:
    points, valid = FROZEN(pixels)
    return (dp.PlaneLoss(dp.Huber(5.0), pull=1.0)(points, 0 * points, valid, miss=FROZEN.miss(pixels)),)


def moved(points: Tensor, camera: dp.Camera = CAMERA) -> dp.Camera:
    """Two cameras that stand elsewhere."""
    return camera.shifted(points[..., 0, :])


def turned(points: Tensor) -> Tensor:
    """Two rotations."""
    return dp.rotation_from_euler(*(points[..., 0, :] / 200).unbind(-1))


def extrinsics(points: Tensor) -> Tensor:
    return torch.cat([turned(points), points[..., :1, :].mT], dim=-1)


def parts(*cameras: dp.Camera) -> tuple[Tensor, ...]:
    return tuple(tensor for camera in cameras for tensor in (camera.R, camera.t, camera.K))


MAPS: dict[str, tuple[str, Map]] = {
    "back_project": ("pixels", lambda x: dp.back_project(x, CAMERA, PLANE)),
    "PlaneMap": ("pixels", lambda x: TO_PLANE(x)),
    "miss": ("pixels", lambda x: (TO_PLANE.miss(x),)),
    "explain": ("pixels", lambda x: (dp.explain(x, CAMERA, PLANE),)),
    "ground_resolution": ("pixels", lambda x: dp.ground_resolution(x, CAMERA, PLANE)),
    "project": ("points", lambda x: CAMERA.project(x)),
    "directions": ("pixels", lambda x: CAMERA.directions(x)),
    "rays": ("pixels", lambda x: CAMERA.rays(x)),
    "distance": ("points", lambda x: (dp.Plane([0.0, 0.1, 1.0], 2.0).distance(x),)),
    "frozen projector": ("pixels", lambda x: FROZEN(x)),
    "learned projector": ("pixels", lambda x: LEARNED(x)),
    "projector of a bank": ("pixels", lambda x: BANK(x, camera=torch.tensor([1, 0]))),
    "loss": ("pixels", lost),
    "projector, warped image": (
        "pixels",
        lambda x: FROZEN(x, warp=torch.tensor([[0.0, -1, 479], [1, 0, 0], [0, 0, 1]])),
    ),
    "projector, other plane": ("pixels", lambda x: FROZEN(x, plane=dp.Plane.z(7.0))),
    "bank of lenses": ("pixels", lambda x: LENSES(x, camera=torch.tensor([1, 0]))),
    "bank of lenses, warped images": (
        "pixels",
        lambda x: LENSES(x, camera=torch.tensor([1, 0]), warp=torch.eye(3).expand(len(x), 3, 3), plane=dp.Plane.z(7.0)),
    ),
    "fisheye": ("pixels", lambda x: dp.back_project(x, FISHEYE, PLANE)),
    "undistort": ("pixels", lambda x: LENS.undistort(x / 1000 - 0.3)),
    "distort": ("pixels", lambda x: LENS.distort(x / 1000 - 0.3)),
    "map's resolution": ("pixels", lambda x: TO_PLANE.resolution(x)),
    "with reach": ("pixels", lambda x: TO_PLANE.with_reach(x)),
    "in image": ("pixels", lambda x: (CAMERA.in_image(x),)),
    "image residuals": ("points", lambda x: dp.image_residuals(moved(x), VIEWS, BOARD)),
    "plane residuals": ("points", lambda x: dp.plane_residuals(moved(x), VIEWS, BOARD)),
    "homography": (
        "points",
        lambda x: (dp.PlaneMap(moved(x, PINHOLE), PLANE).homography(dp.plane_axes(PLANE.like(K))),),
    ),
    "shifted": ("points", lambda x: parts(moved(x))),
    "at": ("points", lambda x: parts(CAMERA.at(turned(x), x[..., 1, :]))),
    "from extrinsics": ("points", lambda x: parts(dp.Camera.from_extrinsics(extrinsics(x), K, "opengl", "world"))),
    "from matrix": (
        "points",
        lambda x: parts(dp.Camera.from_matrix((K[..., None] * extrinsics(x)[:, None]).sum(-2), (640, 480))),
    ),
    "to extrinsics": ("points", lambda x: (moved(x).world_to_cam("opengl"), moved(x).cam_to_world("pytorch3d"))),
    "warped": (
        "pixels",
        lambda x: parts(CAMERA.warped(torch.eye(3) + 1e-3 * torch.nn.functional.pad(x[:, :2], (0, 1, 0, 1)))),
    ),
    "resized": ("points", lambda x: parts(moved(x).resized((320, 240)), moved(x).cropped(9, 9, 99, 99))),
    "upright": ("points", lambda x: parts(moved(x).upright())),
    "center": ("points", lambda x: (moved(x).center,)),
    "looking at": (
        "points",
        lambda x: parts(dp.Camera.looking_at(x[..., 0, :] + 9.0, -x[..., 1, :], focal=500.0, size=(640, 480))),
    ),
    "mounting": ("points", lambda x: tuple(moved(x).mounting()[:3])),
    "euler angles": ("points", lambda x: dp.euler_from_rotation(turned(x))),
    "plane through points": (
        "points",
        lambda x: (dp.Plane.from_points(x).normal, *dp.plane_axes(dp.Plane.from_points(x))),
    ),
    "learned rig": ("points", lambda x: tuple(RIG()[name].project(x)[0] for name in RIG)),
    "bank's miss": ("pixels", lambda x: (LENSES.miss(x, camera=torch.tensor([1, 0])),)),
    "rectify by extents": ("image", lambda x: dp.rectify(x, SMALL, PLANE, EXTENTS, size=(20, 16), samples=1)),
    "rectify": ("image", lambda x: dp.rectify(x, SMALL, PLANE, EXTENT, 10.0, samples=1)),
    "render": ("image", lambda x: dp.render(x, SMALL, PLANE, EXTENT, size=(16, 12), samples=2)),
}
INPUTS = {
    "pixels": torch.rand(2, 6, 2, generator=torch.Generator().manual_seed(1)) * torch.tensor([640.0, 480]),
    "points": torch.rand(2, 6, 3, generator=torch.Generator().manual_seed(1)) * 100,
    "image": torch.rand(2, 1, 48, 64, generator=torch.Generator().manual_seed(1)),
}
OF_IMAGES = {"rectify", "rectify by extents", "render"}


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    torch._dynamo.reset()
    yield
    torch.use_deterministic_algorithms(False)


def under_autocast(function: Map, inputs: Tensor) -> tuple[Tensor, ...]:
    with torch.autocast("cpu", dtype=torch.bfloat16):
        return function(inputs)


def compiled(function: Map, inputs: Tensor) -> tuple[Tensor, ...]:
    return torch.compile(function, fullgraph=True, backend="aot_eager")(inputs)


def exported(function: Map, inputs: Tensor) -> tuple[Tensor, ...]:
    class Called(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.learned = LEARNED  # so that its parameters are the program's

        def forward(self, x: Tensor) -> tuple[Tensor, ...]:
            return function(x)

    return torch.export.export(Called(), (inputs,), strict=False).module()(inputs)


def mapped(function: Map, inputs: Tensor) -> tuple[Tensor, ...]:
    return torch.vmap(function)(inputs.unsqueeze(0).expand(3, *inputs.shape))


def in_inference_mode(function: Map, inputs: Tensor) -> tuple[Tensor, ...]:
    with torch.inference_mode():
        return function(inputs.clone())


def deterministic(function: Map, inputs: Tensor) -> tuple[Tensor, ...]:
    torch.use_deterministic_algorithms(True)
    return function(inputs)


MODES = {
    "autocast": under_autocast,
    "compile": compiled,
    "export": exported,
    "vmap": mapped,
    "inference mode": in_inference_mode,
    "deterministic": deterministic,
}
SLOW = {"compile", "export"}


@pytest.mark.parametrize("what", MAPS)
@pytest.mark.parametrize(
    "mode", [pytest.param(mode, marks=pytest.mark.slow) if mode in SLOW else mode for mode in MODES]
)
def test_what_eager_gives(mode: str, what: str) -> None:
    kind, function = MAPS[what]
    inputs = INPUTS[kind].clone().requires_grad_(mode not in ("inference mode", "export"))
    wants = function(inputs)
    founds = MODES[mode](function, inputs)
    assert len(wants) == len(founds)
    for want, found in zip(wants, founds, strict=True):
        found = found[1] if mode == "vmap" else found
        assert found.dtype == want.dtype
        if want.is_floating_point():
            size = max(float(want.detach().abs().max()), 1.0)
            tolerance = size * (2e-4 if what in OF_IMAGES else 2e-6)
            torch.testing.assert_close(found, want, rtol=0, atol=tolerance)
        else:
            assert torch.equal(found, want)
    if inputs.requires_grad and wants[0].requires_grad:
        (want,) = torch.autograd.grad(wants[0].sum(), inputs)
        (found,) = torch.autograd.grad(founds[0].sum(), inputs)
        found = found / 3 if mode == "vmap" else found
        torch.testing.assert_close(found, want, rtol=1e-3, atol=1e-5 * float(want.abs().max()))
