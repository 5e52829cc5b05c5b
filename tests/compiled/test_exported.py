"""Exported programs: any batch, no operators of the package's own, in ONNX and in a process without the package."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import diffproj as dp

pytestmark = pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning")  # PyTorch's own

K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
R = dp.rotation_from_euler(*torch.tensor([0.3, 0.2, 0.1]))
T = torch.tensor([0.0, 0, 1000])
BROWN = [-0.25, 0.09, -6e-4, 7e-4, -0.02, 0.01, -0.003, 0.001, 1e-3, -1e-4, 2e-3, 1e-4, 0.02, -0.03]
LENSES = {
    "none": None,
    "brown5": dp.BrownConrady(torch.tensor(BROWN[:5])),
    "brown8": dp.BrownConrady(torch.tensor(BROWN[:8])),
    "brown14": dp.BrownConrady(torch.tensor(BROWN)),
    "fisheye": dp.KannalaBrandt(torch.tensor([0.01, -0.002, 0, 0])),
}
PIXELS = torch.rand(3, 7, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([640.0, 480])
POINTS = torch.rand(3, 7, 3, generator=torch.Generator().manual_seed(0)) * 100


class Called(torch.nn.Module):
    """A function as a module."""

    def __init__(self, function: Callable[..., tuple[torch.Tensor, ...]]) -> None:
        super().__init__()
        self.function = function

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return self.function(x)


def case(what: str, lens: str) -> tuple[torch.nn.Module, torch.Tensor]:
    camera, plane = dp.Camera(K, R, T, LENSES[lens], (640, 480)), dp.Plane.z(0.0)
    if what == "projector":
        return dp.PlaneProjector(camera, plane), PIXELS
    if what == "project":
        return Called(camera.project), POINTS
    if what == "bank":
        bank = dp.ProjectorBank([camera, dp.Camera(K, R, T + 50, LENSES[lens], (800, 480))], plane)
        return Called(lambda pixels: bank(pixels, torch.arange(pixels.shape[0]) % 2)), PIXELS
    return Called(lambda pixels: dp.back_project(pixels, camera, plane)), PIXELS


def exported(what: str, lens: str) -> tuple[torch.nn.Module, torch.export.ExportedProgram, torch.Tensor]:
    """With any number of batch elements and points."""
    module, example = case(what, lens)
    shapes = ({0: torch.export.Dim("batch"), 1: torch.export.Dim("points")},)
    return module, torch.export.export(module, (example,), dynamic_shapes=shapes, strict=False), example


def own_operators(program: torch.export.ExportedProgram) -> set[str]:
    graphs = [part for part in program.graph_module.modules() if isinstance(part, torch.fx.GraphModule)]
    return {str(node.target) for graph in graphs for node in graph.graph.nodes if "diffproj" in str(node.target)}


def slow_behind(names: list[str]) -> list[object]:
    return [name if name == "none" else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.mark.parametrize("lens", slow_behind(list(LENSES)))
@pytest.mark.parametrize("what", ["projector", "project", "back_project"])
def test_any_batch_and_no_operators_of_our_own(what: str, lens: str) -> None:
    module, program, example = exported(what, lens)
    assert not own_operators(program)
    for inputs in (example, torch.cat([example, example + 1.0]), example[:2, :3]):
        for got, want in zip(program.module()(inputs), module(inputs), strict=True):
            torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("lens", slow_behind(["none", "brown5", "fisheye"]))
def test_a_warp_of_each_sample_in_a_batch_of_any_length(lens: str) -> None:
    class Warped(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.projector = case("projector", lens)[0]

        def forward(self, pixels: torch.Tensor, warp: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return self.projector(pixels, warp=warp)

    module, batch = Warped(), {0: torch.export.Dim("batch")}
    warp = torch.eye(3) + torch.zeros(3, 3, 3)
    warp[:, 0, 2] = torch.arange(3.0)
    program = torch.export.export(module, (PIXELS, warp), dynamic_shapes=(batch, batch), strict=False)
    assert not own_operators(program)
    for count in (2, 3, 6):
        inputs = PIXELS.repeat(2, 1, 1)[:count], warp.repeat(2, 1, 1)[:count]
        for got, want in zip(program.module()(*inputs), module(*inputs), strict=True):
            torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-3)


def test_next_to_a_fold_an_exported_lens_is_right_or_not_valid() -> None:
    lens = dp.BrownConrady(torch.tensor([-0.35, 0.05, 1e-3, 1e-4, 0.0], dtype=torch.float64))
    assert lens.domain.isfinite()
    program = torch.export.export(
        Called(lens.undistort),
        (torch.rand(50, 2, dtype=torch.float64),),
        dynamic_shapes=({0: torch.export.Dim("n")},),
        strict=False,
    )
    angle = torch.linspace(0, 6.28, 400, dtype=torch.float64)
    around = torch.stack([angle.cos(), angle.sin()], dim=-1)
    for share, least in ((0.5, 400), (0.98, 400), (1 - 1e-3, 100), (1 - 1e-6, 0), (1.02, 0)):
        xy, inside = lens.distort(lens.domain * share * around)
        if not inside.all():
            xy = 1.2 * lens.distort(0.999 * lens.domain * around)[0]
        found, valid = program.module()(xy)
        want, seen = lens.undistort(xy)
        assert not (valid & ~seen).any()
        assert valid.sum() >= least
        torch.testing.assert_close(found[valid], want[valid], rtol=0, atol=1e-9)


IN_ONNX = [  # each takes half a minute
    ("projector", "none"),
    ("bank", "none"),
    ("projector", "brown14"),
    ("projector", "fisheye"),
    ("project", "brown14"),
    ("project", "fisheye"),
    ("back_project", "brown5"),
]


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")  # its exporter's, of the largest float64
@pytest.mark.slow
@pytest.mark.parametrize(("what", "lens"), IN_ONNX)
def test_onnx(what: str, lens: str, tmp_path: Path) -> None:
    onnx, runtime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    module, program, example = exported(what, lens)
    torch.onnx.export(program, dynamo=True, verbose=False).save(tmp_path / "map.onnx")
    assert {node.domain for node in onnx.load(tmp_path / "map.onnx").graph.node} <= {"", "ai.onnx"}
    session = runtime.InferenceSession(tmp_path / "map.onnx", providers=["CPUExecutionProvider"])
    inputs = torch.cat([example, example + 1.0])
    got, valid = session.run(None, {session.get_inputs()[0].name: inputs.numpy()})
    want, seen = module(inputs)
    size = want.abs().max()
    torch.testing.assert_close(torch.from_numpy(got) / size, want / size, rtol=0, atol=1e-5)
    assert torch.equal(torch.from_numpy(valid), seen)


ELSEWHERE = """
import sys, torch
kind, program, inputs, results = sys.argv[1:]
pixels = torch.load(inputs)
if kind == "export":
    call = torch.export.load(program).module()
else:
    call = torch._inductor.aoti_load_package(program)
points, valid = call(pixels)
assert "diffproj" not in sys.modules
torch.save((points, valid), results)
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["export", "inductor"])
@pytest.mark.parametrize("lens", ["none", "brown5"])
def test_a_process_without_the_package(kind: str, lens: str, tmp_path: Path) -> None:
    if kind == "inductor" and shutil.which("g++") is None:
        pytest.skip("no C++ compiler is here")
    module, program, example = exported("projector", lens)
    path, inputs, results = (tmp_path / name for name in ("map.pt2", "inputs.pt", "results.pt"))
    if kind == "export":
        torch.export.save(program, path)
    else:
        torch._inductor.aoti_compile_and_package(program, package_path=str(path))
    pixels = torch.cat([example, example + 1.0])
    torch.save(pixels, inputs)
    subprocess.run([sys.executable, "-c", ELSEWHERE, kind, path, inputs, results], check=True, cwd=tmp_path)
    for got, want in zip(torch.load(results), module(pixels), strict=True):
        torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("strict", [False, True])
def test_planes_of_numbers_and_cameras_of_lists_inside_a_graph(strict: bool) -> None:
    def above(pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        camera = dp.Camera(K, R, T, size=(640, 480))
        return dp.back_project(pixels, camera, dp.Plane([0.0, 0.1, 1.0], 2.0))

    want, valid = above(PIXELS)
    torch._dynamo.reset()
    compiled = torch.compile(above, fullgraph=True, backend="aot_eager")
    program = torch.export.export(Called(above), (PIXELS,), strict=strict)
    for call in (compiled, program.module()):
        points, seen = call(PIXELS)
        torch.testing.assert_close(points, want, rtol=1e-6, atol=1e-3)
        assert torch.equal(seen, valid)
