"""Many cameras in one projector, chosen by index; parts of a pose; and batches of cameras from a `DataLoader`."""

from collections import OrderedDict, UserDict, defaultdict
from collections.abc import Callable, Iterator, MutableMapping
from functools import partial
from types import MappingProxyType
from typing import Any

import pytest
import torch

import diffproj as dp

D = torch.float64


@pytest.fixture
def cameras(lens_camera: dp.Camera) -> dp.Camera:
    shifts = torch.tensor([[0.0, 0, 0], [5, 0, 10], [0, -7, 30]], dtype=D)
    lens = dp.BrownConrady(lens_camera.distortion.coefficients * torch.tensor([[1.0], [0.5], [0.2]], dtype=D))
    return dp.Camera(lens_camera.K, lens_camera.R, lens_camera.t + shifts, lens, lens_camera.size)


@pytest.mark.parametrize("learn", [(), ("focal", "pose")])
def test_each_sample_is_seen_by_its_camera(learn: tuple[str, ...], cameras: dp.Camera, pixels: torch.Tensor) -> None:
    planes = dp.Plane.z(torch.tensor([0.0, 3.0, 6.0], dtype=D))
    projector = dp.PlaneProjector(cameras, planes, learn)
    chosen = [2, 0, 2, 1]
    samples = pixels[:40].reshape(4, 10, 2)
    warp = torch.tensor([[1.0, 0, 4], [0, 1, 2], [0, 0, 1]], dtype=D)
    for options in ({}, {"warp": warp}, {"plane": dp.Plane.z(1.0)}):
        points, valid = projector(samples, camera=torch.tensor(chosen), **options)
        missed = projector.miss(samples, camera=chosen, **options)
        for i, c in enumerate(chosen):
            one = cameras[c] if "warp" not in options else cameras[c].warped(warp)
            want, seen = dp.back_project(samples[i], one, options.get("plane", planes[c]))
            torch.testing.assert_close(points[i], want, rtol=1e-10, atol=1e-8)
            assert torch.equal(valid[i], seen)
        assert torch.equal(missed > 0, ~valid)
    torch.testing.assert_close(projector(samples[0], camera=2)[0], projector(samples, camera=chosen)[0][0])
    with pytest.raises(ValueError, match="camera: want numbers from 0 to 2, got 3"):
        projector(samples, camera=[0, 1, 2, 3])
    with pytest.raises(ValueError, match="camera: want none for a projector of one camera"):
        dp.PlaneProjector(cameras[0], dp.Plane.z(0.0))(samples, camera=[0, 0, 0, 0])


@pytest.mark.parametrize(
    ("part", "name", "step"), [("pitch", "tilt", 0.05), ("yaw", "heading", 0.05), ("roll", "roll", 0.05)]
)
def test_an_angle_turns_the_camera_where_it_stands(part: str, name: str, step: float) -> None:
    level = {"pitch": (20.0, 0.0), "yaw": (0.0, 0.0), "roll": (20.0, 5.0)}[part]
    camera = dp.Camera.mounted(6.0, *level, heading_deg=30.0, focal=500.0, size=(640, 480))
    module = dp.LearnableCamera(camera, learn=(part,))
    assert [name for name, _ in module.named_parameters()] == [part]
    torch.testing.assert_close(module().t, camera.t, rtol=0, atol=0)
    with torch.no_grad():
        getattr(module, part).fill_(step)
    before, after = camera.mounting(), module().mounting()
    degrees = 2 * torch.tensor(step / 2, dtype=D).atan().rad2deg()
    torch.testing.assert_close(getattr(after, name) - getattr(before, name), degrees)
    torch.testing.assert_close(module().center, camera.center)


def test_height_rotation_and_translation_alone() -> None:
    camera = dp.Camera.mounted(6.0, 20.0, focal=500.0, size=(640, 480))
    reach = camera.t.norm()
    found = {}
    for part in ("height", "rotation", "translation"):
        module = dp.LearnableCamera(camera, learn=(part,))
        with torch.no_grad():
            next(module.parameters()).fill_(0.1)
        found[part] = module()
    torch.testing.assert_close(found["height"].R, camera.R)
    torch.testing.assert_close(found["height"].mounting().height, 6 + 0.1 * reach)
    torch.testing.assert_close(found["rotation"].center, camera.center)
    assert (found["rotation"].R - camera.R).abs().max() > 0.05
    torch.testing.assert_close(found["translation"].R, camera.R)
    torch.testing.assert_close(found["translation"].t, camera.t + 0.1 * reach)
    both, pose = (dp.LearnableCamera(camera, learn=parts) for parts in (("rotation", "translation"), "pose"))
    for module in (both, pose):
        with torch.no_grad():
            for parameter in module.parameters():
                parameter.fill_(0.1)
    torch.testing.assert_close(both().t, pose().t)
    for parts in (("pose", "pitch"), ("rotation", "roll"), ("translation", "height")):
        with pytest.raises(ValueError, match=f"learn: want {parts[0]!r} or parts of it"):
            dp.LearnableCamera(camera, learn=parts)


def test_parts_of_a_pose_have_exact_gradients(pixels: torch.Tensor) -> None:
    camera = dp.Camera.mounted(6.0, 40.0, focal=500.0, size=(640, 480)).expand(2)
    projector = dp.PlaneProjector(
        camera, dp.Plane.z(0.0), {"pitch": True, "roll": [True, False], "yaw": True, "height": True}
    )
    names, values = zip(*projector.named_parameters(), strict=True)
    assert len(names) == 4

    def total(*values: torch.Tensor) -> torch.Tensor:
        state = dict(zip(names, values, strict=True))
        points, _ = torch.func.functional_call(projector, state, (pixels[:10],))
        return points.sin().sum()

    inputs = [(value.detach() + 0.02).requires_grad_() for value in values]
    assert torch.autograd.gradcheck(total, inputs, fast_mode=True)


def test_a_bank_of_different_lenses(cameras: dp.Camera, pixels: torch.Tensor) -> None:
    fisheye = dp.KannalaBrandt(torch.tensor([0.01, -0.002, 0, 0], dtype=D))
    several = [
        cameras[0],
        dp.Camera(cameras.K[0], cameras.R[0], cameras.t[0], fisheye, (640, 480)),
        dp.Camera(cameras.K[0], cameras.R[0], cameras.t[0] + 5),
        cameras[1],
    ]
    bank = dp.ProjectorBank(several, dp.Plane.z(2.0), ("focal", "distortion"))
    assert (len(bank), len(bank.projectors)) == (4, 3)
    chosen, samples = [3, 0, 2, 1, 0], pixels[:50].reshape(5, 10, 2).clone().requires_grad_()
    points, valid = bank(samples, camera=chosen)
    for i, c in enumerate(chosen):
        want, seen = dp.back_project(samples[i], several[c], dp.Plane.z(2.0))
        torch.testing.assert_close(points[i], want, rtol=1e-10, atol=1e-8)
        assert torch.equal(valid[i], seen)
    warps = torch.eye(3, dtype=D).repeat(5, 1, 1)
    warps[:, 0, 2] = torch.arange(5.0)
    for warp, plane in ((warps, None), (warps[1], dp.Plane.z(1.0)), (None, dp.Plane.z(torch.arange(5.0, dtype=D)))):
        moved, seen = bank(samples, chosen, warp=warp, plane=plane)
        missed = bank.miss(samples, chosen, warp=warp, plane=plane)
        for i, c in enumerate(chosen):
            one = several[c] if warp is None else several[c].warped(warp if warp.ndim == 2 else warp[i])
            own = dp.Plane.z(2.0) if plane is None else plane[i] if plane.batch_shape else plane
            torch.testing.assert_close(moved[i], dp.back_project(samples[i], one, own)[0], rtol=1e-10, atol=1e-8)
        assert torch.equal(missed > 0, ~seen)
    points.sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in bank.parameters())
    again = dp.ProjectorBank(several, dp.Plane.z(0.0), ("focal", "distortion"))
    again.load_state_dict(bank.state_dict())
    torch.testing.assert_close(again(samples, camera=chosen)[0], points)
    with pytest.raises(ValueError, match="cameras: want at least one, each a single camera"):
        dp.ProjectorBank([cameras], dp.Plane.z(0.0))
    two_planes = dp.Plane.z(torch.zeros(2, 2, dtype=D))
    with pytest.raises(ValueError, match=r"plane: want one, or one for each of the 2 samples .* \(2, 2\)"):
        again(pixels[:4].reshape(2, 2, 2), camera=[0, 1], plane=two_planes)
    with pytest.raises(ValueError, match="camera: want numbers from 0 to 3"):
        bank(samples, camera=[0, 1, 2, 3, 4])
    none = torch.rand(0, 10, 2, dtype=D)
    assert bank(none, camera=[])[0].shape == (0, 10, 3)
    assert bank.miss(none, camera=[]).shape == (0, 10)


class Samples(torch.utils.data.Dataset):
    def __init__(self, cameras: dp.Camera) -> None:
        self.cameras = cameras

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, i: int) -> dict[str, object]:
        return {"image": torch.rand(3, 4, 4), "camera": self.cameras[i], "plane": (dp.Plane.z(float(i)), i)}


def test_a_loader_joins_cameras(cameras: dp.Camera) -> None:
    (batch,) = torch.utils.data.DataLoader(Samples(cameras), batch_size=3, collate_fn=dp.collate)
    assert batch["image"].shape == (3, 3, 4, 4)
    assert torch.equal(batch["camera"].t, cameras.t)
    assert batch["camera"].size == cameras.size
    planes, numbers = batch["plane"]
    assert planes.offset.tolist() == [0, 1, 2]
    assert numbers.tolist() == [0, 1, 2]
    assert len(dp.stack([cameras[0], cameras[1]])) == 2
    with pytest.raises(TypeError, match="items: want"):
        dp.stack([cameras[0], dp.Plane.z(0.0)])
    with pytest.raises(ValueError, match="samples: want at least one"):
        dp.collate([])
    with pytest.raises(
        ValueError, match=r"samples: want .* got Tensor of shape \(2, 2\), Tensor of shape \(3, 2\): stack"
    ):
        dp.collate([(torch.zeros(2, 2), 1), (torch.zeros(3, 2), 2)])


@pytest.mark.parametrize("join", [dp.stack, dp.collate, dp.Camera.stack])
def test_cameras_that_cannot_be_joined_are_for_a_bank(join: Callable[..., Any], cameras: dp.Camera) -> None:
    """Nothing said what to do."""
    first = cameras[0]
    K, zeros, plane = first.K, torch.zeros(12, dtype=first.dtype), dp.Plane.z(0.0)
    lenses = [None, dp.KannalaBrandt(zeros[:4]), dp.BrownConrady(zeros[:4]), dp.BrownConrady(zeros)]
    several = [dp.Camera(K, t=first.t, distortion=lens, size=first.size) for lens in lenses]
    for number, one in enumerate(several):
        for other in several[:number]:
            with pytest.raises((TypeError, ValueError), match=r"; dp\.ProjectorBank takes .* one lens model for all"):
                join([one, other])
    larger = dp.Camera(K, t=first.t, size=(800, 600))
    with pytest.raises(ValueError, match=r"the same size, got .*; dp\.ProjectorBank takes .*resized"):
        join([several[0], larger])
    points, valid = dp.ProjectorBank([*several, larger], plane)(K.new_full((5, 1, 2), 200.0), camera=range(5))
    assert valid.all()
    torch.testing.assert_close(points[2:], points[:1].expand(3, 1, 3))


class Sample(MutableMapping[str, Any]):
    """Keeps its values in an attribute, which a copy of it shares."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.values_of = values

    def __getitem__(self, key: str) -> Any:
        return self.values_of[key]

    def __setitem__(self, key: str, value: Any) -> None:
        self.values_of[key] = value

    def __delitem__(self, key: str) -> None:
        del self.values_of[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values_of)

    def __len__(self) -> int:
        return len(self.values_of)


def test_samples_of_any_kind_stay_as_they_are(cameras: dp.Camera) -> None:
    samples = [Sample({"camera": camera, "number": n}) for n, camera in enumerate(cameras)]
    batch = dp.collate(samples)
    assert type(batch) is dict
    assert torch.equal(batch["camera"].t, cameras.t)
    assert batch["number"].tolist() == [0, 1, 2]
    assert [sample["number"] for sample in samples] == [0, 1, 2]
    assert not samples[0]["camera"].batch_shape


def test_cameras_are_joined_in_dictionaries_of_any_kind(cameras: dp.Camera) -> None:
    for kind in (OrderedDict, partial(defaultdict, list), UserDict, MappingProxyType):
        samples = [kind({"camera": camera, "number": n}) for n, camera in enumerate(cameras)]
        batch = dp.collate(samples)
        assert list(batch) == ["camera", "number"]
        assert torch.equal(batch["camera"].t, cameras.t)
        assert batch["number"].tolist() == [0, 1, 2]
        assert isinstance(batch, type(samples[0])) or kind is MappingProxyType
        assert not samples[0]["camera"].batch_shape
