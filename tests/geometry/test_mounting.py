"""`Camera.mounted` and `Camera.mounting`: figures of other tools, conventions, the way back, and where it ends."""

import math

import pytest
import torch

import diffproj as dp

D = torch.float64
GROUND = dp.Plane.z(0.0)


def view(**changes: object) -> dp.Camera:
    given = {"height": 2.0, "tilt_deg": 20.0, "focal": 500.0, "size": (640, 480)} | changes
    return dp.Camera.mounted(**given)  # type: ignore[arg-type]


def test_figures_of_matlab() -> None:
    """Those of monoCamera's documentation."""
    camera = dp.Camera.mounted(2.18, 14.0, focal=800.0, size=(640, 480), principal_point=[320.0, 240.0])
    pixels, _ = camera.project([[0.0, 10.0, 0.0]])
    torch.testing.assert_close(pixels, torch.tensor([[320.0, 216.2296]], dtype=D), atol=5e-5, rtol=0)
    points, _ = dp.back_project([[300.0, 300.0]], camera, GROUND)
    torch.testing.assert_close(points, torch.tensor([[-0.1732, 6.5959, 0]], dtype=D), atol=5e-5, rtol=0)


def test_figures_of_cameratransform() -> None:
    """Those of its documentation; it counts the tilt from straight down."""
    camera = dp.Camera.mounted(
        34.027,
        90 - 83.307926,
        -1.916219,
        focal_mm=6.2,
        sensor_mm=6.17,
        size=(3264, 2448),
        principal_point=[1632.0, 1224.0],
    )
    points, _ = dp.back_project([[2445.0, 1569.0]], camera, GROUND)
    torch.testing.assert_close(points, torch.tensor([[36.26041556, 145.50056995, 0]], dtype=D), atol=5e-6, rtol=0)


def test_conventions() -> None:
    """Tilt below the horizon, heading clockwise from y, roll as the horizon sinks to the right, the middle of the image."""
    assert view().K[:2, 2].tolist() == [319.5, 239.5]
    down, _ = dp.back_project([[319.5, 239.5]], view(), GROUND)
    assert down[0].tolist() == pytest.approx([0, 2 / math.tan(math.radians(20)), 0])
    east, _ = dp.back_project([[319.5, 239.5]], view(heading_deg=90.0), GROUND)
    assert east[0].tolist() == pytest.approx([2 / math.tan(math.radians(20)), 0, 0])
    far = torch.tensor([[-1e6, 1e7, 2.0], [1e6, 1e7, 2.0]], dtype=D)  # two points of the horizon, left and right
    (left, right), _ = view(tilt_deg=0.0, roll_deg=5.0).project(far)
    assert right[1] > left[1]
    assert math.degrees(math.atan2(right[1] - left[1], right[0] - left[0])) == pytest.approx(5)
    top, _ = dp.back_project([[319.5, 200.0]], view(tilt_deg=90.0, heading_deg=90.0), GROUND)
    assert top[0, 0] > 0
    assert top[0, 1] == pytest.approx(0)


@pytest.mark.parametrize(
    ("given", "f"),
    [
        ({"focal": 500.0}, (500, 500)),
        ({"focal": (500.0, 510)}, (500, 510)),
        ({"focal": None, "fov_deg": 90.0}, (320, 320)),
        ({"focal": None, "fov_deg": 0.1}, (320 / math.tan(math.radians(0.05)),) * 2),
        ({"focal": None, "focal_mm": 5.0, "sensor_mm": 10.0}, (320, 320)),
        ({"focal": None, "focal_mm": 5.0, "sensor_mm": (10.0, 8.0)}, (320, 300)),
    ],
)
def test_ways_to_say_the_focal_length(given: dict[str, object], f: tuple[float, float]) -> None:
    assert view(**given).K.diagonal()[:2].tolist() == pytest.approx(f)


def test_there_and_back_in_batches() -> None:
    random = torch.Generator().manual_seed(0)
    part = torch.rand(5, 200, dtype=D, generator=random)
    height, tilt, roll = 0.1 + 100 * part[0], 180 * part[1] - 90, 360 * part[2] - 180
    heading, position = 360 * part[3], 1e6 * torch.rand(200, 2, dtype=D, generator=random)
    lens = dp.BrownConrady([-0.1, 0.01, 0, 0])
    cameras = view(height=height, tilt_deg=tilt, roll_deg=roll, heading_deg=heading, position=position, distortion=lens)
    assert cameras.batch_shape == (200,)
    found = cameras.mounting()
    for value, truth in zip(found, (height, tilt, roll, heading, position), strict=True):
        torch.testing.assert_close(value, truth, rtol=1e-9, atol=1e-9)
    single = view(height=3, tilt_deg=10, heading_deg=torch.tensor([0.0, 90], dtype=torch.float32))
    assert single.dtype == torch.float32
    assert single.mounting().heading.tolist() == pytest.approx([0, 90], abs=1e-4)


@pytest.mark.parametrize(("tilt", "heading"), [(90.0, 20.0), (-90.0, 40.0)])
def test_straight_down_or_up_the_heading_is_that_of_the_picture(tilt: float, heading: float) -> None:
    """There roll and heading turn about the same axis; the roll is 0, and what comes of both is the same camera."""
    camera = view(tilt_deg=tilt, roll_deg=10.0, heading_deg=30.0)
    found = camera.mounting()
    assert found.roll == 0
    assert float(found.heading) == pytest.approx(heading)
    again = view(tilt_deg=found.tilt, roll_deg=found.roll, heading_deg=found.heading)
    torch.testing.assert_close(again.R, camera.R)


@pytest.mark.parametrize("start", [[2.0, 30, 5, 50], [2.0, 0, -170, 350], [2.0, 89, 1, 2]])
def test_derivatives(start: list[float]) -> None:
    def there_and_back(x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(view(height=x[0], tilt_deg=x[1], roll_deg=x[2], heading_deg=x[3]).mounting())

    x = torch.tensor(start, dtype=D, requires_grad=True)
    assert torch.autograd.gradcheck(there_and_back, x)
    steep = torch.tensor([2.0, 90, 0, 30], dtype=D, requires_grad=True)
    sum(part.sum() for part in there_and_back(steep)).backward()  # type: ignore[union-attr]
    assert bool(steep.grad.isfinite().all())  # type: ignore[union-attr]


def test_a_turned_image_counts_as_a_turned_camera() -> None:
    quarter = torch.tensor([[0.0, -1, 479], [1, 0, 0], [0, 0, 1]], dtype=D)
    found = view().warped(quarter, size=(480, 640)).mounting()
    assert float(found.roll.abs()) == pytest.approx(90)
    assert float(found.tilt) == pytest.approx(20)


@pytest.mark.plain
@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"focal": None}, "focal: want one of focal .px., fov_deg, or focal_mm with sensor_mm, got none"),
        ({"fov_deg": 50.0}, "got focal and fov_deg"),
        ({"focal": None, "focal_mm": 5.0}, "focal_mm: want focal_mm and sensor_mm together, got focal_mm alone"),
        ({"sensor_mm": 5.0}, "got sensor_mm alone"),
        ({"focal": -1.0}, "focal: want a focal length in px, more than 0, got -1"),
        ({"focal": (1.0, 2.0, 3.0)}, "focal: want a number, or a tuple"),
        ({"focal": None, "fov_deg": 180.0}, "fov_deg: want degrees from edge to edge, between 0 and 180, got 180"),
        ({"height": 0.0}, "height: want a height above the ground, more than 0, got 0"),
        ({"height": math.nan}, "height: want"),
        ({"tilt_deg": 100.0}, "tilt_deg: want degrees below the horizon, from -90 to 90, got 100"),
        ({"roll_deg": math.inf}, "roll_deg: want degrees, got inf"),
        ({"heading_deg": "north"}, "heading_deg: want degrees, got 'north'"),
        ({"size": None}, "size: want .width, height. of the image in px, got None"),
        ({"position": [0.0, math.nan]}, "position: want finite numbers"),
        ({"principal_point": [math.inf, 0.0]}, "principal_point: want finite numbers"),
        ({"position": [0.0, 0, 0]}, r"position: want shape \(\*B, 2\)"),
        ({"height": torch.ones(2), "tilt_deg": torch.ones(3)}, "batch shapes do not broadcast"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(wrong: dict[str, object], text: str) -> None:
    with pytest.raises((TypeError, ValueError), match=text):
        view(**wrong)


def test_a_camera_without_a_pose_is_told() -> None:
    """As that of a calibration, whose height is not 0."""
    with pytest.warns(UserWarning, match="mounting: the camera has no pose"):
        view().without_pose().mounting()
    found = dp.adjust(view(), priors={"height": 0.02, "tilt": 0.5}, fixed=("roll", "heading", "position"))
    with pytest.warns(UserWarning, match="mounting: the camera has no pose"):
        found.camera.mounting()
    assert float(found.mounting.height) == pytest.approx(2.0)
