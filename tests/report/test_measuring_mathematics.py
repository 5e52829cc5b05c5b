"""The measuring page's own mathematics gives the library's numbers, for every lens."""

from collections.abc import Callable
from functools import cache
from typing import Any

import pytest
import torch

import diffproj as dp
from diffproj.report.measuring_model import as_one, measuring_model

D = torch.float64
LENSES = {
    "none": [],
    "brown4": [-0.28, 0.07, 0.0013, 0.0001],
    "brown5": [-0.28, 0.07, 0.0013, 0.0001, 0.002],
    "brown8": [0.9, 0.2, 0.001, -0.0008, 0.01, 1.2, 0.4, 0.05],
    "brown12": [-0.3, 0.1, 0.001, 0.0006, -0.01, 0.02, 0.01, 0.001, 0.003, -0.001, 0.002, 0.0006],
    "brown14": [-0.3, 0.1, 0.001, 0.0006, -0.01, 0.02, 0.01, 0.001, 0.003, -0.001, 0.002, 0.0006, 0.03, -0.02],
    "fisheye": [0.03, -0.01, 0.004, -0.0008],
}
QUICK = ("brown5", "fisheye")
SOME = [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in LENSES]
SIGMA = 0.5
SCENE = (
    "const scene = makeScene(given.model, makePlane(given.normal, given.offset), given.sigma, given.model.pixels_too)"
)


def lens_of(name: str) -> dp.Lens | None:
    if name == "none":
        return None
    return (dp.KannalaBrandt if name == "fisheye" else dp.BrownConrady)(torch.tensor(LENSES[name], dtype=D))


def camera_of(name: str) -> dp.Camera:
    """A camera that sees the plane, its horizon, and with some lenses beyond their domain."""
    K = torch.tensor([[420.0, 0.7, 322], [0, 423, 238], [0, 0, 1]], dtype=D)
    R = dp.rotation_from_euler(*torch.tensor([2.2, 0.15, 0.4], dtype=D))
    return dp.Camera(K, R, torch.tensor([30.0, -40, 600], dtype=D), lens_of(name), (640, 480))


@cache
def uncertain(name: str) -> dp.Calibration:
    """A camera calibrated from eight views with that lens."""
    board = dp.Chessboard()
    views = dp.example_views("left")[:9]
    if name == "brown5":
        return dp.calibrate(views, board, name)
    true = dp.calibrate(views, board, "brown5").cameras
    lens = lens_of(name)
    seen = dp.Camera(true.K, true.R, true.t, None if lens is None else lens.expand(9), true.size)
    pixels, valid = seen.project(board.points.to(D))
    pixels = pixels + 0.2 * torch.randn(pixels.shape, dtype=D, generator=torch.Generator().manual_seed(3))
    return dp.calibrate(dp.Views(pixels, valid, size=true.size), board, name)


def given(calibration: dp.Calibration | dp.Camera, plane: dp.Plane, pixels: torch.Tensor, sigma: Any = SIGMA) -> dict:
    model = measuring_model(*as_one(calibration, 0), plane, sigma)
    normal, offset = plane.normal.tolist(), plane.offset.item()
    return {"model": model, "normal": normal, "offset": offset, "sigma": model["sigma"], "pixels": pixels.tolist()}


def run(javascript: Callable[[str, Any], Any], body: str, data: dict) -> Any:
    return javascript(f"(() => {{ {SCENE}; {body} }})()", data)


def numbers(values: Any) -> torch.Tensor:
    """What JavaScript sent, with its names for what is not finite."""
    if isinstance(values, list):
        return torch.stack([numbers(value) for value in values]) if values else torch.zeros(0, dtype=D)
    return torch.tensor(float(values), dtype=D)


def same(found: torch.Tensor, wanted: torch.Tensor, tolerance: float = 1e-6) -> None:
    torch.testing.assert_close(found, wanted.detach(), rtol=tolerance, atol=tolerance, equal_nan=True)


@pytest.mark.parametrize("name", LENSES)
def test_ten_thousand_pixels_have_the_librarys_points(name: str, javascript: Callable[[str, Any], Any]) -> None:
    """Some of them beyond the image, the horizon, and the lens's domain."""
    camera, plane = camera_of(name), dp.Plane([0.1, -0.05, 1.0], 12.0)
    pixels = torch.rand(10_000, 2, dtype=D) * torch.tensor([1200.0, 900], dtype=D) - torch.tensor([280.0, 210], dtype=D)
    body = """return given.pixels.map((pixel) => {
      const found = pointAt(scene.map, pixel);
      return { reason: found.reason, point: found.point ?? [0, 0, 0], back: found.point ? project(scene.map.camera, found.point) : [0, 0] };
    })"""
    found = run(javascript, body, given(camera, plane, pixels))
    points, valid = dp.back_project(pixels, camera, plane)
    names = {"VALID": "valid", "OUTSIDE_LENS": "lens", "PARALLEL": "parallel", "BEHIND": "behind"}
    reasons = [names[dp.Reason(code).name] for code in dp.explain(pixels, camera, plane).tolist()]
    assert [each["reason"] for each in found] == reasons
    assert 500 < int(valid.sum()) < 10_000
    near = valid & (points.norm(dim=-1) < 1e5)  # closer to the horizon the pixel's own rounding is larger
    same(numbers([each["point"] for each in found])[near], points[near])
    same(numbers([each["back"] for each in found])[near], pixels[near])


@pytest.mark.filterwarnings("ignore:measure. pixel")  # beyond the photograph
@pytest.mark.parametrize("name", SOME)
def test_deviations_hold_the_calibrations_covariance(name: str, javascript: Callable[[str, Any], Any]) -> None:
    calibration, plane = uncertain(name), dp.Plane([0.05, 0.02, 1.0], -7.0)
    pixels = torch.rand(60, 2, dtype=D) * torch.tensor([700.0, 540], dtype=D) - 30
    measured = dp.measure(pixels, calibration, plane, view=0, pixel_sigma=SIGMA)
    body = """return given.pixels.map((pixel) => {
      const found = measurePoint(scene, pixel);
      return found.point && { point: found.point, deviations: deviationsOf(found), extrapolated: found.extrapolated };
    })"""
    found = run(javascript, body, given(calibration, plane, pixels))
    assert [each is not None for each in found] == measured.valid.tolist()
    seen = [each for each in found if each]
    assert [each["extrapolated"] for each in seen] == measured.extrapolated[measured.valid].tolist()
    assert any(each["extrapolated"] for each in seen)
    assert not all(each["extrapolated"] for each in seen)
    same(numbers([each["point"] for each in seen]), measured.points[measured.valid])
    same(numbers([each["deviations"] for each in seen]), measured.deviations[measured.valid])


@pytest.mark.filterwarnings("ignore:area")  # of outlines that cross themselves
@pytest.mark.parametrize("name", SOME)
def test_lengths_areas_and_angles_with_their_intervals(name: str, javascript: Callable[[str, Any], Any]) -> None:
    """Among them a polygon that crosses itself, an angle near 180 degrees, and a length that noise may have made."""
    calibration, plane = uncertain(name), dp.Plane.z(-3.0)
    pixels = torch.rand(9, 2, dtype=D) * torch.tensor([420.0, 300], dtype=D) + torch.tensor([90.0, 80], dtype=D)
    pixels = torch.cat([pixels, pixels[:1] + 0.6, pixels[1:2] + 3.0, (pixels[2:3] + pixels[3:4]) / 2 + 0.2])
    pairs = [[0, 1], [2, 3], [4, 5], [0, 9], [1, 10]]
    triples = [[0, 1, 2], [4, 3, 5], [2, 11, 3], [0, 9, 5]]
    outlines = [[0, 1, 2], [3, 4, 5, 6, 7, 8]]
    measured = dp.measure(pixels, calibration, plane, view=0, pixel_sigma=SIGMA)
    assert bool(measured.valid.all())
    data = given(calibration, plane, pixels) | {"pairs": pairs, "triples": triples, "outlines": outlines}
    body = """const points = given.pixels.map((pixel) => measurePoint(scene, pixel));
    const of = (numbers) => numbers.map((n) => points[n]);
    const row = ({ value, deviation, low, high }) => [value, deviation, low, high];
    return {
      lengths: given.pairs.map((pair) => row(measureLength(scene, of(pair)))),
      angles: given.triples.map((triple) => row(measureAngle(scene, of(triple)))),
      areas: given.outlines.map((outline) => row(measureArea(scene, of(outline)))),
      ways: given.outlines.map((outline) => row(measurePerimeter(scene, of(outline)))),
      x: points.map((point) => row(measureCoordinate(scene, point, 0))),
    }"""
    found = run(javascript, body, data)

    def rows(quantity: dp.Quantity) -> torch.Tensor:
        return torch.stack([quantity.value, quantity.deviation, *quantity.interval()], dim=-1)

    def way(points: torch.Tensor) -> torch.Tensor:
        return (points.roll(-1, 0) - points).norm(dim=-1).sum()

    same(numbers(found["lengths"]), rows(measured.lengths(pairs)))
    same(numbers(found["angles"]), rows(measured.angles(triples)))
    same(numbers(found["areas"]), torch.cat([rows(measured.area(outline)) for outline in outlines]))
    same(numbers(found["ways"]), torch.cat([rows(measured.quantity(way, [outline])) for outline in outlines]))
    low, high = measured.interval()
    same(numbers(found["x"])[:, 2:], torch.stack([low, high], dim=-1)[:, 0])


def test_near_the_horizon_intervals_are_open_and_lopsided(javascript: Callable[[str, Any], Any]) -> None:
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=D)
    camera, floor = dp.Camera(K), dp.Plane([0.0, 1.0, 0.0], 1.5)
    pixels = torch.tensor([[320.0, 340], [320, 243], [330, 241.5], [320, 240.1]], dtype=D)
    measured = dp.measure(pixels, camera, floor, pixel_sigma=1.0)
    body = """const points = given.pixels.map((pixel) => measurePoint(scene, pixel));
    const row = ({ value, deviation, low, high }) => [value, deviation, low, high];
    const lengths = points.slice(1).map((point, n) => row(measureLength(scene, [points[n], point])));
    return { lengths, bent: points.map((point) => isBent(scene, point)) }"""
    lengths = measured.lengths()
    wanted = torch.stack([lengths.value, lengths.deviation, *lengths.interval()], dim=-1)
    found = run(javascript, body, given(camera, floor, pixels, 1.0))
    assert bool(wanted[:, 3].isinf().any())
    same(numbers(found["lengths"]), wanted)
    assert found["bent"] == measured.nonlinear.tolist()
    assert set(found["bent"]) == {True, False}


def test_two_poses_and_few_residuals_count(javascript: Callable[[str, Any], Any]) -> None:
    """A board seen from afar has another pose, which may be the right one; few corners make intervals wider."""
    K = torch.tensor([[2000.0, 0, 320], [0, 2000, 240], [0, 0, 1]], dtype=D)
    board = dp.Chessboard(4, 3, square=20.0)
    R = dp.rotation_from_euler(*torch.tensor([0.25, 0.2, 0.1], dtype=D))
    camera = dp.Camera(K, R, torch.tensor([-20.0, -20, 2500], dtype=D), size=(640, 480))
    seen, valid = camera.project(board.points.to(D))
    seen = seen + 0.15 * torch.randn(seen.shape, dtype=D)
    with pytest.warns(dp.AmbiguousPoseWarning):
        located = dp.locate(dp.Views(seen[None], valid[None], size=(640, 480)), board, camera.without_pose())
    probability = float(located.other_poses.probability[0])
    assert probability > 1e-3
    pixels = seen[[0, 3, 11, 8]]
    data = given(located, dp.Plane.z(0.0), pixels, "detector")
    body = """const points = given.pixels.map((pixel) => measurePoint(scene, pixel));
    const row = ({ value, deviation, low, high }) => [value, deviation, low, high];
    return [...points.slice(1).map((point, n) => row(measureLength(scene, [points[n], point]))), row(measureArea(scene, points))]"""
    measured = dp.measure(pixels, located, dp.Plane.z(0.0), view=0, pixel_sigma="detector")
    assert bool(measured.degrees_of_freedom.isfinite())
    wanted = [torch.stack([q.value, q.deviation, *q.interval()], dim=-1) for q in (measured.lengths(), measured.area())]
    same(numbers(run(javascript, body, data)), torch.cat(wanted))


def test_students_reach(javascript: Callable[[str, Any], Any]) -> None:
    from diffproj.measurement.student import student_reach

    degrees = [1.0, 1.5, 2.0, 3.7, 10.0, 77.3, 999.0, 1000.0, 5000.0]
    found = javascript("given.map(studentReach)", degrees)
    same(numbers(found), student_reach(0.95, torch.tensor(degrees, dtype=D)), 1e-10)
    assert javascript("[0, Infinity].map(studentReach)", None) == ["Infinity", pytest.approx(1.959963984540054)]
