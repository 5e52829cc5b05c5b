"""A rig as a module: what it starts with, what is learned, that it finds the calibrated minimum, and its state."""

import copy
from pathlib import Path

import pytest
import torch

import diffproj as dp
from diffproj.geometry.cayley import turned
from tests.nn.processes import one_of

D = torch.float64
BOARD = dp.Chessboard(4, 3, 30.0)


def cameras(dtype: torch.dtype = D) -> dict[str, dp.Camera]:
    """A wide camera, a long one with a lens, and a fisheye, of three sizes."""
    K = torch.tensor([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]], dtype=dtype)
    R = dp.rotation_from_euler(*torch.tensor([0.1, -0.2, 0.05], dtype=dtype))
    lens, fisheye = torch.tensor([-0.2, 0.05, 1e-3, 0], dtype=dtype), torch.tensor([0.01, 0, 0, 0], dtype=dtype)
    t = torch.tensor([[0.0, 0, 0], [-40, 3, 5], [60, 0, 10]], dtype=dtype)
    eye = torch.eye(3, dtype=dtype)
    return {
        "front": dp.Camera(K, eye, t[0], None, (640, 480)),
        "side.1": dp.Camera(
            1.5 * K + torch.diag(t.new_tensor([0, 0, -0.5])), R, t[1], dp.BrownConrady(lens), (960, 720)
        ),
        "items": dp.Camera(K, R.mT, t[2], dp.KannalaBrandt(fisheye), (640, 480)),
    }


def moments(count: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    draw = torch.Generator().manual_seed(0)
    R = turned(torch.eye(3, dtype=D).repeat(count, 1, 1), 0.2 * torch.randn(count, 3, generator=draw, dtype=D))
    return R, torch.tensor([0.0, 0, 400], dtype=D) + 20 * torch.randn(count, 3, generator=draw, dtype=D)


def same(one: dp.Camera, other: dp.Camera) -> bool:
    parts = zip(one.tensors(), other.tensors(), strict=True)
    return one.size == other.size and all(torch.allclose(a, b, rtol=1e-12, atol=1e-12) for a, b in parts)


def test_it_starts_with_the_cameras_that_it_was_given() -> None:
    given = cameras()
    rig = dp.LearnableRig(given)
    assert list(rig) == list(given) == list(rig())
    assert len(rig) == 3
    assert all(same(rig()[name], given[name]) for name in given)
    R, t = moments()
    moving = dp.LearnableRig(given, moments=(R, t))()
    for name, camera in given.items():
        want = camera.at(camera.R @ R, (camera.R @ t.unsqueeze(-1)).squeeze(-1) + camera.t)
        assert moving[name].batch_shape == (4,)
        assert same(moving[name], want)
    calibrated = dp.calibrate_rig({name: dp.example_views(name) for name in ("left", "right")}, dp.Chessboard())
    of_rig = dp.LearnableRig(calibrated, moments=(calibrated.R_target, calibrated.t_target))
    assert same(of_rig()["right"], calibrated["right"].cameras)
    assert same(dp.LearnableRig(calibrated).float()()["left"].to(D), calibrated.cameras["left"].to(torch.float32).to(D))


def learnt(learn: object) -> list[str]:
    return [name for name, _ in dp.LearnableRig(cameras(), learn, moments()).named_parameters()]  # type: ignore[arg-type]


def test_what_is_learned() -> None:
    assert learnt(()) == []
    assert learnt("focal") == [f"members.{i}.log_focal" for i in range(3)]
    assert learnt(("pose",)) == [f"members.{i}.{part}" for i in (1, 2) for part in ("rotation", "translation")]
    assert learnt(("front.pose",)) == ["members.0.rotation", "members.0.translation"]
    assert learnt(("distortion",)) == ["members.1.distortion", "members.2.distortion"]
    alike = dict(zip(("side", "side.1"), cameras().values(), strict=False))  # of which one name begins as the other
    rig = dp.LearnableRig(alike, ("side.1.focal", "side.principal_point"))
    assert [name for name, _ in rig.named_parameters()] == ["members.0.principal_point", "members.1.log_focal"]
    assert learnt(("side.1.principal_point", "moments")) == [
        "members.1.principal_point",
        "moments.rotation",
        "moments.translation",
    ]
    assert learnt({"focal": True, "front.focal": False, "items.yaw": True}) == [
        "members.1.log_focal",
        "members.2.log_focal",
        "members.2.yaw",
    ]
    every = learnt(None)
    assert "members.0.log_focal" in every
    assert "moments.rotation" in every
    assert "members.0.rotation" not in every
    some = dp.LearnableRig(cameras(), {"moments": [True, False, True, True]}, moments())
    some()["items"].t.sum().backward()
    assert some.moments is not None
    assert some.moments.translation.grad is not None
    assert (some.moments.translation.grad.abs().sum(-1) > 0).tolist() == [True, False, True, True]


def test_it_is_frozen_and_thawed_by_name() -> None:
    rig = dp.LearnableRig(cameras(), moments=moments())
    rig["front"].requires_grad_(False)
    sum(camera.K.sum() for camera in rig().values()).backward()  # type: ignore[union-attr]
    assert rig["front"].log_focal.grad is None
    assert rig["items"].log_focal.grad is not None
    with pytest.raises(ValueError, match="name: want .*, got 'rear'"):
        rig["rear"]


def test_gradients_are_those_of_finite_differences() -> None:
    rig, draw = dp.LearnableRig(cameras(), moments=moments(2)), torch.Generator().manual_seed(1)
    values = {name: 0.02 * torch.randn(p.shape, generator=draw, dtype=D) for name, p in rig.named_parameters()}
    points = BOARD.points[::4].to(D)

    def pixels(*parts: torch.Tensor) -> torch.Tensor:
        found = torch.func.functional_call(rig, dict(zip(values, parts, strict=True)), ())
        return torch.stack([camera.project(points)[0] for camera in found.values()])

    assert torch.autograd.gradcheck(pixels, tuple(value.requires_grad_() for value in values.values()), fast_mode=True)


def test_training_ends_where_the_calibration_does() -> None:
    given, (R, t) = (
        {name: dp.Camera(c.K, c.R, c.t, None, c.size) for name, c in list(cameras().items())[:2]},
        moments(8),
    )
    draw = torch.Generator().manual_seed(2)
    true = dp.LearnableRig(given, (), (R, t))()
    views = {
        name: dp.Views(camera.project(BOARD.points)[0] + 0.1 * torch.randn(8, 12, 2, generator=draw, dtype=D))
        for name, camera in true.items()
    }
    views = {name: dp.Views(one.pixels, size=given[name].size) for name, one in views.items()}
    found = dp.calibrate_rig(views, BOARD, "none")
    rig = dp.LearnableRig(given, moments=(R, t))
    names, x = zip(*((name, p.detach().flatten()) for name, p in rig.named_parameters()), strict=True)
    shapes, sizes = [p.shape for p in rig.parameters()], [len(part) for part in x]

    def errors(x: torch.Tensor) -> torch.Tensor:
        parts = [part.reshape(shape) for part, shape in zip(x.split(sizes), shapes, strict=True)]
        found = torch.func.functional_call(rig, dict(zip(names, parts, strict=True)), ())
        return torch.cat([dp.image_residuals(c, views[name], BOARD)[0].flatten() for name, c in found.items()])

    at = torch.cat(x)
    for _ in range(6):  # Gauss and Newton, with the module's own derivatives
        at = at - torch.linalg.lstsq(torch.func.jacfwd(errors)(at), errors(at)).solution
    torch.nn.utils.vector_to_parameters(at, rig.parameters())
    count = sum(int(one.used.sum()) for one in found.calibrations.values())
    assert float((errors(at).square().sum() / count).sqrt()) == pytest.approx(found.rms, rel=1e-9)
    one, other = rig()["side.1"], found.cameras["side.1"]
    assert torch.allclose(rig["side.1"]().t, other.t, rtol=1e-4)
    assert torch.allclose(one.K[0], other.K, rtol=1e-5)


def test_state_copies_and_precision() -> None:
    rig = dp.LearnableRig(cameras(), moments=moments())
    with torch.no_grad():
        for parameter in rig.parameters():
            parameter += 0.01
    for other in (copy.deepcopy(rig), dp.LearnableRig(cameras(), moments=moments())):
        other.load_state_dict(rig.state_dict())
        assert all(same(other()[name], rig()[name]) for name in rig)
    names = dict(zip(("a", "b", "c"), cameras().values(), strict=True))
    with pytest.raises(
        RuntimeError, match="want the state of a rig of cameras a, b, c, got one of front, side.1, items"
    ):
        dp.LearnableRig(names, moments=moments()).load_state_dict(rig.state_dict())
    single = copy.deepcopy(rig).to(torch.float32)
    assert single()["items"].dtype == torch.float32
    half = copy.deepcopy(single).half()
    assert all(parameter.dtype == torch.float32 for parameter in half.parameters())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(single()["items"].R, half()["items"].R)
        assert single()["items"].R.dtype == torch.float32
    empty = copy.deepcopy(rig).to("meta").to_empty(device="cpu")
    empty.load_state_dict(rig.state_dict())
    assert same(empty()["front"], rig()["front"])
    assert "names=('front', 'side.1', 'items')" in str(rig)


@pytest.mark.plain
def test_it_is_compiled_whole() -> None:
    rig = dp.LearnableRig(cameras(), moments=moments())
    centers = torch.compile(
        lambda: torch.stack([one.center for one in rig().values()]), backend="eager", fullgraph=True
    )
    assert torch.allclose(centers(), torch.stack([one.center for one in rig().values()]))


class Errors(torch.nn.Module):
    """How far points are seen from some pixels, by a rig with a head before it: what `DistributedDataParallel` wraps."""

    def __init__(self) -> None:
        super().__init__()
        self.head, self.rig = torch.nn.Linear(2, 2, dtype=D), dp.LearnableRig(cameras(), moments=moments())
        torch.nn.init.eye_(self.head.weight)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        seen = torch.stack([camera.project(BOARD.points)[0] for camera in self.rig().values()])
        return (seen - self.head(pixels)).square().mean()


def _pixels() -> torch.Tensor:
    return 400 * torch.rand(2, 3, 4, 12, 2, dtype=D, generator=torch.Generator().manual_seed(0))


def _worker(rank: int, address: str, result: str) -> None:
    with one_of(2, rank, address):
        torch.manual_seed(0)
        parallel = torch.nn.parallel.DistributedDataParallel(Errors())
        parallel(_pixels()[rank]).backward()
        if rank == 0:
            torch.save([parameter.grad for parameter in parallel.parameters()], result)


@pytest.mark.slow
@pytest.mark.plain
def test_processes_share_gradients(tmp_path: Path) -> None:
    result = tmp_path / "gradients.pt"
    torch.multiprocessing.spawn(_worker, args=(str(tmp_path / "rendezvous"), str(result)), nprocs=2)
    torch.manual_seed(0)
    own = Errors()
    (sum(own(pixels) for pixels in _pixels()) / 2).backward()  # type: ignore[union-attr]
    for shared, parameter in zip(torch.load(result, weights_only=True), own.parameters(), strict=True):
        torch.testing.assert_close(shared, parameter.grad, rtol=1e-9, atol=1e-9)


@pytest.mark.plain
def test_wrong_arguments_are_named() -> None:
    given, (R, t) = cameras(), moments()
    with pytest.raises(
        TypeError, match=r"rig: want a dp.RigCalibration or a mapping from names to dp.Camera, got list"
    ):
        dp.LearnableRig(list(given.values()))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="rig: want at least one camera, got none"):
        dp.LearnableRig({})
    with pytest.raises(ValueError, match=r"rig\['front'\]: want one camera, got batch shape \(4,\)"):
        dp.LearnableRig({"front": given["front"].at(R, t)})
    with pytest.raises(
        TypeError, match=r"rig\['items'\]: want dtype torch.float64 as the first has, got torch.float32"
    ):
        dp.LearnableRig(given | {"items": given["items"].to(torch.float32)})
    with pytest.raises(
        ValueError,
        match="learn: want parts of focal, .* or one of the rig's cameras and its part, as items.pose, got 'rear.pose'",
    ):
        dp.LearnableRig(given, ("rear.pose",))
    with pytest.raises(ValueError, match=r"learn: want 'moments' for a rig that is given moments=\(R, t\), got none"):
        dp.LearnableRig(given, "moments")
    with pytest.raises(ValueError, match="moments: R: want rotation matrices"):
        dp.LearnableRig(given, moments=(2 * R, t))
    with pytest.raises(ValueError, match=r"moments: want R and t of batch shapes that broadcast, got \(4, 3, 3\)"):
        dp.LearnableRig(given, moments=(R, t[:3]))
    with pytest.raises(TypeError, match=r"moments: want a pair \(R, t\), world to rig, got"):
        dp.LearnableRig(given, moments=R)  # type: ignore[arg-type]
