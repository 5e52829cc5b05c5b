"""What objects show of themselves: one line, and a table where a notebook asks for HTML."""

import json
from html.parser import HTMLParser
from typing import Any

import pytest
import torch

import diffproj as dp
from diffproj._core.shown import decimals, number, plain, rounded

D = torch.float64


class Tree(HTMLParser):
    """Checks that tags are closed in order, and gathers the text."""

    def __init__(self) -> None:
        super().__init__()
        self.opened: list[str] = []
        self.rows = 0

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.opened.append(tag)
        self.rows += tag == "tr"

    def handle_endtag(self, tag: str) -> None:
        assert self.opened.pop() == tag


@pytest.fixture(scope="module")
def shown() -> dict[str, Any]:
    views, board, plane = dp.example_views("left"), dp.Chessboard(), dp.Plane.z(0.0)
    calibration = dp.calibrate(views, board)
    measured = dp.measure(views.pixels[0, :4], calibration, plane, view=0)
    both = dp.calibrate(dp.Views(torch.stack([views.pixels, dp.example_views("right").pixels]), size=(640, 480)), board)
    return {
        "Calibration": calibration,
        "many": both,
        "Camera": calibration.camera,
        "cameras": calibration.cameras,
        "Views": dp.Views(views.pixels, names=[f"<b>{i}</b>" for i in range(13)]),
        "Plane": plane,
        "Covariance": calibration.covariance,
        "Measurement": measured,
        "Quantity": measured.lengths(),
        "PlaneMap": dp.PlaneMap(calibration.cameras[0], plane),
        "CrossValidation": dp.cross_validate(views, board, folds=2),
        "Experiment": dp.run_experiment(views[:8], views[8:], board),
        "AccuracyMap": dp.AccuracyMap.over_image(calibration, view=0, step=80),
    }


def test_one_short_line(shown: dict[str, Any]) -> None:
    for name, item in shown.items():
        text = repr(item)
        assert text.startswith(type(item).__name__ + "("), name
        assert "\n" not in text
        assert len(text) < 160, text
    assert repr(shown["Calibration"]) == (
        "Calibration(13 views of 54 corners, f 533.5, 533.6 px, BrownConrady, RMS 0.1583 px, converged)"
    )
    assert "f 533.5, 533.6 px, c 342.3, 234.2 px" in repr(shown["Camera"])
    assert "no pose" in repr(shown["Camera"])
    assert repr(shown["cameras"]).startswith("Camera(13 cameras, f 533.5, 533.6 px")
    assert repr(shown["Quantity"]).startswith("Quantity(25.12 ± 0.14, 24.96 ± 0.13")
    assert repr(dp.Camera(torch.eye(3)).to("meta")).startswith("Camera(f ?, ? px")


def test_tables_for_notebooks(shown: dict[str, Any]) -> None:
    for name, item in shown.items():
        tree, text = Tree(), item._repr_html_()
        tree.feed(text)
        assert not tree.opened, name
        assert type(item).__name__ in text
    assert "&lt;b&gt;0&lt;/b&gt;" in shown["Views"]._repr_html_()
    assert "Good: 13 views differ" in shown["Calibration"]._repr_html_()
    tree = Tree()
    tree.feed(dp.Views(torch.rand(50, 4, 2))._repr_html_())
    assert tree.rows == 21
    assert "and 30 more" in dp.Views(torch.rand(50, 4, 2))._repr_html_()


def test_plain_numbers(shown: dict[str, Any]) -> None:
    """What `json` writes and reads back; of tables, columns of one length."""
    for name in ("Calibration", "many", "Measurement", "Quantity", "CrossValidation", "Experiment"):
        found = shown[name].to_dict()
        assert json.loads(json.dumps(found)) == found
        if name != "Calibration":
            assert len({len(column) for column in found.values()}) == 1, name
    assert shown["Calibration"].to_dict()["status"] == "CONVERGED"
    assert shown["many"].to_dict()["status"] == ["CONVERGED", "CONVERGED"]
    floor = dp.Plane([0.0, 1.0, 0.0], 1.5)
    camera = dp.Camera(torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=D))
    pixels = torch.tensor([[320.0, 300], [320, 240], [320, 100]], dtype=D)
    assert dp.measure(pixels, camera, floor, pixel_sigma=0.5).to_dict()["reason"] == ["VALID", "PARALLEL", "BEHIND"]
    two = dp.measure(pixels.expand(2, 3, 2), camera, floor, pixel_sigma=0.5)
    assert two.to_dict()["camera"] == [0, 0, 0, 1, 1, 1]
    assert two._repr_html_()


def test_plain_numbers_of_a_calibration_hold_its_noise_and_its_deviations() -> None:
    found = dp.calibrate(dp.example_views("left")[:4], dp.Chessboard(), pixel_sigma=0.2)
    numbers = found.to_dict()
    assert numbers["pixel_sigma"] == pytest.approx(0.2)
    assert numbers["f_x_deviation"] == float(found.covariance.deviations["f_x"])


def test_numbers_for_people() -> None:
    assert rounded(123.456, 0.0234) == ("123.456", "0.023")
    assert rounded(123.456, 234.0) == ("123", "234")
    assert rounded(123.456, 0.0) == ("123.456", "")
    assert rounded(123.456, float("inf")) == ("123.456", "inf")
    assert rounded(-0.00001, 0.0234) == ("0.000", "0.023")
    assert [plain(x) for x in (8304290.12345, -642700.0, 8304290.0, 1200.0, 0.0001234, -0.0, 1e15)] == [
        "8304290.123",
        "-642700",
        "8304290",
        "1200",
        "0.0001234",
        "0",
        "1e+15",
    ]
    assert [plain(x) for x in (float("inf"), -float("inf"))] == ["inf", "-inf"]
    assert decimals([5.0, 0.00052, 0.0, float("inf"), float("nan")], 3) == 4
    assert decimals([0.002], 3) == decimals([], 3) == 3
    assert number(torch.tensor([1.0, 1.0])) == "1.0"
    assert number(torch.tensor([1.0, 2.0])) == "1.0 to 2.0"
    assert number(torch.zeros(0)) == "?"


def test_coordinates_on_a_map_are_not_cut_off() -> None:
    landmarks = dp.Landmarks([[642700.0, 8304290.5, 2.0], [642710.25, 8304295.0, 2.0], [642705.0, 8304299.0, 3.0]])
    assert "8304290.5" in landmarks._repr_html_()
    mast = dp.Camera.mounted(6.0, 20.0, position=(642700.0, 8304290.5), focal=1200.0, size=(1280, 960))
    measured = dp.measure([[640.0, 700.0]], mast, dp.Plane.z(0.0), pixel_sigma=0.5)
    assert "8304300.722" in measured.ellipses()._repr_html_()
    known = dp.adjust(mast, priors={"height": 0.02}, fixed=("tilt", "roll", "heading", "position"))
    assert "8304290.5" in known._repr_html_()


def test_no_error_bar_is_shown_as_none() -> None:
    """A scene in metres of some millimetres: deviations of micrometres; and one in kilometres."""
    close = dp.Camera.mounted(0.006, 20.0, focal=1200.0, size=(1280, 960))
    measured = dp.measure([[640.0, 700.0], [800.0, 600.0]], close, dp.Plane.z(0.0), pixel_sigma=0.5)
    first, second, length = measured.summary().splitlines()[:3]
    assert first == "point 0     0.000005 ± 0.000005    0.010222 ± 0.000009    0.000000 ± 0.000000"
    assert second.startswith("point 1     0.001839 ± 0.000006")
    assert length == "0 to 1       0.00288 ± 0.00001"
    far = dp.Camera.mounted(0.006, 20.0, focal=1200.0, size=(1280, 960))
    known = dp.adjust(far, priors={"height": 2e-5, "tilt": 0.5}, fixed=("roll", "heading", "position"))
    assert "height               0.00600 ± 0.00002" in known.summary()
    high = dp.Camera.mounted(6e6, 20.0, focal=1200.0, size=(1280, 960))  # in millimetres, known to 20 m and 2 mdeg
    aerial = dp.adjust(high, priors={"height": 2e4, "tilt": 0.002}, fixed=("roll", "heading", "position")).summary()
    assert "tilt                 20.0000 ± 0.0020 degrees" in aerial
    assert "roll                  0.0000 (fixed) degrees" in aerial
    level = dp.Camera.mounted(1e-9, 5.0, focal=1200.0, size=(1280, 960))  # at the height of the origin, before a facade
    facade = torch.tensor([[-3.0, 20, 1], [3, 20, 2], [0, 20, -2], [4, 20, -1], [-4, 20, 3]], dtype=D)
    beside = dp.adjust(level, dp.Seen(facade, level.project(facade)[0])).summary()
    assert beside.count("±") == 6


def test_what_is_not_known_keeps_its_place() -> None:
    found = dp.Quantity(torch.tensor([1.5, torch.nan, 2.5]), torch.tensor([0.1, torch.nan, 0.1]))
    assert repr(found) == "Quantity(1.50 ± 0.10, NaN, 2.50 ± 0.10)"
